"use strict";
// The camera view: the newest picture, and over it the corners that were found and those that were expected.

class CameraScreen {
  constructor() {
    this.byId = (id) => document.getElementById(id);
    this.name = null;
    this.source = null;
    this.last = null;
    this.number = 0;
    this.shownAt = 0;
    this.coverage = null; // {columns, rows, count, rms_px}, of the whole image
    this.gone = false; // the camera delivers nothing: what is shown is old
    this.wanted = null; // {outline, text}: where the board is to be brought
    setInterval(() => this.watchAge(), 1000);
    for (const id of ["show-detected", "show-predicted", "show-coverage"]) this.byId(id).onchange = () => this.draw();
  }

  look(name) { // null: this camera sends no pictures here
    if (name === this.name) return;
    this.name = name;
    this.last = null; // or the picture of another camera would be taken for this one's
    const canvas = this.byId("picture");
    canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    this.byId("corners").replaceChildren();
    document.querySelector(".screen").classList.remove("live");
    this.byId("nopicture").textContent = "no image yet";
    setText("misfit", "");
    this.connect();
  }

  connect() {
    const name = this.name;
    if (this.source) this.source.close();
    if (name === null) return;
    this.source = new EventSource(`camera/${encodeURIComponent(name)}/events`);
    this.source.addEventListener("picture", (event) => {
      this.number += 1;
      this.show(Object.assign(JSON.parse(event.data), { number: this.number, name }));
    });
    this.source.onerror = (event) => {
      document.querySelector(".screen").classList.remove("live");
      again(event.target, () => { if (this.source === event.target) this.connect(); });
    };
  }

  async show(picture) {
    const image = new Image();
    if (picture.jpeg) {
      image.src = `data:image/jpeg;base64,${picture.jpeg}`;
      try {
        await image.decode();
      } catch (error) {
        return; // not a picture: the next one comes soon
      }
    }
    if (picture.name !== this.name || (this.last && picture.number < this.last.number)) return;
    const canvas = this.byId("picture"); // picture and corners change in one step, never one before the other
    [canvas.width, canvas.height] = picture.jpeg ? [image.naturalWidth, image.naturalHeight] : picture.size;
    if (picture.jpeg) canvas.getContext("2d").drawImage(image, 0, 0); // else only points arrive
    this.last = picture;
    this.shownAt = performance.now();
    this.draw();
    if (!this.gone) document.querySelector(".screen").classList.add("live");
  }

  watchAge() { // a picture that stands still looks like a rig that stands still
    const age = (performance.now() - this.shownAt) / 1000;
    if (!this.last || age < 5) return;
    document.querySelector(".screen").classList.remove("live");
    this.byId("nopicture").textContent = `no new picture for ${age.toFixed(0)} s`;
  }

  setGone(gone) {
    this.gone = gone;
    if (!gone || !this.last || performance.now() - this.shownAt >= 5000) return;
    document.querySelector(".screen").classList.remove("live");
    this.byId("nopicture").textContent = "no new picture";
    setText("misfit", "");
  }

  draw() {
    if (!this.last) return;
    const { size: [width, height], detected, predicted } = this.last;
    const screen = document.querySelector(".screen");
    screen.style.aspectRatio = `${width} / ${height}`;
    const svg = this.byId("corners");
    svg.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`); // pixel centres lie at whole numbers
    const unit = width / Math.max(svg.clientWidth, 1); // image pixels per pixel of the screen
    const r = 4.5 * unit;
    const ring = ([, u, v]) => `M${u - r},${v}a${r},${r} 0 1 0 ${2 * r},0a${r},${r} 0 1 0 ${-2 * r},0`;
    const c = 3.6 * unit;
    const cross = ([, u, v]) => `M${u - c},${v - c}l${2 * c},${2 * c}M${u - c},${v + c}l${2 * c},${-2 * c}`;
    svg.replaceChildren(
      ...this.cells(width, height), ...this.outline(),
      ...this.path("detected", detected, ring), ...this.path("predicted", predicted, cross),
    );
    this.byId("misfit").textContent = this.misfit(detected, predicted) + (this.last.jpeg ? "" : "; no images arrive");
  }

  setWanted(wanted) {
    if (this.wanted && wanted && this.wanted.text !== wanted.text) meters.cue(660); // one place done
    this.wanted = wanted;
    setText("wanted", wanted ? wanted.text : "");
  }

  // Green where corners have been and fit, yellow where there were few, red where they fit worse, dark where none were.
  cells(width, height) {
    const c = this.coverage;
    if (!c || !this.byId("show-coverage").checked) return [];
    const w = width / c.columns, h = height / c.rows, most = Math.max(...c.count, 1);
    const known = c.rms_px.filter((v) => v !== null).sort((a, b) => a - b);
    const usual = known.length ? known[known.length >> 1] : 0;
    const paths = { none: "", some: "", seen: "", poor: "" };
    c.count.forEach((count, i) => {
      const poor = usual && c.rms_px[i] !== null && c.rms_px[i] > 2 * usual;
      const kind = !count ? "none" : count < most ? "some" : poor ? "poor" : "seen";
      paths[kind] += `M${(i % c.columns) * w - 0.5},${Math.floor(i / c.columns) * h - 0.5}h${w}v${h}h${-w}z`;
    });
    return Object.entries(paths).filter(([, d]) => d).map(([kind, d]) => this.shape(`cell ${kind}`, d));
  }

  outline() {
    if (!this.wanted) return [];
    return [this.shape("wanted", `M${this.wanted.outline.map((p) => p.join()).join("L")}z`)];
  }

  shape(kind, d) {
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    path.setAttribute("class", kind);
    path.setAttribute("d", d);
    return path;
  }

  path(kind, points, mark) {
    if (!points.length || !this.byId(`show-${kind}`).checked) return [];
    return [this.shape(kind, points.map(mark).join(""))];
  }

  misfit(detected, predicted) {
    if (!this.last.searched) return "this image was skipped by the detector";
    if (!detected.length) return "no corners found in this image";
    if (!predicted.length) return `${detected.length} corners; no prediction yet`;
    const found = new Map(detected.map(([id, u, v]) => [id, [u, v]]));
    const off = predicted.filter(([id]) => found.has(id))
      .map(([id, u, v]) => Math.hypot(u - found.get(id)[0], v - found.get(id)[1])).sort((a, b) => a - b);
    return off.length ? `${detected.length} corners, median error ${off[off.length >> 1].toFixed(2)} px` : "";
  }
}

const camera = new CameraScreen();
