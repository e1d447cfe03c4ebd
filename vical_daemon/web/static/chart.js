"use strict";
// Lines with bands of one sigma on a canvas. A series: {t, v, s, colour} of equal lengths; s may be null.

function niceStep(range, count) {
  const raw = range / Math.max(count, 1);
  const power = Math.pow(10, Math.floor(Math.log10(raw)));
  const part = raw / power;
  return (part < 1.5 ? 1 : part < 3.5 ? 2 : part < 7.5 ? 5 : 10) * power;
}

function label(value, step) {
  const digits = Math.min(Math.max(-Math.floor(Math.log10(step) + 1e-9), 0), 6);
  return value.toFixed(digits);
}

class Chart {
  constructor(canvas, options) {
    this.canvas = canvas;
    this.options = Object.assign({ floor: null, reference: null, least: 0 }, options);
    this.series = [];
    this.span = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  set(series, span) {
    this.series = series;
    this.span = span;
    this.draw();
  }

  // The limits follow the newer half of what is shown: the first wild seconds would flatten the rest.
  limits(t0, t1) {
    let low = Infinity, high = -Infinity;
    const from = this.span ? t0 : t0 + 0.5 * (t1 - t0);
    for (const { t, v, s } of this.series) {
      for (let i = 0; i < t.length; i++) {
        if (t[i] < from || v[i] === null) continue;
        const band = s && s[i] !== null ? s[i] : 0;
        low = Math.min(low, v[i] - band);
        high = Math.max(high, v[i] + band);
      }
    }
    if (low > high) return null;
    if (this.options.floor !== null) low = this.options.floor;
    if (this.options.reference !== null) high = Math.max(high, 2 * this.options.reference);
    const middle = 0.5 * (low + high), half = Math.max(0.56 * (high - low), this.options.least, 1e-9);
    return this.options.floor !== null ? [low, low + 2 * half] : [middle - half, middle + half];
  }

  draw() {
    const box = this.canvas.getBoundingClientRect();
    if (!box.width) return;
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(box.width * ratio);
    this.canvas.height = Math.round(box.height * ratio);
    const c = this.canvas.getContext("2d");
    c.scale(ratio, ratio);
    const css = getComputedStyle(document.documentElement);
    const ink = (name) => css.getPropertyValue(name).trim();
    c.font = "11px system-ui, sans-serif";
    const times = this.series.flatMap((s) => (s.t.length ? [s.t[0], s.t[s.t.length - 1]] : []));
    if (!times.length) {
      c.fillStyle = ink("--soft");
      c.fillText("no data yet", 8, 20);
      return;
    }
    const t1 = Math.max(...times);
    const t0 = this.span ? Math.max(Math.min(...times), t1 - this.span) : Math.min(...times);
    const limits = this.limits(t0, t1);
    if (!limits) return;
    const [low, high] = limits;
    const left = 46, right = box.width - 6, top = 6, bottom = box.height - 18;
    const X = (t) => left + ((right - left) * (t - t0)) / Math.max(t1 - t0, 1e-6);
    const Y = (v) => bottom - ((bottom - top) * (v - low)) / (high - low);
    this.grid(c, ink, { t0, t1, low, high, left, right, top, bottom, X, Y });
    c.save();
    c.beginPath();
    c.rect(left, top, right - left, bottom - top);
    c.clip();
    for (const one of this.series) this.band(c, ink(one.colour), one, X, Y, t0);
    for (const one of this.series) this.line(c, ink(one.colour), one, X, Y, t0);
    c.restore();
  }

  grid(c, ink, g) {
    c.strokeStyle = ink("--line");
    c.fillStyle = ink("--soft");
    c.lineWidth = 1;
    const step = niceStep(g.high - g.low, 4);
    c.textAlign = "right";
    for (let v = Math.ceil(g.low / step) * step; v <= g.high; v += step) {
      c.beginPath();
      c.moveTo(g.left, g.Y(v));
      c.lineTo(g.right, g.Y(v));
      c.stroke();
      c.fillText(label(Math.abs(v) < step * 1e-6 ? 0 : v, step), g.left - 6, g.Y(v) + 4);
    }
    c.textAlign = "center";
    const tick = niceStep(Math.max(g.t1 - g.t0, 1e-3), Math.max(2, (g.right - g.left) / 90));
    for (let t = Math.ceil(g.t0 / tick) * tick; t <= g.t1; t += tick) {
      c.fillText(`${label(t, tick)} s`, Math.min(Math.max(g.X(t), g.left + 12), g.right - 14), g.bottom + 14);
    }
    if (this.options.reference !== null) {
      c.strokeStyle = ink("--soft");
      c.setLineDash([4, 4]);
      c.beginPath();
      c.moveTo(g.left, g.Y(this.options.reference));
      c.lineTo(g.right, g.Y(this.options.reference));
      c.stroke();
      c.setLineDash([]);
    }
  }

  band(c, colour, { t, v, s }, X, Y, t0) {
    if (!s) return;
    const use = [];
    for (let i = 0; i < t.length; i++) if (t[i] >= t0 && v[i] !== null && s[i] !== null) use.push(i);
    if (use.length < 2) return;
    c.beginPath();
    for (const i of use) c.lineTo(X(t[i]), Y(v[i] + s[i]));
    for (const i of use.reverse()) c.lineTo(X(t[i]), Y(v[i] - s[i]));
    c.closePath();
    c.globalAlpha = 0.18;
    c.fillStyle = colour;
    c.fill();
    c.globalAlpha = 1;
  }

  line(c, colour, { t, v }, X, Y, t0) {
    c.strokeStyle = colour;
    c.lineWidth = 1.8;
    c.lineJoin = "round";
    c.beginPath();
    for (let i = 0; i < t.length; i++) if (t[i] >= t0 && v[i] !== null) c.lineTo(X(t[i]), Y(v[i]));
    c.stroke();
  }
}
