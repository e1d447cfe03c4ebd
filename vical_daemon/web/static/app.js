"use strict";
// Listens to /events and draws. Everything from the robot goes in as text, never as HTML.

const $ = (id) => document.getElementById(id);
const page = { columns: [], rows: {}, latest: {}, devices: [], sights: {}, paths: {}, views: [], fault: null, control: false, camera: null, span: 0, heard: 0, heardAt: 0, asked: 0 };
const SILENT_MS = 5000; // the robot speaks 2.5 times a second
const DEAD_MS = 10000; // of silence: nobody tells a phone that slept or changed its network that a connection is gone
const AGAIN_MS = 3000;
const ROWS = 2000; // kept of a camera; a chart has about 500 pixels
const AXES = ["x", "y", "z"];
const COLOURS = ["--x", "--y", "--z"];

const charts = {
  lever: new Chart($("c-lever"), { least: 0.05 }),
  rotation: new Chart($("c-rotation"), { least: 0.001 }),
  shift: new Chart($("c-shift"), { least: 0.002 }),
  nis: new Chart($("c-nis"), { floor: 0, reference: 1 }),
  gyro: new Chart($("c-gyro"), { least: 0.01 }),
  accel: new Chart($("c-accel"), { least: 0.5 }),
};

function element(tag, kind, text) {
  const made = document.createElement(tag);
  if (kind) made.className = kind;
  if (text !== undefined) made.textContent = text;
  return made;
}

function setText(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

// A value with the digits that one sigma leaves meaningful: two digits of the sigma.
function shown(value, sigma) {
  if (value === null || value === undefined) return ["–", ""];
  if (!sigma) return [String(value), ""];
  const digits = Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 6);
  return [value.toFixed(digits), `± ${sigma.toFixed(digits)}`];
}

function fillValues(id, entries) {
  $(id).replaceChildren(...entries.map(([key, kind, value, sigma]) => {
    const item = element("span");
    const [number, band] = shown(value, sigma);
    item.append(element("span", `k ${kind}`, key), element("b", "", number), element("span", "s", band ? ` ${band}` : ""));
    return item;
  }));
}

function conjugateTimes(a, b) { // conj(a) * b, quaternions w x y z
  const [w, x, y, z] = [a[0], -a[1], -a[2], -a[3]];
  return [
    w * b[0] - x * b[1] - y * b[2] - z * b[3], w * b[1] + x * b[0] + y * b[3] - z * b[2],
    w * b[2] - x * b[3] + y * b[0] + z * b[1], w * b[3] + x * b[2] - y * b[1] + z * b[0],
  ];
}

function turnFrom(now, then) { // rotation vector in degrees of `then` seen from `now`
  const q = conjugateTimes(now, then);
  const sign = q[0] < 0 ? -1 : 1;
  const length = Math.hypot(q[1], q[2], q[3]);
  const scale = length < 1e-12 ? 2 : (2 * Math.atan2(length, sign * q[0])) / length;
  return [1, 2, 3].map((i) => (sign * q[i] * scale * 180) / Math.PI);
}

function yawPitchRoll(q) { // Rz(yaw) Ry(pitch) Rx(roll), degrees
  const [w, x, y, z] = q;
  const s = Math.max(-1, Math.min(1, 2 * (w * y - z * x)));
  return [
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), Math.asin(s),
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
  ].map((v) => (v * 180) / Math.PI);
}

function anglesSigma(q, s) { // of yaw, pitch, roll in degrees, from sigmas (deg) about the camera's axes
  const h = 1e-4;
  const turned = [[1, h, 0, 0], [1, 0, h, 0], [1, 0, 0, h]].map((d) => conjugateTimes([q[0], -q[1], -q[2], -q[3]], d));
  const base = yawPitchRoll(q);
  const wrap = (a) => a - 360 * Math.round(a / 360);
  return base.map((angle, k) => Math.hypot(...turned.map((t, i) => (wrap(yawPitchRoll(t)[k] - angle) / ((h * 360) / Math.PI)) * s[i])));
}

