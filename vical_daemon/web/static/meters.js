"use strict";
// Meters of what is known of what is needed, advice on blur and light, and the cue (sound and vibration) on progress.

const meters = {
  ticked: null, // names of the full meters, to notice a new one
  audio: null,

  draw(list) {
    const holder = $("meters");
    holder.replaceChildren(...["translation", "rotation", "time"].flatMap((kind) => {
      const own = list.filter((m) => m.kind === kind);
      if (!own.length) return [];
      const group = element("div", "group");
      group.append(element("span", "title", kind === "time" ? "time shift" : kind));
      for (const m of own) group.append(this.one(m));
      return [group];
    }));
    const full = list.filter((m) => m.share >= 1).map((m) => m.kind + m.name);
    if (this.ticked && full.some((name) => !this.ticked.includes(name))) this.cue(880);
    this.ticked = full;
  },

  one(m) {
    const full = m.share >= 1;
    const bar = element("span", full ? "meter full" : "meter");
    bar.title = `${m.kind} ${m.name}: ${Math.round(100 * m.share)} % of the required information; sigma ${m.sigma} ${m.unit}`;
    const fill = element("i");
    fill.style.width = `${Math.max(100 * m.share, 2)}%`;
    bar.append(element("b", `k ${"xyz".includes(m.name) ? m.name : "one"}`, m.kind === "time" ? "t" : m.name), fill,
      element("em", "", full ? "✓" : `${Math.floor(100 * m.share)} %`));
    return bar;
  },

  sight(sight, light) { // what to change at the camera comes first, then figures
    const advice = [sight && sight.blur && sight.blur.advice, light && light.advice].filter(Boolean);
    setText("imageadvice", advice.join("; "));
    const facts = [];
    if (sight && sight.rate_hz) facts.push(`${sight.rate_hz} images/s`);
    if (sight && sight.board_share !== null) facts.push(`${Math.round(100 * sight.board_share)} % of the board`);
    if (sight && sight.blur) facts.push(`blur ${sight.blur.px} px`);
    if (light) facts.push(`brightness ${Math.round(100 * light.level)} %`);
    if (sight && sight.coverage) facts.push(`${Math.round(100 * sight.coverage.share)} % of the image covered`);
    setText("imagefacts", facts.join(" · "));
  },

  get on() { return localStorage.getItem("cue") === "on"; },

  toggle() {
    localStorage.setItem("cue", this.on ? "off" : "on");
    this.show();
    this.cue(660);
  },

  show() {
    setText("cue", this.on ? "♪ on" : "♪ off");
    $("cue").setAttribute("aria-pressed", String(this.on));
  },

  cue(pitch_hz) { // short: one looks at the rig, not at the phone
    if (!this.on) return;
    if (navigator.vibrate) navigator.vibrate(60);
    this.audio = this.audio || new AudioContext();
    const tone = this.audio.createOscillator(), volume = this.audio.createGain(), now = this.audio.currentTime;
    tone.frequency.value = pitch_hz;
    volume.gain.setValueAtTime(0.15, now);
    volume.gain.exponentialRampToValueAtTime(0.001, now + 0.25);
    tone.connect(volume).connect(this.audio.destination);
    tone.start(now);
    tone.stop(now + 0.26);
  },
};
$("cue").onclick = () => meters.toggle();
meters.show();
