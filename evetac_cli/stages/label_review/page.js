"use strict";
// The page of a review: the data around an onset, and the verdicts; all text is inserted as text.
const $ = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const LEFT = 44, RIGHT = 8, LOW = 4;  // margins of a chart in px
const SCALED_MS = 12;
let trial = null, number = 0, at = 0, earliest = -1, latest = -1, timer = 0, asked = 0;

function unpack(text, kind) {
  const bytes = Uint8Array.from(atob(text || ""), (letter) => letter.charCodeAt(0));
  return new kind(bytes.buffer);
}

async function load(which, where) {
  const mine = ++asked;
  pause();
  $("answer").textContent = "";
  const answer = await fetch(`trial?n=${which}${where === undefined ? "" : `&at=${where}`}`);
  const data = answer.ok ? await answer.json() : { error: `the server answered with status ${answer.status}`, n: which, of: 0 };
  if (mine !== asked) return;
  number = data.n;
  $("name").textContent = data.name || "evetac label review";
  document.title = `${data.name || "evetac"} – label review`;
  $("which").textContent = `${data.n + 1} of ${data.of}`;
  $("who").textContent = `labels by ${data.by}`;
  $("previous").disabled = number <= 0;
  $("next").disabled = number >= data.of - 1;
  if (data.error) {
    trial = null;
    for (const button of document.querySelectorAll("main button, main input")) button.disabled = true;
    return say(data.error, true);
  }
  const moved = trial && where !== undefined;
  trial = data;
  for (const button of document.querySelectorAll("main button, main input")) button.disabled = false;
  for (const [name, kind] of [["x", Uint16Array], ["y", Uint16Array], ["p", Uint8Array]]) trial[name] = unpack(trial[name], kind);
  if (trial.dots) { trial.rest = unpack(trial.rest, Float32Array); trial.at = unpack(trial.at, Float32Array); }
  for (const part of document.querySelectorAll("[data-for=dots]")) part.hidden = !trial.dots;
  for (const part of document.querySelectorAll("[data-for=flow]")) part.hidden = !trial.flow;
  $("simulated").hidden = !trial.simulated;
  [$("image").width, $("image").height] = trial.frame;
  $("begins").textContent = `${trial.span[0]} ms`;
  $("ends").textContent = `${trial.span[1] - 1} ms`;
  $("slider").min = trial.span[0];
  $("slider").max = trial.span[1] - 1;
  const label = trial.label;
  if (!moved) {
    earliest = latest = -1;
    at = label.onset_ms === null ? Math.floor((trial.span[0] + trial.span[1]) / 2) : label.onset_ms;
  } else at = where;
  stands(label);
  go(at);
}

function stands(label) {
  const place = $("stands");
  place.replaceChildren();
  const add = (text, kind, name) => { const part = document.createElement(kind || "span"); part.textContent = text; if (name) part.className = name; place.append(part); };
  if (label.method === null) return add("There are no labels, and none can be computed for this recording: set the onset yourself.");
  add(label.kept ? "Labels: " : "Computed, not saved yet: ");
  add(label.onset_ms === null ? "no slip" : `${label.onset_ms} ms`, "b");
  if (label.earliest_ms !== null) add(`, within ${label.earliest_ms} to ${label.latest_ms} ms`);
  add(`, by ${label.method === "person" ? label.by : label.method}${label.kept && label.at ? `, ${label.at.replace("T", " ").replace("Z", " UTC")}` : ""}. `);
  if (label.doubt) add(`The labels abstain: ${label.doubt}.`, "span", "doubt");
}

function say(text, bad) {
  $("answer").textContent = text;
  $("answer").classList.toggle("bad", Boolean(bad));
}

function go(to) {
  if (!trial) return;
  at = Math.min(Math.max(Math.round(to), trial.span[0]), trial.span[1] - 1);
  $("slider").value = at;
  $("at").textContent = `${at} ms`;
  $("interval").textContent = earliest < 0 && latest < 0 ? "" : `within ${earliest < 0 ? at : earliest} to ${latest < 0 ? at : latest} ms`;
  draw();
}

function sized(canvas) {
  const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
  const width = Math.round(box.width * ratio), height = Math.round(box.height * ratio);
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  return [pen, box.width, box.height];
}

function x_of(slice, width) {
  const [first, stop] = trial.span;
  return LEFT + (slice - first + 0.5) / (stop - first) * (width - LEFT - RIGHT);
}

