// SPDX-License-Identifier: Apache-2.0
"use strict";
const held = JSON.parse(document.getElementById("report-data").textContent);
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const methodColour = (row) => colour(`method-${row % 6}`);
const agentColour = (row) => colour(`agent-${row % 6}`);
const NARROW = 600;
/** Name of the method of each row; several rows have one where there are several classes. */
const methodNames = held.methods.map((m) => m.name), uniqueNames = [...new Set(methodNames)];

/** Set a canvas to its width on the page and a height, and return its context in CSS pixels. */
function prepare(canvas, height) {
  const scale = window.devicePixelRatio || 1, width = canvas.clientWidth;
  canvas.style.height = `${height}px`;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  return pen;
}

function addKeys(list, entries) {
  list.replaceChildren(...entries.map(([kind, ink, text]) => {
    const item = document.createElement("li"), mark = document.createElement("i");
    mark.className = kind;
    if (kind === "box" || kind === "dashed") mark.style.borderColor = ink; else mark.style.background = ink;
    item.append(mark, text);
    return item;
  }));
}

// Plots of methods

/** Methods as points of AP over bytes; those that send nothing stand at the left edge. */
function drawBytes() {
  const canvas = byId("plot-bytes"), rows = held.methods.filter((m) => m.ap !== null);
  const pen = prepare(canvas, 230), width = canvas.clientWidth;
  if (!rows.length) return;
  const left = 40, right = width - 14, top = 14, bottom = 190;
  const sent = rows.filter((m) => m.bytes > 0).map((m) => Math.log2(m.bytes));
  const low = Math.floor(Math.min(...sent, 10)) - 1, high = Math.ceil(Math.max(...sent, 12)) + 1;
  const values = rows.flatMap((m) => [m.ap, ...(m.interval || [])]);
  const y0 = Math.max(0, Math.floor(10 * Math.min(...values) - 0.3) / 10), y1 = Math.min(1, Math.ceil(10 * Math.max(...values) + 0.1) / 10);
  const toX = (bytes) => bytes > 0 ? left + 34 + (right - left - 34) * (Math.log2(bytes) - low) / (high - low) : left + 10;
  const toY = (ap) => bottom - (bottom - top) * (ap - y0) / (y1 - y0 || 1);
  pen.strokeStyle = colour("line");
  pen.fillStyle = colour("soft");
  pen.textAlign = "right";
  const step = y1 - y0 > 0.5 ? 0.2 : 0.1;
  for (let ap = y0; ap <= y1 + 1e-9; ap += step) {
    pen.beginPath(); pen.moveTo(left, toY(ap)); pen.lineTo(right, toY(ap)); pen.stroke();
    pen.fillText(ap.toFixed(1), left - 6, toY(ap) + 4);
  }
  pen.textAlign = "center";
  const every = Math.max(1, Math.ceil((high - low) / ((right - left) / 62)));
  for (let power = low + 1; power <= high; power += every) {
    const x = toX(2 ** power);
    if (x > right - 14) break;
    pen.fillText(power >= 10 ? `${2 ** (power - 10)} KiB` : `${2 ** power} B`, x, bottom + 16);
  }
  pen.fillText("none", toX(0), bottom + 16);
  pen.fillText("bytes of a message", (left + right) / 2, bottom + 34);
  const taken = rows.map((m) => ({ y: toY(m.ap) + 4, start: toX(m.bytes) - 6, end: toX(m.bytes) + 6 }));
  rows.forEach((m) => {
    const x = toX(m.bytes), y = toY(m.ap);
    pen.strokeStyle = pen.fillStyle = methodColour(uniqueNames.indexOf(m.name));
    if (m.interval) { pen.beginPath(); pen.moveTo(x, toY(m.interval[0])); pen.lineTo(x, toY(m.interval[1])); pen.stroke(); }
    pen.beginPath(); pen.arc(x, y, 5, 0, 7); pen.fill();
    const length = pen.measureText(m.label).width, onLeft = x + 10 + length > right;
    pen.textAlign = onLeft ? "right" : "left";
    const start = onLeft ? x - 10 - length : x + 10;
    const isFree = (at) => at >= 10 && taken.every((t) => Math.abs(t.y - at) >= 13 || start >= t.end || t.start >= start + length);
    const at = [4, -10, 18, -24, 32, 46].map((offset) => y + offset).find(isFree) ?? y + 60;
    taken.push({ y: at, start, end: start + length });
    pen.fillText(m.label, onLeft ? x - 10 : x + 10, at);
  });
}

