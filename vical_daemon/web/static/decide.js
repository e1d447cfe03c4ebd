"use strict";
// Decide: the result next to the stored one, accept, discard, reset, recording, exports, the log. All need the token.

const FORMATS = ["kalibr", "ros", "opencv", "openvins", "vins", "orbslam3", "basalt", "urdf", "json"];
const QUESTIONS = {
  reset: "Forget the calibration so far and start over?",
  accept: "Store the present result as the calibration of these devices?",
  discard: "Forget the present result, and put back what was stored before?",
};

function drawStored(stored) {
  $("stored").hidden = !stored;
  if (!stored) return;
  const when = new Date(Number(stored.t_ns) / 1e6);
  setText("storedwhen", `stored one: ${when.toLocaleString()}`);
  const largest = Math.max(...stored.rows.map(([, , , sigmas]) => (sigmas === null ? Infinity : sigmas)));
  setText("storedsays", largest < 3 ? "No component differs by more than 3 joint sigmas." : `The largest difference is ${largest.toFixed(1)} joint sigmas.`);
  $("storedrows").replaceChildren(...stored.rows.map(([name, value, sigma, sigmas, unit]) => {
    const line = element("tr");
    const [number, band] = shown(value, sigma);
    line.append(element("td", "", name), element("td", "n", `${number} ${band} ${unit}`), element("td", sigmas >= 3 ? "n far" : "n", sigmas === null ? "" : `${sigmas.toFixed(1)} σ`));
    return line;
  }));
}

async function ask(path, options = {}) {
  sessionStorage.setItem("token", $("token").value);
  const headers = Object.assign({ Authorization: `Bearer ${$("token").value}` }, options.headers);
  try {
    const answer = await fetch(path, Object.assign({}, options, { headers }));
    if (answer.ok) return answer;
    setText("answer", await answer.text());
  } catch (error) {
    setText("answer", "the robot does not answer");
  }
  return null;
}

async function download(path) {
  const answer = await ask(path);
  if (!answer) return;
  const name = /filename="([^"]+)"/.exec(answer.headers.get("Content-Disposition") || "");
  const link = element("a");
  link.href = URL.createObjectURL(await answer.blob());
  link.download = name ? name[1] : "vical";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  setText("answer", `saved: ${link.download}`);
}

$("token").value = sessionStorage.getItem("token") || "";
// Enter would press the first button: accept.
$("token").onkeydown = (event) => { if (event.key === "Enter") event.preventDefault(); };
$("format").replaceChildren(...FORMATS.map((name) => element("option", "", name)));
$("export").onclick = () => download(`api/export/${$("format").value}`);
$("log").onclick = () => download("api/log");
$("form").onsubmit = async (event) => {
  event.preventDefault();
  const command = event.submitter ? event.submitter.value : "";
  if (command in QUESTIONS && !window.confirm(QUESTIONS[command])) return;
  const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ command }) };
  if (await ask("api/command", options)) setText("answer", `sent: ${command.replace("_", " ")}`);
};