function drawCharts() {
  const rows = page.rows[page.camera] || [];
  const at = (name) => page.columns.indexOf(name);
  const column = (name) => { const i = at(name); return rows.map((r) => r[i]); };
  const t = column("t_s");
  const three = (names, sigmas) => AXES.map((_, i) => ({ t, v: column(names[i]), s: column(sigmas[i]), colour: COLOURS[i] }));
  const last = rows.length ? rows[rows.length - 1] : null;
  const value = (name) => (last ? last[at(name)] : null);
  const show = (id, names, sigmas) => fillValues(id, AXES.map((a, i) => [a, a, value(names[i]), value(sigmas[i])]));

  const P = ["px_mm", "py_mm", "pz_mm"], SP = ["spx_mm", "spy_mm", "spz_mm"];
  charts.lever.set(three(P, SP).map((s) => centred(s)), page.span);
  show("lever", P, SP);

  const SR = ["srx_deg", "sry_deg", "srz_deg"];
  const first = at("qw");
  const now = last ? last.slice(first, first + 4) : [1, 0, 0, 0];
  const turns = rows.map((r) => turnFrom(now, r.slice(first, first + 4)));
  charts.rotation.set(AXES.map((_, i) => ({ t, v: turns.map((r) => r[i]), s: column(SR[i]), colour: COLOURS[i] })), page.span);
  const angles = last ? yawPitchRoll(now) : [null, null, null];
  const sigmas = last ? anglesSigma(now, SR.map(value)) : [0, 0, 0];
  fillValues("rotation", ["yaw", "pitch", "roll"].map((name, i) => [name, "one", angles[i], sigmas[i]]));

  charts.shift.set([{ t, v: column("shift_ms"), s: column("sshift_ms"), colour: "--one" }], page.span);
  fillValues("shift", [["", "one", value("shift_ms"), value("sshift_ms")]]);
  charts.nis.set([{ t, v: column("nis"), s: null, colour: "--one" }], page.span);
  const latest = page.latest[page.camera];
  fillValues("nis", latest ? [["NIS", "one", round(latest.nis, 3), 0], ["rejected %", "one", round(100 * (latest.rejected || 0), 3), 0]] : []);
  if (latest) $("nis").lastChild.append(element("span", "s", " %"));

  const G = ["gx_mrad", "gy_mrad", "gz_mrad"], SG = ["sgx_mrad", "sgy_mrad", "sgz_mrad"];
  charts.gyro.set(three(G, SG), page.span);
  show("gyro", G, SG);
  const A = ["ax_mm", "ay_mm", "az_mm"], SA = ["sax_mm", "say_mm", "saz_mm"];
  charts.accel.set(three(A, SA), page.span);
  show("accel", A, SA);
}

function centred(series) { // relative to the newest value, so that three axes share one scale
  const end = series.v.length ? series.v[series.v.length - 1] : 0;
  return Object.assign({}, series, { v: series.v.map((v) => (v === null ? null : v - end)) });
}

function round(value, digits) {
  return value === null || value === undefined ? null : Number(value.toPrecision(digits));
}

function faultOf(latest) { // that of another camera does not keep this one from being calibrated
  return latest ? latest.fault : page.fault;
}

function drawWords() {
  const latest = page.latest[page.camera];
  const status = latest ? latest.status : "waiting"; // "stale" when the estimates have stopped
  if (page.status && status === "converged" && page.status !== status) meters.cue(1320);
  page.status = status;
  const fault = faultOf(latest); // what does not work comes before any advice
  $("status").className = `pill ${fault ? "fault" : status}`;
  document.querySelector("main").classList.toggle("stale", status === "stale");
  setText("status", fault ? "fault" : status === "stale" ? `stale, ${latest.age_s.toFixed(0)} s old` : latest && status === "converging" ? `${status} ${Math.round(100 * (latest.progress || 0))} %` : status);
  document.querySelector(".say").classList.toggle("converged", status === "converged" || status === "holds");
  document.querySelector(".say").classList.toggle("fault", Boolean(fault));
  const headline = latest ? latest.headline : "No estimate yet: the calibrate process is starting, or it does not run.";
  setText("headline", fault ? fault.headline : headline);
  setText("guidance", fault ? fault.message : latest ? latest.guidance : "");
  // Spoken when it changes; the pill changes with every second or per cent.
  setText("spoken", fault ? `${fault.headline} ${fault.message}` : [status, latest ? latest.guidance : ""].filter(Boolean).join(": "));
  setText("reason", fault ? `Calibration: ${headline}` : latest ? latest.reason : "");
  $("bar").style.width = `${Math.round(100 * ((latest && latest.progress) || 0))}%`;
  setText("facts", latest ? `${(latest.duration_s || 0).toFixed(0)} s of data · ${latest.frames} frames · ${latest.imu_samples} IMU samples · ± is 1 sigma` : "");
  const withheld = latest ? latest.withheld : [];
  $("withheld").replaceChildren(...withheld.map((line) => element("li", "", line)));
  const news = latest ? latest.events.slice().reverse() : [];
  $("news").replaceChildren(...news.map((event) => element("li", "", event.t_s === null ? event.text : `${event.t_s.toFixed(0)} s: ${event.text}`)));
  const motion = latest ? latest.motion : { rotate: [], translate: [], edges: [], caption: "" };
  for (const edge of document.querySelectorAll(".edge")) edge.classList.toggle("wanted", motion.edges.some((name) => edge.classList.contains(name)));
  for (const axis of AXES) {
    $(`axis-${axis}`).classList.toggle("rotate", motion.rotate.includes(axis));
    $(`axis-${axis}`).classList.toggle("move", motion.translate.includes(axis));
  }
  setText("motiontext", motion.caption);
  const lens = latest && latest.lens;
  setText("lens", lens ? lensText(lens) : "not known yet");
}