function chart(canvas) {
  const values = trial[canvas.dataset.series];
  if (!values || canvas.closest("[hidden]")) return;
  const [pen, width, height] = sized(canvas);
  // the later slide is a hundred times as fast: the scale is set by values up to shortly after the chosen slice
  const known = values.slice(0, Math.max(at - trial.span[0] + SCALED_MS, SCALED_MS)).filter((value) => value !== null);
  const low = Math.min(0, ...known), high = Math.max(low + 1e-3, ...known);
  const y_of = (value) => LOW + (1 - (value - low) / (high - low)) * (height - 2 * LOW);
  const [first] = trial.span, label = trial.label;
  pen.fillStyle = colour("band");
  const band = (from, to) => pen.fillRect(x_of(from - 0.5, width), 0, x_of(to + 0.5, width) - x_of(from - 0.5, width), height);
  if (label.earliest_ms !== null) band(label.earliest_ms, label.latest_ms);
  if (earliest >= 0 || latest >= 0) band(earliest < 0 ? at : earliest, latest < 0 ? at : latest);
  pen.strokeStyle = colour("rule");
  pen.beginPath();
  pen.moveTo(LEFT, y_of(0));
  pen.lineTo(width - RIGHT, y_of(0));
  pen.stroke();
  pen.fillStyle = colour("quiet");
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "right";
  pen.textBaseline = "top";
  pen.fillText(high >= 100 ? Math.round(high) : high.toPrecision(2), LEFT - 6, 0);
  pen.textBaseline = "bottom";
  pen.fillText("0", LEFT - 6, Math.min(y_of(0) + 6, height));
  pen.save();
  pen.beginPath();
  pen.rect(LEFT, 0, width - LEFT - RIGHT, height);
  pen.clip();
  pen.strokeStyle = colour("accent");
  pen.lineWidth = 1.5;
  pen.beginPath();
  let drawing = false;
  values.forEach((value, place) => {
    if (value === null) { drawing = false; return; }
    pen[drawing ? "lineTo" : "moveTo"](x_of(first + place, width), y_of(value));
    drawing = true;
  });
  pen.stroke();
  if (label.onset_ms !== null) line(pen, x_of(label.onset_ms, width), height, colour("quiet"), [3, 3]);
  line(pen, x_of(at, width), height, colour("second"), []);
  pen.restore();
}

function line(pen, x, height, ink, dash) {
  pen.strokeStyle = ink;
  pen.lineWidth = dash.length ? 1 : 2;
  pen.setLineDash(dash);
  pen.beginPath();
  pen.moveTo(x, 0);
  pen.lineTo(x, height);
  pen.stroke();
  pen.setLineDash([]);
}

function overview() {
  const [pen, width, height] = sized($("overview"));
  const { ms, events } = trial.overview, most = Math.max(1, ...events), step = width / trial.slices;
  pen.fillStyle = colour("band");
  pen.fillRect(trial.span[0] * step, 0, (trial.span[1] - trial.span[0]) * step, height);
  pen.fillStyle = colour("accent");
  events.forEach((count, place) => {
    const tall = Math.sqrt(count / most) * (height - 2);
    pen.fillRect(place * ms * step, height - tall, Math.max(ms * step, 0.7), tall);
  });
  line(pen, at * step, height, colour("second"), []);
}

function image() {
  const pen = $("image").getContext("2d"), [width, height] = trial.frame, pixels = pen.createImageData(width, height);
  for (let k = 0; k < pixels.data.length; k += 4) pixels.data.set([16, 19, 22, 255], k);
  const place = at - trial.span[0], first = Math.max(place + 1 - Number($("last").value), 0);
  for (let k = trial.starts[first]; k < trial.starts[place + 1]; k++) {
    if (trial.x[k] >= width || trial.y[k] >= height) continue;
    pixels.data.set(trial.p[k] ? [255, 177, 78, 255] : [78, 163, 255, 255], 4 * (trial.y[k] * width + trial.x[k]));
  }
  pen.putImageData(pixels, 0, 0);
  pen.lineWidth = 2;
  if (trial.window) {
    const [x0, y0, x1, y1] = trial.window;
    pen.strokeStyle = "#ffffff66";
    pen.strokeRect(x0 + 1, y0 + 1, x1 - x0 - 2, y1 - y0 - 2);
  }
  const longer = Number($("arrows").value);
  for (let dot = 0; dot < trial.dots; dot++) {
    const [rest_x, rest_y] = [trial.rest[2 * dot], trial.rest[2 * dot + 1]];
    const x = trial.at[2 * (place * trial.dots + dot)], y = trial.at[2 * (place * trial.dots + dot) + 1];
    if (!Number.isFinite(x)) continue;
    pen.strokeStyle = "#5be584";
    pen.beginPath();
    pen.arc(x, y, trial.radius, 0, 7);
    pen.stroke();
    if (!longer) continue;
    pen.beginPath();
    pen.moveTo(rest_x, rest_y);
    pen.lineTo(rest_x + longer * (x - rest_x), rest_y + longer * (y - rest_y));
    pen.stroke();
  }
}