/** Middles of the points of the last drawing, CSS pixels. */
let forestPoints = [];

/** Paired differences, one line each: a point and its interval, filled where zero lies outside. */
function drawForest() {
  const canvas = byId("plot-forest"), rows = held.differences, lineHeight = 22, top = 8;
  const isNarrow = canvas.clientWidth < NARROW, height = top + rows.length * lineHeight * (isNarrow ? 1.8 : 1) + 24;
  const pen = prepare(canvas, height), width = canvas.clientWidth;
  const text = rows.map((row) => `${row.label}, ${row.metric}`), bottom = height - 24;
  const left = isNarrow ? 22 : Math.max(...text.map((words) => pen.measureText(words).width)) + 24, right = width - 22;
  const low = Math.min(0, ...rows.map((row) => row.interval[0])), high = Math.max(0, ...rows.map((row) => row.interval[1]));
  const spread = high - low || 1, step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5].find((s) => spread / s <= (isNarrow ? 5 : 8)) || 1;
  const x0 = Math.floor(low / step) * step, x1 = Math.ceil(high / step) * step || step;
  const toX = (value) => left + (right - left) * (value - x0) / (x1 - x0);
  pen.lineWidth = 1; pen.textAlign = "center";
  for (let mark = Math.round(x0 / step); mark <= Math.round(x1 / step); mark += 1) {
    const x = toX(mark * step);
    pen.strokeStyle = colour(mark ? "line" : "ink");
    pen.beginPath(); pen.moveTo(x, top); pen.lineTo(x, bottom); pen.stroke();
    pen.fillStyle = colour("soft");
    pen.fillText((mark > 0 ? "+" : "") + (mark * step).toFixed(2), x, bottom + 16);
  }
  forestPoints = rows.map((row, number) => {
    const y = isNarrow ? top + (number * 1.8 + 1.25) * lineHeight : top + (number + 0.5) * lineHeight;
    pen.fillStyle = colour("ink");
    pen.textAlign = isNarrow ? "left" : "right";
    if (isNarrow) pen.fillText(text[number], 2, y - 12); else pen.fillText(text[number], left - 16, y + 4);
    pen.strokeStyle = pen.fillStyle = colour("accent"); pen.lineWidth = 2;
    pen.beginPath(); pen.moveTo(toX(row.interval[0]), y); pen.lineTo(toX(row.interval[1]), y); pen.stroke();
    pen.beginPath(); pen.arc(toX(row.value), y, 5, 0, 7);
    if (row.interval[0] * row.interval[1] <= 0) pen.fillStyle = colour("paper");
    pen.fill(); pen.stroke();
    return [toX(row.value), y];
  });
}

function showStages() {
  const stages = [["share", "method-2", "share: sender's compute"], ["air", "method-1", "channel: sent to arrived"], ["perceive", "method-0", "perceive: ego's compute"]];
  const rows = held.methods.filter((m, row) => m.perceive !== null && methodNames.indexOf(m.name) === row);
  byId("stages").parentElement.hidden = !rows.length;
  const total = (m) => stages.reduce((sum, [key]) => sum + (m[key] || 0), 0);
  const longest = Math.max(...rows.map(total), 1);
  byId("stages").replaceChildren(...rows.map((m) => {
    const line = document.createElement("div"), name = document.createElement("span"), bar = document.createElement("span");
    const sum = document.createElement("span");
    line.className = "stage-row"; bar.className = "bar"; name.textContent = m.label; sum.textContent = `${total(m).toFixed(0)} ms`;
    for (const [key, ink, words] of stages) {
      if (!m[key]) continue;
      const part = document.createElement("i");
      part.style.width = `${100 * m[key] / longest}%`;
      part.style.background = colour(ink);
      part.title = `${words}, ${m[key].toFixed(1)} ms`;
      bar.append(part);
    }
    line.append(name, bar, sum);
    return line;
  }));
  addKeys(byId("stage-keys"), stages.map(([, ink, words]) => ["", colour(ink), words]));
}