function lensText(lens) {
  const names = ["fx", "fy", "cx", "cy"];
  const parts = lens.intrinsics.map((v, i) => `${names[i]} ${shown(v, lens.intrinsics_sigma[i]).join(" ")}`.trim());
  const bend = lens.distortion.map((v) => (v === null ? "–" : v.toPrecision(4))).join(", ");
  return `${parts.join(" · ")} px · ${lens.distortion_model} ${bend} · reprojection RMS ${round(lens.rms_px, 3)} px`;
}

function drawDevices() {
  const body = $("devices").tBodies[0];
  body.replaceChildren(...page.devices.map((d) => {
    const line = element("tr");
    const dot = element("span", `dot l${d.level}`);
    dot.title = ["ok", "warning", "error", "stale"][d.level];
    dot.setAttribute("role", "img");
    dot.setAttribute("aria-label", dot.title);
    const first = element("td");
    first.append(dot);
    const lost = d.values.lost !== undefined ? d.values.lost : d.values.dropped;
    const rate = d.values.rate_hz !== undefined ? Number(d.values.rate_hz).toFixed(1) : "";
    const jitter = d.values.jitter_us !== undefined ? Number(d.values.jitter_us).toFixed(0) : "";
    const figures = [["rate, Hz", rate], ["lost", lost === undefined ? "" : lost], ["jitter, µs", jitter]].map(([label, text]) => {
      const cell = element("td", "n", text);
      cell.dataset.label = label; // shown instead of the heading where the page is narrow
      return cell;
    });
    line.append(first, element("td", "name", d.name), element("td", "says", d.message), ...figures);
    return line;
  }));
}

function drawTabs() {
  const names = [...new Set([...page.views, ...Object.keys(page.latest)])].sort();
  if (page.camera === null && names.length) choose(names[0]);
  for (const tab of $("tabs").children) tab.classList.toggle("bad", Boolean(page.latest[tab.textContent]?.fault));
  if ($("tabs").dataset.names === names.join()) return;
  $("tabs").dataset.names = names.join();
  $("tabs").replaceChildren(...(names.length > 1 ? names.map((name) => {
    const button = element("button", "", name);
    button.setAttribute("role", "tab");
    button.onclick = () => { choose(name); draw(); };
    return button;
  }) : []));
  selectTab();
}

function selectTab() {
  for (const tab of $("tabs").children) {
    tab.setAttribute("aria-selected", String(tab.textContent === page.camera));
    tab.tabIndex = tab.textContent === page.camera ? 0 : -1;
  }
}

const PATH = 60; // poses kept: 24 s
const scene = new Scene($("scene"));
sceneButtons(scene, document.querySelector(".space"));

function keepSights(sights, full) { // a full message has the path, later ones the newest pose
  page.sights = sights;
  for (const [name, sight] of Object.entries(sights)) {
    if (full) page.paths[name] = sight.path;
    else if (sight.pose) page.paths[name] = (page.paths[name] || []).concat([sight.pose]).slice(-PATH);
  }
}

function drawSight() {
  const sight = page.sights[page.camera], latest = page.latest[page.camera];
  // No advice with a fault or old values, and none that contradicts "no more motion needed".
  const quiet = faultOf(latest) || !latest || latest.stale || (["converged", "holds", "changed"].includes(latest.status) && !latest.guidance);
  camera.coverage = sight ? sight.coverage : null;
  camera.setWanted(sight && sight.wanted && !quiet ? sight.wanted : null);
  const fault = faultOf(latest), gone = Boolean(fault) && fault.name === `camera/${page.camera}`;
  camera.setGone(gone);
  meters.sight(gone ? null : sight, gone ? null : camera.last && camera.last.light);
  meters.draw(latest && latest.meters ? latest.meters : []);
  drawStored(latest ? latest.stored : null);
  document.querySelector(".space").hidden = !(latest && latest.rig); // nothing to draw yet
  const path = page.paths[page.camera] || [], board = sight && sight.board;
  if (latest && latest.rig) scene.set({ rig: latest.rig, board: board || undefined, path: board && path.length ? path : undefined });
  for (const button of document.querySelectorAll("button[data-room='1']")) button.disabled = !(board && path.length);
}