function draw() {
  if (!trial) return;
  image();
  for (const canvas of document.querySelectorAll("#charts canvas")) chart(canvas);
  overview();
}

function drag(event) {
  if (!trial || (event.type === "pointermove" && !event.buttons)) return;
  if (event.type === "pointerdown") event.target.setPointerCapture(event.pointerId);
  const box = event.target.getBoundingClientRect(), [first, stop] = trial.span;
  go(first + (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT) * (stop - first) - 0.5);
}

async function send(where, what) {
  try {
    const answer = await fetch(where, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(what) });
    return answer.ok ? answer.json() : { error: `the program refused (${answer.status})` };
  } catch {
    return { error: "the program that serves this page is no longer running" };
  }
}

async function keep(onset, can_tell) {
  if (!trial) return;
  const interval = onset >= 0 && (earliest >= 0 || latest >= 0);
  const verdict = { n: number, onset, can_tell, earliest: interval ? Math.min(earliest < 0 ? onset : earliest, onset) : -1,
                    latest: interval ? Math.max(latest < 0 ? onset : latest, onset) : -1 };
  const answer = await send("keep", verdict);
  if (answer.error) return say(answer.error, true);
  await load(number, onset >= 0 ? onset : at);
  say(onset < 0 ? "Kept: no slip." : `Kept: ${onset} ms${can_tell ? "" : ", uncertain"}.`);
}

async function done() {
  const answer = await send("done", {});
  if (answer.error) return say(answer.error, true);
  trial = null;
  document.querySelector("main").replaceChildren(Object.assign(document.createElement("p"), { className: "card", textContent: `The review has ended; ${answer.kept} labels were kept. This page can be closed.` }));
  document.querySelector("nav").hidden = true;
}

function pause() {
  clearInterval(timer);
  timer = 0;
  $("play").setAttribute("aria-pressed", "false");
  $("play").textContent = "Play";
}

function play() {
  if (timer) return pause();
  $("play").setAttribute("aria-pressed", "true");
  $("play").textContent = "Hold";
  timer = setInterval(() => (trial && at < trial.span[1] - 1 ? go(at + 1) : pause()), 100);
}

function bound(which) {
  if (which === "from") { earliest = at; if (latest >= 0 && latest < at) latest = -1; }
  else { latest = at; if (earliest > at) earliest = -1; }
  go(at);
}

const KEYS = {
  ArrowLeft: (event) => go(at - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => go(at + (event.shiftKey ? 10 : 1)),
  PageUp: () => number > 0 && load(number - 1),
  PageDown: () => !$("next").disabled && load(number + 1),
  Enter: () => keep(at, true), u: () => keep(at, false), n: () => keep(-1, true), " ": play,
  "[": () => bound("from"), "]": () => bound("to"),
};
document.addEventListener("keydown", (event) => {
  const own = event.target.closest("button, select");
  if (event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key] || (own && ["Enter", " ", "ArrowLeft", "ArrowRight"].includes(event.key))) return;
  event.preventDefault();
  KEYS[event.key](event);
});
for (const canvas of document.querySelectorAll("#charts canvas")) for (const kind of ["pointerdown", "pointermove"]) canvas.addEventListener(kind, drag);
$("overview").addEventListener("click", (event) => {
  if (!trial) return;
  const box = event.target.getBoundingClientRect();
  load(number, Math.min(Math.max(Math.round((event.clientX - box.left) / box.width * trial.slices), 0), trial.slices - 1));
});
$("slider").addEventListener("input", () => go(Number($("slider").value)));
for (const [id, act] of Object.entries({
  previous: () => load(number - 1), next: () => load(number + 1), done, play, keep: () => keep(at, true), unsure: () => keep(at, false),
  none: () => keep(-1, true), from: () => bound("from"), to: () => bound("to"), clear: () => { earliest = latest = -1; go(at); } }))
  $(id).addEventListener("click", act);
for (const id of ["last", "arrows"]) $(id).addEventListener("change", draw);
window.addEventListener("resize", draw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
load(0);