// The player

const player = held.player;
const state = { frame: 0, method: 0, score: null, playing: false, speed: 1, zoom: 1, centre: [0, 0], under: null };
const decoded = new Map();

/** Cell numbers of one agent's points: differences as variable-length integers. */
function decodeCells(text) {
  if (decoded.has(text)) return decoded.get(text);
  const bytes = atob(text), cells = [];
  let value = 0, shift = 0, last = 0;
  for (let i = 0; i < bytes.length; i++) {
    const byte = bytes.charCodeAt(i);
    value += (byte & 127) * 2 ** shift;
    shift += 7;
    if (byte < 128) { last += value; cells.push(last); value = shift = 0; }
  }
  if (decoded.size > 64) decoded.clear();
  decoded.set(text, cells);
  return cells;
}

const scoreOf = (method) => state.score === null ? player.methods[method].score : state.score;

/** What a method found in a frame: true boxes found, and its boxes above the score, in the order x, y, l, w, yaw, score, match, returns. */
function judge(method, frame) {
  const least = 1000 * scoreOf(method), truth = player.frames[frame].truth, found = new Set();
  const boxes = player.methods[method].frames[frame].boxes.filter((box) => box[5] >= least);
  for (const box of boxes) if (box[6] >= 0) found.add(box[6]);
  return { boxes, found, missed: truth.length - found.size, wrong: boxes.filter((box) => box[6] < 0).length };
}

/** Rows of the agents whose returns a method can use: the ego and those whose messages it fused. */
function usable(method, frame) {
  const received = player.methods[method].frames[frame].received;
  return player.frames[frame].agents.map((agent, row) => row === 0 || received.includes(agent[0]));
}

/** Row of the agent with the most returns in a box of those that may be used, -1 where none has any. */
function supplier(returns, may) {
  let best = -1;
  returns.forEach((count, row) => { if (may[row] && count > 0 && (best < 0 || count > returns[best])) best = row; });
  return best;
}

function makeProjection() {
  const canvas = byId("view"), width = canvas.clientWidth, upright = width < NARROW;
  const [x0, y0, x1, y1] = player.view, margin = 2;
  const across = (upright ? y1 - y0 : x1 - x0) + 2 * margin, along = (upright ? x1 - x0 : y1 - y0) + 2 * margin;
  const height = Math.round(width * along / across), scale = state.zoom * width / across;
  const [cx, cy] = state.centre;
  // Ahead of the ego is right on wide screens and up on narrow ones; its left is up, or left.
  const project = upright
    ? (x, y) => [width / 2 - (y - cy) * scale, height / 2 - (x - cx) * scale]
    : (x, y) => [width / 2 + (x - cx) * scale, height / 2 - (y - cy) * scale];
  return { canvas, width, height, scale, upright, project };
}

function corners([x, y, length, width, yaw]) {
  const c = Math.cos(yaw / 1000), s = Math.sin(yaw / 1000);
  return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([a, b]) => {
    const u = a * length / 200, v = b * width / 200;
    return [x / 100 + u * c - v * s, y / 100 + u * s + v * c];
  });
}

function path(pen, view, points) {
  pen.beginPath();
  points.forEach(([x, y], i) => { const at = view.project(x, y); if (i) pen.lineTo(...at); else pen.moveTo(...at); });
  pen.closePath();
}

function drawPoints(pen, view, frame, may) {
  const [x0, y0, x1] = player.view, columns = Math.ceil((x1 - x0) / player.cell), side = Math.max(1.2, player.cell * view.scale * 0.8);
  frame.cells.forEach((text, row) => {
    pen.fillStyle = agentColour(row);
    pen.globalAlpha = may[row] ? 0.75 : 0.2;
    for (const cell of decodeCells(text)) {
      const [px, py] = view.project(x0 + (cell % columns + 0.5) * player.cell, y0 + (Math.floor(cell / columns) + 0.5) * player.cell);
      pen.fillRect(px - side / 2, py - side / 2, side, side);
    }
  });
  pen.globalAlpha = 1;
}