function choose(name) {
  page.camera = name;
  selectTab();
  camera.look(page.views.includes(name) ? name : null);
}

function draw() {
  drawTabs();
  drawWords();
  drawDevices();
  if (!document.hidden) drawCharts(); // nine tenths of the work
  drawSight();
}

// The robot itself is silent: nobody else can say here that what is shown is old.
function watchSilence() {
  const silent = performance.now() - page.heard;
  if (!page.heard || silent < SILENT_MS) return;
  for (const latest of Object.values(page.latest)) {
    if (latest.heardAge === undefined) latest.heardAge = latest.age_s;
    Object.assign(latest, { status: "stale", stale: true, age_s: latest.heardAge + silent / 1000,
      headline: `The robot has not answered for ${(silent / 1000).toFixed(0)} s.`, guidance: "",
      reason: `The values are old; the last status was ${latest.last_status}.` });
  }
  drawWords();
  if (Math.min(silent, performance.now() - page.asked) > DEAD_MS) connectAnew();
}

function thinned(rows) { // as in web/state.py
  const gaps = [];
  for (let i = 1; i < rows.length >> 1; i += 2) gaps.push([rows[i + 1][0] - rows[i - 1][0], i]);
  const gone = new Set(gaps.sort((a, b) => a[0] - b[0]).slice(0, gaps.length >> 1).map(([, i]) => i));
  return rows.filter((_, i) => !gone.has(i));
}

function take(message, full) {
  page.heard = performance.now();
  page.heardAt = Date.now();
  setText("rig", message.rig);
  document.title = `vical ${message.rig}`;
  if (full) {
    page.columns = message.columns;
    page.views = message.views;
    page.rows = {};
    page.latest = {};
    page.control = message.control;
    $("control").hidden = !message.control;
  }
  for (const [name, camera] of Object.entries(message.cameras)) {
    page.rows[name] = camera.rows || (page.rows[name] || []).concat(camera.fresh);
    if (page.rows[name].length > ROWS) page.rows[name] = thinned(page.rows[name]);
    page.latest[name] = camera;
  }
  page.devices = message.devices;
  page.fault = message.fault;
  keepSights(message.sights || {}, full);
  draw();
}

function listen() {
  page.asked = performance.now();
  const source = page.source = new EventSource("events");
  source.addEventListener("full", (event) => take(JSON.parse(event.data), true));
  source.addEventListener("update", (event) => take(JSON.parse(event.data), false));
  source.onopen = () => {
    $("link").classList.add("on");
    setText("link", "live");
  };
  source.onerror = () => { $("link").classList.remove("on"); setText("link", "offline, trying again"); again(source, listen); };
}

// The browser connects again by itself, but not after an answer like 502 of a proxy while the robot restarts.
function again(source, connect) {
  if (source.readyState === EventSource.CLOSED) setTimeout(connect, AGAIN_MS);
}

function connectAnew() {
  page.source?.close();
  $("link").classList.remove("on");
  setText("link", "offline, trying again");
  listen();
  if (camera.name !== null) camera.connect();
}

// A clock of the page may stand still while a phone sleeps; the wall clock does not.
document.addEventListener("visibilitychange", () => {
  if (document.hidden || !page.heard) return;
  if (Math.abs(Date.now() - page.heardAt) > SILENT_MS) connectAnew(); // a clock that is set back counts, too
  drawCharts();
});

// A page that the browser keeps for its back button would keep its connections, of which there are six a host.
window.addEventListener("pagehide", () => { page.source?.close(); camera.source?.close(); });
window.addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });

for (const button of document.querySelectorAll(".range button")) {
  button.onclick = () => {
    page.span = Number(button.dataset.span);
    for (const other of document.querySelectorAll(".range button")) press(other, other === button);
    drawCharts();
  };
  press(button, button.classList.contains("on"));
}

$("tabs").onkeydown = (event) => { // one tab stop; arrows change the camera
  const tabs = [...$("tabs").children], step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step || !tabs.length) return;
  const next = tabs[(tabs.indexOf(document.activeElement) + step + tabs.length) % tabs.length];
  next.click();
  next.focus();
};

window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawCharts(); scene.draw(); });
setInterval(watchSilence, 1000);
document.addEventListener("DOMContentLoaded", listen); // when meters.js and decide.js have been read, too
