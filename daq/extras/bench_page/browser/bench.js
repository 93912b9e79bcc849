// Connects the page with the bench, and passes each message to the parts of the page.
"use strict";

const $ = (name) => document.getElementById(name);
let socket = null, frozen = false, messages = 0, sent = 0, channels = [], histories = null, spectra = null;
const shownScales = new Map();
const VISIBLE_PART = 0.1; // of the limit of a channel
const HARMONICS = 5; // multiple of the highest frequency of a test to which spectra are shown

function make(parent, tag, content = "") {
  const element = document.createElement(tag);
  element.textContent = content;
  return parent.appendChild(element);
}

function setText(name, content) {
  if ($(name).textContent !== content) $(name).textContent = content;
}

function fillTable(table, rows) {
  table.replaceChildren();
  rows.forEach((cells, k) => { const row = make(table, "tr"); cells.forEach((cell) => make(row, k ? "td" : "th", cell.replace(/(^|\s|~)-(?=\d)/g, "$1−")).classList.toggle("uncertain", cell.startsWith("~"))); });
}

function send(name, value = null) {
  if (socket?.readyState !== WebSocket.OPEN) return;
  sent++;
  socket.send(JSON.stringify([name, value]));
}

function freeze() {
  frozen = !frozen;
  $("frozen").hidden = !frozen;
  $("freeze").classList.toggle("on", frozen);
}

// A message is the length of a JSON text, the text with the shapes of the arrays, and the values of the arrays.
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const content = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  for (const [name, shape] of Object.entries(content.arrays)) {
    const columns = shape[shape.length - 1];
    content.arrays[name] = Array.from({ length: shape.length > 1 ? shape[0] : 1 }, (_, k) => new Float32Array(buffer, offset + 4 * k * columns, columns));
    offset += 4 * shape.reduce((product, size) => product * size, 1);
  }
  return content;
}

function fillLegend(legend, shown) {
  for (const { name, color } of shown) {
    const entry = make(legend, "span");
    entry.dataset.name = name;
    make(entry, "i").style.background = color;
    entry.append(name);
  }
}

// The channels of each unit; a hammer has a panel of its own, because its pulse would hide other forces.
function groups() {
  const grouped = new Map();
  channels.forEach((channel, row) => {
    const key = channel.at === "hammer" ? "hammer" : channel.unit;
    if (!grouped.has(key)) grouped.set(key, { key, ...quantity(channel.unit), rows: [] });
    grouped.get(key).rows.push(row);
  });
  return [...grouped.values()];
}

// A scale grows immediately and shrinks after 2 s, so that the chart does not jump.
function steady(key, [low, high]) {
  const now = performance.now(), shown = shownScales.get(key);
  if (!shown || high > shown.high || low < shown.low || now - shown.time > 2000) shownScales.set(key, { low, high, time: now });
  else if (high === shown.high) shown.time = now;
  return [shownScales.get(key).low, shownScales.get(key).high];
}

const AXIS_QUANTITIES = { "µm": "displacement / ", mm: "displacement / ", g: "acceleration / ", N: "force / " };

// A panel has the unit mm if its axis would end above 1000 µm.
function inMillimeters(panel) {
  if (panel.name !== "µm" || panel.range[1] <= 1000) return panel;
  const curves = panel.curves.map((curve) => ({ ...curve, y: curve.y.map((value) => value / 1000) }));
  return { ...panel, name: "mm", range: panel.range.map((end) => end / 1000), curves };
}

function panels(kind, x, values, log) {
  return groups().map(({ key, name, factor, smallest, rows }) => {
    // Bodies are in front of tables, which would hide them.
    const curves = [...rows].sort((a, b) => Boolean(channels[a].responds) - Boolean(channels[b].responds)).map((row) => ({ x, y: values[row].map((value) => factor * value), color: channels[row].color, width: 1.4 }));
    // Dashed: the limit of overloaded channels, unless it would hide a small motion.
    const isNear = (row) => values[row].some((value) => Math.abs(value) > VISIBLE_PART * channels[row].limit);
    const over = kind === "history" ? rows.filter((row) => channels[row].limit != null && isOver(channels[row].name) && isNear(row)) : [];
    for (const limit of new Set(over.map((row) => factor * channels[row].limit))) {
      for (const y of [-limit, limit]) curves.push({ x: [x[0], x[x.length - 1]], y: Float32Array.of(y, y), color: AMBER, width: 1.2, dash: [5, 4] });
    }
    // Idle noise must not fill an axis: its end is at least 1e-4 of the full scale of a channel (-80 dB).
    const idle = roundUp(Math.max(smallest, ...rows.map((row) => 1e-4 * factor * (channels[row].limit ?? 0))));
    const panel = { name, log, smallest: idle, share: rows.length > 1 ? 2 : 1, curves };
    const [low, high] = limits(panel);
    // A spectrum shows five decades, so that noise is visible.
    panel.range = steady(`${kind} ${key}`, log ? [Math.max(high, idle) * 1e-5, Math.max(high, idle)] : [low, high]);
    const shown = inMillimeters(panel);
    return { ...shown, name: `${AXIS_QUANTITIES[shown.name] ?? ""}${shown.name}` };
  });
}

function showCurves({ arrays, span }) {
  const columns = arrays.history[0].length / 2;
  const time = Float32Array.from({ length: 2 * columns }, (_, k) => -span * (1 - (Math.floor(k / 2) + 0.5) / columns));
  histories.show([-span, 0], panels("history", time, arrays.history, false));
  if (!arrays.spectra) return;
  const frequency = arrays.spectrum_frequency[0];
  // Above the harmonics of a test there is only noise.
  const highest = Math.min(frequency[frequency.length - 1], response.band ? HARMONICS * response.band[1] : Infinity);
  const shown = frequency.findLastIndex((value) => value <= highest) + 1;
  spectra.show([frequency[0], frequency[shown - 1]], panels("spectrum", frequency.subarray(0, shown), arrays.spectra.map((row) => row.subarray(0, shown)), true));
}

function receive(content) {
  if (content.description) {
    if (channels.length) return;
    channels = content.description.channels;
    histories = new Chart($("history"), { name: "time / s", log: false });
    spectra = new Chart($("spectrum"), { name: "frequency / Hz", log: true });
    fillLegend($("history-legend"), channels);
    response.start(channels, content.description.is_linear);
    levels.start(channels);
    for (const part of [controls, bar, rig]) part.start(content.description);
  } else if (content.theory !== undefined) {
    response.setTheory(content);
  } else {
    // Texts and bars need no more than 10 updates a second. A state from before the last command would undo its effect.
    if (messages++ % 2 === 0 && content.obeyed === sent) {
      $("controls").inert = false;
      for (const part of [controls, bar, levels]) part.update(content);
    }
    if (frozen) return;
    rig.update(content);
    response.update(content);
    showCurves(content);
  }
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  sent = 0;
  socket.addEventListener("message", (event) => receive(unpack(event.data)));
  socket.addEventListener("close", () => {
    $("controls").inert = true;
    setText("message", "the bench has ended, or the connection is lost; connecting again");
    setTimeout(connect, 2000);
  });
}

connect();