/** True boxes: found ones green, missed ones dashed with a cross, those that the ego alone misses filled with the sender's colour. */
function drawTruth(pen, view, frame, judged, may) {
  const without = player.methods[state.method].alone;
  const alone = without >= 0 ? judge(without, state.frame).found : null;
  frame.truth.forEach((box, row) => {
    const outline = corners(box);
    if (judged.found.has(row)) {
      const sender = alone && !alone.has(row) ? supplier(box.slice(5), may) : -1;
      if (sender > 0) {
        const agent = frame.agents[sender];
        pen.strokeStyle = pen.fillStyle = agentColour(sender);
        pen.globalAlpha = 0.35; path(pen, view, outline); pen.fill();
        pen.globalAlpha = 0.8; pen.lineWidth = 1.4; pen.setLineDash([3, 3]);
        pen.beginPath(); pen.moveTo(...view.project(agent[3] / 100, agent[4] / 100)); pen.lineTo(...view.project(box[0] / 100, box[1] / 100)); pen.stroke();
        pen.setLineDash([]); pen.globalAlpha = 1;
      }
      pen.strokeStyle = colour("found"); pen.lineWidth = 1.2;
      path(pen, view, outline); pen.stroke();
    } else {
      pen.strokeStyle = colour("missed"); pen.lineWidth = 2; pen.setLineDash([4, 3]);
      path(pen, view, outline); pen.stroke(); pen.setLineDash([]);
      const at = outline.map(([x, y]) => view.project(x, y));
      pen.lineWidth = 1.3; pen.beginPath();
      pen.moveTo(...at[0]); pen.lineTo(...at[2]); pen.moveTo(...at[1]); pen.lineTo(...at[3]); pen.stroke();
    }
  });
}

function drawDetections(pen, view, judged) {
  for (const box of judged.boxes) {
    const right = box[6] >= 0, outline = corners(box);
    pen.strokeStyle = pen.fillStyle = colour(right ? "found" : "false");
    if (!right) { pen.globalAlpha = 0.3; path(pen, view, outline); pen.fill(); pen.globalAlpha = 1; }
    pen.lineWidth = 2; path(pen, view, outline); pen.stroke();
    const [front, rear] = [[0, 1], [2, 3]].map(([a, b]) => [(outline[a][0] + outline[b][0]) / 2, (outline[a][1] + outline[b][1]) / 2]);
    pen.beginPath();
    pen.moveTo(...view.project((front[0] + rear[0]) / 2, (front[1] + rear[1]) / 2));
    pen.lineTo(...view.project(front[0] + 0.2 * (front[0] - rear[0]), front[1] + 0.2 * (front[1] - rear[1])));
    pen.stroke();
  }
}

function drawAgents(pen, view, frame) {
  pen.textAlign = "center";
  frame.agents.forEach((agent, row) => {
    const [x, y, yaw] = [agent[3] / 100, agent[4] / 100, agent[5] / 1000], [px, py] = view.project(x, y);
    pen.fillStyle = agentColour(row); pen.strokeStyle = colour("view"); pen.lineWidth = 1.5;
    // A vehicle is an arrowhead along its heading, a roadside unit a diamond.
    const shape = agent[2] ? [[0, 8], [90, 8], [180, 8], [270, 8]] : [[0, 11], [140, 9], [180, 4], [220, 9]];
    const [ax, ay] = view.project(x + Math.cos(yaw), y + Math.sin(yaw)), heading = Math.atan2(ay - py, ax - px);
    pen.beginPath();
    shape.forEach(([angle, reach], i) => {
      const turn = heading + angle * Math.PI / 180, at = [px + reach * Math.cos(turn), py + reach * Math.sin(turn)];
      if (i) pen.lineTo(...at); else pen.moveTo(...at);
    });
    pen.closePath(); pen.fill(); pen.stroke();
    const half = pen.measureText(agent[1]).width / 2 + 3, tx = Math.min(Math.max(px, half), view.width - half);
    if (px < 0 || px > view.width || py < 0 || py > view.height) return;
    const ty = py + 24 > view.height ? py - 14 : py + 22;
    pen.lineWidth = 3; pen.strokeText(agent[1], tx, ty); pen.fillText(agent[1], tx, ty);
  });
}

