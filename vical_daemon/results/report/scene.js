"use strict";
// 3-D view on a canvas: imu and camera with axes and ellipsoids of one sigma to scale, board, path of the camera.
// Drag to rotate, scroll or pinch to zoom. Data: {rig: {p, R, p_cov, r_cov}, board: [[x, y, z], …],
// path: [{p, R}, …]}; rig in the imu frame, board and path (camera poses) in the target frame; m and rad.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const times = (R, v) => R.map((row) => dot(row, v));
const transposed = (R) => R[0].map((_, j) => R.map((row) => row[j]));
const product = (A, B) => A.map((row) => transposed(B).map((column) => dot(row, column)));

class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.data = null;
    this.room = false; // false: the rig alone; true: with board and path
    this.turn = { yaw: -0.7, pitch: 0.5 };
    this.zoom = 1;
    this.gain = 1; // of the ellipsoids
    this.fingers = new Map();
    canvas.style.touchAction = "none";
    canvas.addEventListener("pointerdown", (e) => { this.fingers.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointermove", (e) => this.drag(e));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (e) => this.fingers.delete(e.pointerId));
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.nearer(Math.exp(-e.deltaY / 500)); }, { passive: false });
    canvas.addEventListener("keydown", (e) => this.key(e));
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  set(data) {
    this.data = data;
    this.draw();
  }

  choose(options) { // {room, gain}
    Object.assign(this, options);
    if ("room" in options) this.zoom = 1;
    this.draw();
  }

  nearer(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.1), 200);
    this.draw();
  }

  key(e) {
    const [yaw, pitch] = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key] || [0, 0];
    const factor = { "+": 1.25, "=": 1.25, "-": 0.8 }[e.key];
    if (e.ctrlKey || e.metaKey || e.altKey || !(yaw || pitch || factor)) return; // Ctrl and + is the browser's
    e.preventDefault();
    this.turnBy(yaw, pitch);
    this.nearer(factor || 1);
  }

  turnBy(yaw, pitch) {
    this.turn.yaw += yaw;
    this.turn.pitch = Math.min(Math.max(this.turn.pitch + pitch, -1.6), 1.6);
  }

  drag(e) {
    const last = this.fingers.get(e.pointerId);
    if (!last) return;
    const others = [...this.fingers.values()].filter((f) => f.pointerId !== e.pointerId);
    if (others.length) {
      const gap = (f) => Math.hypot(f.clientX - others[0].clientX, f.clientY - others[0].clientY);
      this.zoom *= gap(e) / Math.max(gap(last), 1);
    } else {
      this.turnBy((e.clientX - last.clientX) / 120, (e.clientY - last.clientY) / 120);
    }
    this.fingers.set(e.pointerId, e);
    this.draw();
  }

  // Everything is drawn in the frame of the board where there is one, else in that of the imu.
  placed() {
    const { rig, path } = this.data;
    if (!this.room || !path || !path.length) return { R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], p: [0, 0, 0] };
    const last = path[path.length - 1];
    const R = product(last.R, transposed(rig.R)); // R_target_imu
    return { R, p: add(last.p, times(R, rig.p), -1) };
  }

  draw() {
    const box = this.canvas.getBoundingClientRect();
    if (!box.width || !this.data || !this.data.rig) return;
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(box.width * ratio);
    this.canvas.height = Math.round(box.height * ratio);
    const c = this.canvas.getContext("2d");
    c.scale(ratio, ratio);
    const css = getComputedStyle(document.documentElement);
    this.ink = (name) => css.getPropertyValue(name).trim();
    this.c = c;
    const { rig, board, path } = this.data, room = this.room && path && path.length;
    const at = this.placed(), camera = add(at.p, times(at.R, rig.p)), Rc = product(at.R, rig.R);
    const arm = Math.max(Math.hypot(...rig.p), 0.02);
    const seen = room ? [...board, ...path.map((v) => v.p), at.p] : [at.p, camera];
    const low = [0, 1, 2].map((i) => Math.min(...seen.map((v) => v[i])));
    const high = [0, 1, 2].map((i) => Math.max(...seen.map((v) => v[i])));
    this.centre = low.map((v, i) => 0.5 * (v + high[i]));
    const extent = Math.max(Math.hypot(...high.map((v, i) => v - low[i])), arm);
    this.scale = (this.zoom * Math.min(box.width, box.height) * (room ? 1.1 : 0.55)) / extent;
    this.middle = [box.width / 2, box.height / 2];
    this.view();
    if (room) this.drawRoom(board, path);
    const size = room ? Math.max(0.5 * arm, 0.06 * extent) : 0.55 * arm;
    this.axes(at.p, at.R, size, "imu");
    this.line([at.p, camera], "--soft", 1.5, [4, 4]);
    this.frustum(camera, Rc, size);
    this.axes(camera, Rc, size, "cam");
    this.ellipsoid(camera, product(product(at.R, rig.p_cov), transposed(at.R)), "--bad");
    this.tips(camera, Rc, size, rig.r_cov);
    this.legend(rig, extent, box);
  }

  view() { // rows of the rotation into the screen: right, down, away; up is z of the imu, or what the camera sees as up
    const { yaw, pitch } = this.turn, [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const { path } = this.data, room = this.room && path && path.length;
    const up = room ? [0, path[path.length - 1].R[1][1] > 0 ? -1 : 1, 0] : [0, 0, 1], side = [1, 0, 0];
    const depth = [up[1] * side[2] - up[2] * side[1], up[2] * side[0] - up[0] * side[2], up[0] * side[1] - up[1] * side[0]];
    const right = add(side.map((v) => v * cy), depth, sy);
    const away = add(depth.map((v) => v * cy), side, -sy);
    this.right = right;
    this.down = add(up.map((v) => -v * cp), away, -sp);
    this.away = add(away.map((v) => v * cp), up, -sp);
  }

  at(point) {
    const d = add(point, this.centre, -1);
    return [this.middle[0] + this.scale * dot(this.right, d), this.middle[1] + this.scale * dot(this.down, d)];
  }

  line(points, colour, width, dash = [], fill = "") {
    const c = this.c;
    c.beginPath();
    for (const p of points) c.lineTo(...this.at(p));
    c.setLineDash(dash);
    c.lineJoin = "round";
    c.strokeStyle = this.ink(colour);
    c.lineWidth = width;
    if (fill) { c.closePath(); c.globalAlpha = 0.18; c.fillStyle = this.ink(fill); c.fill(); c.globalAlpha = 1; }
    c.stroke();
    c.setLineDash([]);
  }

  text(words, point, colour) {
    this.c.font = "12px system-ui, sans-serif";
    this.c.fillStyle = this.ink(colour);
    const [x, y] = this.at(point);
    this.c.fillText(words, x + 5, y - 5);
  }

  axes(origin, R, size, name) {
    ["--x", "--y", "--z"].forEach((colour, i) => {
      const tip = add(origin, R.map((row) => row[i]), size);
      this.line([origin, tip], colour, 2.5);
      this.text("xyz"[i], tip, colour);
    });
    this.text(name, origin, "--ink");
  }

  frustum(origin, R, size) { // the camera looks along its z
    const corner = (x, y) => add(origin, times(R, [x, y, 1]), 0.6 * size);
    const rim = [corner(-0.5, -0.38), corner(0.5, -0.38), corner(0.5, 0.38), corner(-0.5, 0.38)];
    for (const v of rim) this.line([origin, v], "--soft", 1);
    this.line([...rim, rim[0]], "--soft", 1, [], "--soft");
  }

  // The outline of an ellipsoid seen from far is the ellipse of its covariance in the plane of the screen.
  ellipsoid(centre, covariance, colour) {
    const on = (a, b) => dot(a, times(covariance, b)) * (this.scale * this.gain) ** 2;
    const xx = on(this.right, this.right), yy = on(this.down, this.down), xy = on(this.right, this.down);
    const mean = 0.5 * (xx + yy), half = Math.hypot(0.5 * (xx - yy), xy);
    const [x, y] = this.at(centre), c = this.c;
    c.beginPath();
    c.ellipse(x, y, Math.sqrt(Math.max(mean + half, 0.25)), Math.sqrt(Math.max(mean - half, 0.25)), 0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
    c.fillStyle = this.ink(colour);
    c.globalAlpha = 0.35;
    c.fill();
    c.globalAlpha = 1;
    c.strokeStyle = this.ink(colour);
    c.lineWidth = 1;
    c.stroke();
  }

  tips(origin, R, size, r_cov) { // where the tips of the camera's axes may lie: rotation errors about its own axes
    [0, 1, 2].forEach((i) => {
      const e = [0, 1, 2].map((k) => (k === i ? size : 0));
      const cross = [[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]].map((row) => row.map((v) => -v)); // d = r x e
      const J = product(R, cross);
      this.ellipsoid(add(origin, R.map((row) => row[i]), size), product(product(J, r_cov), transposed(J)), ["--x", "--y", "--z"][i]);
    });
  }

  drawRoom(board, path) {
    this.line([...board, board[0]], "--ink", 2, [], "--ink");
    this.text("board", board[0], "--ink");
    this.line(path.map((v) => v.p), "--busy", 1.2);
  }

  legend(rig, extent, box) {
    const worst = Math.sqrt(Math.max(...[0, 1, 2].map((i) => rig.p_cov[i][i])));
    const step = [1e-4, 1e-3, 0.01, 0.1, 1, 10].find((v) => v * this.scale > 40) || 10;
    const unit = step < 0.01 ? `${step * 1e3} mm` : step < 1 ? `${step * 100} cm` : `${step} m`;
    const c = this.c, y = box.height - 14;
    c.strokeStyle = this.ink("--soft");
    c.fillStyle = this.ink("--soft");
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(12, y);
    c.lineTo(12 + step * this.scale, y);
    c.stroke();
    c.font = "12px system-ui, sans-serif";
    c.fillText(unit, 12, y - 6);
    const lines = [`ellipsoids: 1 sigma${this.gain > 1 ? ` × ${this.gain}` : ", to scale"}`, `(largest ${(1e3 * worst).toPrecision(2)} mm)`];
    const whole = lines.join(" "), narrow = c.measureText(whole).width > box.width - 16;
    c.textAlign = "right";
    (narrow ? lines : [whole]).forEach((text, i) => c.fillText(text, box.width - 8, 16 + 15 * i));
    c.textAlign = "left";
  }
}

function press(button, on) { // a button that stays down
  button.classList.toggle("on", on);
  button.setAttribute("aria-pressed", String(on));
}

// Buttons of a view: data-room="1|0" and data-gain="N" inside the element that holds the canvas.
function sceneButtons(scene, holder) {
  for (const button of holder.querySelectorAll("button[data-room], button[data-gain]")) {
    button.onclick = () => {
      const kind = "room" in button.dataset ? "room" : "gain";
      scene.choose({ [kind]: kind === "room" ? button.dataset.room === "1" : Number(button.dataset.gain) });
      for (const other of holder.querySelectorAll(`button[data-${kind}]`)) press(other, other === button);
    };
    press(button, button.classList.contains("on"));
  }
}