function drawScaleBar(pen, view) {
  const metres = view.width / view.scale > 70 ? 20 : 10, length = metres * view.scale;
  pen.strokeStyle = pen.fillStyle = colour("soft"); pen.lineWidth = 1.5; pen.textAlign = "left";
  pen.beginPath(); pen.moveTo(10, view.height - 14); pen.lineTo(10 + length, view.height - 14); pen.stroke();
  pen.fillText(`${metres} m`, 10, view.height - 19);
}

function drawView() {
  const view = makeProjection(), pen = prepare(view.canvas, view.height), frame = player.frames[state.frame];
  const judged = judge(state.method, state.frame), may = usable(state.method, state.frame);
  drawPoints(pen, view, frame, may);
  const [x0, y0, x1, y1] = player.view;
  pen.strokeStyle = colour("line"); pen.lineWidth = 1; pen.setLineDash([6, 6]);
  path(pen, view, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]); pen.stroke(); pen.setLineDash([]);
  drawTruth(pen, view, frame, judged, may);
  drawDetections(pen, view, judged);
  drawAgents(pen, view, frame);
  drawScaleBar(pen, view);
  byId("n-found").textContent = judged.found.size;
  byId("n-all").textContent = `of ${frame.truth.length}`;
  byId("n-missed").textContent = judged.missed;
  byId("n-false").textContent = judged.wrong;
  const got = player.methods[state.method].frames[state.frame];
  const bytes = got.received.length ? `${got.received.length} messages fused, ${got.bytes.toLocaleString("en")} bytes sent` : "no message fused";
  byId("moment").textContent = `${player.methods[state.method].title}. Frame ${frame.index}, ${(frame.time - player.frames[0].time).toFixed(1)} s: ${bytes}.`;
  byId("frame-out").textContent = `${state.frame + 1} of ${player.frames.length}`;
  if (state.under) showTip(state.under); else byId("tip").hidden = true;
}

let perFrame = [];

/** Counts of all methods in all frames at the chosen score. */
function count() {
  perFrame = player.methods.map((_, method) => player.frames.map((_, frame) => {
    const { found, wrong } = judge(method, frame);
    return { found: found.size, wrong };
  }));
  const own = perFrame[state.method], total = player.frames.reduce((sum, f) => sum + f.truth.length, 0);
  const found = own.reduce((sum, f) => sum + f.found, 0), wrong = own.reduce((sum, f) => sum + f.wrong, 0);
  const percent = (part, whole) => whole ? `${(100 * part / whole).toFixed(0)} %` : "none";
  byId("drive").textContent = `Over the drive: ${percent(found, total)} of vehicles found, ${percent(wrong, found + wrong)} of boxes false.`;
}

function drawCurves(canvas, height, pick, most) {
  const pen = prepare(canvas, height), width = canvas.clientWidth, left = 26, right = width - 6, top = 10, bottom = height - 20;
  const num = player.frames.length, toX = (frame) => left + (right - left) * (num > 1 ? frame / (num - 1) : 0.5);
  const toY = (value) => bottom - (bottom - top) * value / Math.max(1, most);
  pen.fillStyle = colour("soft"); pen.strokeStyle = colour("line"); pen.textAlign = "right";
  for (const value of [0, most]) {
    pen.beginPath(); pen.moveTo(left, toY(value)); pen.lineTo(right, toY(value)); pen.stroke();
    pen.fillText(String(value), left - 5, toY(value) + 4);
  }
  pen.textAlign = "left"; pen.fillText(`frame ${player.frames[0].index}`, left, height - 5);
  pen.textAlign = "right"; pen.fillText(String(player.frames[num - 1].index), right, height - 5);
  const line = (values, ink, thick) => {
    pen.strokeStyle = ink; pen.lineWidth = thick; pen.beginPath();
    values.forEach((value, frame) => { if (frame) pen.lineTo(toX(frame), toY(value)); else pen.moveTo(toX(frame), toY(value)); });
    pen.stroke();
  };
  if (pick === "found") { pen.setLineDash([3, 3]); line(player.frames.map((f) => f.truth.length), colour("soft"), 1); pen.setLineDash([]); }
  perFrame.forEach((rows, method) => { if (method !== state.method) line(rows.map((r) => r[pick]), methodColour(method), 1.2); });
  line(perFrame[state.method].map((r) => r[pick]), methodColour(state.method), 3);
  pen.strokeStyle = colour("ink"); pen.lineWidth = 1; pen.beginPath(); pen.moveTo(toX(state.frame), top - 4); pen.lineTo(toX(state.frame), bottom); pen.stroke();
}

function drawPlots() {
  drawCurves(byId("plot-found"), 150, "found", Math.max(...player.frames.map((f) => f.truth.length), 1));
  drawCurves(byId("plot-false"), 90, "wrong", Math.max(...perFrame.flat().map((r) => r.wrong), 1));
}

function show() { drawView(); drawPlots(); showKeys(); }

function select(method) {
  state.method = method;
  [...byId("tabs").children].forEach((tab, row) => tab.setAttribute("aria-selected", String(row === method)));
  showScore(); count(); show();
}

function showScore() {
  const score = scoreOf(state.method);
  byId("score").value = Math.round(100 * score);
  byId("score-out").textContent = score.toFixed(2);
  byId("score-reset").disabled = state.score === null;
}

function showKeys() {
  const agents = player.frames[state.frame].agents.map((agent, row) => ["dot", agentColour(row), agent[1]]);
  const helped = player.methods[state.method].alone >= 0;
  addKeys(byId("keys"), [
    ["box", colour("found"), "found: thick the box, thin the truth"], ["dashed", colour("missed"), "missed"], ["box", colour("false"), "false alarm"],
    ...(helped ? [["", colour("agent-1"), "filled: missed alone, found with the sender that the dotted line comes from"]] : []), ...agents,
  ]);
  addKeys(byId("method-keys"), [...player.methods.map((m, row) => ["", methodColour(row), m.name]), ["dashed", colour("soft"), "all vehicles"]]);
}

function step(by) {
  const num = player.frames.length;
  state.frame = (state.frame + by + num) % num;
  byId("frame").value = state.frame;
  show();
}

let last = 0;

function tick(now) {
  if (!state.playing) return;
  const period = 1000 * player.period / state.speed;
  if (now - last >= period) { last = now; step(1); }
  requestAnimationFrame(tick);
}

function play(on) {
  state.playing = on;
  byId("play").textContent = on ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", String(on));
  if (on) { last = performance.now(); requestAnimationFrame(tick); }
}

function contains(box, x, y) {
  const dx = x - box[0] / 100, dy = y - box[1] / 100, c = Math.cos(box[4] / 1000), s = Math.sin(box[4] / 1000), margin = 0.6;
  return Math.abs(dx * c + dy * s) <= box[2] / 200 + margin && Math.abs(dy * c - dx * s) <= box[3] / 200 + margin;
}

/** Words on the box under a place in metres; null where there is none. */
function describe(x, y) {
  const frame = player.frames[state.frame], judged = judge(state.method, state.frame), may = usable(state.method, state.frame);
  const box = judged.boxes.find((b) => contains(b, x, y));
  const row = box ? box[6] : frame.truth.findIndex((b, k) => !judged.found.has(k) && contains(b, x, y));
  if (!box && row < 0) return null;
  const returns = box ? box.slice(7) : frame.truth[row].slice(5);
  const heading = !box ? "Missed vehicle" : `Score ${(box[5] / 1000).toFixed(2)}, ${box[6] >= 0 ? "found" : "false alarm"}`;
  const from = supplier(returns, may), sender = from < 0 ? "none of the fused agents has returns on it" : `most returns from ${frame.agents[from][1]}`;
  const points = frame.agents.map((agent, k) => `${agent[1]} ${returns[k]}${may[k] ? "" : " (not fused)"}`).join(", ");
  return [heading, `Sender: ${sender}`, `Points: ${points}`];
}

function showTip([px, py]) {
  const view = makeProjection(), tip = byId("tip"), [ox, oy] = view.project(0, 0), [ux] = view.project(1, 0);
  const x = view.upright ? (oy - py) / view.scale : (px - ox) / (ux - ox), y = view.upright ? (ox - px) / view.scale : (oy - py) / view.scale;
  const lines = describe(x, y);
  tip.hidden = lines === null;
  view.canvas.style.cursor = lines ? "pointer" : state.zoom > 1 ? "grab" : "default";
  if (!lines) return;
  tip.replaceChildren(...lines.map((text, k) => Object.assign(document.createElement(k ? "div" : "b"), { textContent: text })));
  tip.style.left = `${Math.max(0, Math.min(px + 14, view.width - tip.offsetWidth - 4))}px`;
  tip.style.top = `${py + 16 + tip.offsetHeight > view.height ? Math.max(0, py - tip.offsetHeight - 12) : py + 16}px`;
}

function zoom(factor) {
  state.zoom = Math.min(8, Math.max(1, state.zoom * factor));
  byId("view").style.touchAction = state.zoom > 1 ? "none" : "pan-y";
  if (state.zoom === 1) state.centre = middle();
  drawView();
}

const middle = () => [(player.view[0] + player.view[2]) / 2, (player.view[1] + player.view[3]) / 2];

function listenToView() {
  const canvas = byId("view");
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => { drag = [event.offsetX, event.offsetY]; });
  canvas.addEventListener("pointerup", () => { drag = null; });
  canvas.addEventListener("pointermove", (event) => {
    state.under = [event.offsetX, event.offsetY];
    if (drag && state.zoom > 1) {
      const view = makeProjection(), [dx, dy] = [(event.offsetX - drag[0]) / view.scale, (event.offsetY - drag[1]) / view.scale];
      state.centre = view.upright ? [state.centre[0] + dy, state.centre[1] + dx] : [state.centre[0] - dx, state.centre[1] + dy];
      drag = state.under;
      drawView();
    } else showTip(state.under);
  });
  canvas.addEventListener("pointerleave", () => { state.under = drag = null; byId("tip").hidden = true; });
  canvas.addEventListener("click", (event) => { state.under = [event.offsetX, event.offsetY]; showTip(state.under); });
  canvas.addEventListener("keydown", (event) => {
    if (event.key === "ArrowRight") step(1);
    else if (event.key === "ArrowLeft") step(-1);
    else if (event.key === " ") play(!state.playing);
    else return;
    event.preventDefault();
  });
  byId("closer").addEventListener("click", () => zoom(1.6));
  byId("wider").addEventListener("click", () => zoom(1 / 1.6));
}

function seek(event) {
  const canvas = event.currentTarget, share = (event.offsetX - 26) / (canvas.clientWidth - 32);
  state.frame = Math.min(player.frames.length - 1, Math.max(0, Math.round(share * (player.frames.length - 1))));
  byId("frame").value = state.frame;
  show();
}

function startPlayer() {
  state.frame = player.first;
  state.centre = middle();
  byId("tabs").append(...player.methods.map((method, row) => {
    const tab = Object.assign(document.createElement("button"), { textContent: method.name, title: method.title });
    tab.setAttribute("role", "tab");
    tab.addEventListener("click", () => select(row));
    return tab;
  }));
  byId("frame").max = player.frames.length - 1;
  byId("frame").value = state.frame;
  byId("frame").addEventListener("input", (event) => { state.frame = Number(event.target.value); show(); });
  byId("score").addEventListener("input", (event) => { state.score = event.target.value / 100; showScore(); count(); show(); });
  byId("score-reset").addEventListener("click", () => { state.score = null; showScore(); count(); show(); });
  byId("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("back").addEventListener("click", () => { play(false); step(-1); });
  byId("forward").addEventListener("click", () => { play(false); step(1); });
  for (const id of ["plot-found", "plot-false"]) byId(id).addEventListener("click", seek);
  listenToView();
  select(Math.max(0, player.methods.findIndex((m) => m.name === held.shown)));
}

function drawAll() {
  if (byId("plot-bytes")) { drawBytes(); showStages(); }
  if (byId("plot-forest")) drawForest();
  if (player && perFrame.length) show();
}

if (player) startPlayer();
drawAll();
window.addEventListener("resize", drawAll);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
document.body.dataset.ready = player ? player.frames.length : 0;
