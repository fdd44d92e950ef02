// SPDX-License-Identifier: Apache-2.0
const held = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const byKind = ["match", ["get", "kind"], ...Object.entries(held.kinds).flat(), "#000"];
const byScore = ["interpolate", ["linear"], ["get", "score"], ...held.confidence.flat()];
const byWhat = ["match", ["get", "what"], ...Object.entries(held.disagreement).flat(), "#000"];
const isHovered = ["boolean", ["feature-state", "hovered"], false];
const LAYERS = [
  { id: "truth", shown: true, paint: { "line-color": byKind, "line-width": 5, "line-opacity": 0.25 } },
  { id: "observed", shown: false, paint: { "line-color": byKind, "line-width": 1, "line-opacity": 0.35 } },
  { id: "fused", shown: true, paint: { "line-color": byScore, "line-width": ["case", isHovered, 5, 2.4] } },
  { id: "disagreement", shown: false,
    paint: { "line-color": byWhat, "line-width": ["interpolate", ["linear"], ["zoom"], 15, 1, 20, 3] } },
];
const CLICKED = ["fused", "observed", "truth"];
const HIDDEN = new Set(["kind", "score"]);
const background = [{ id: "paper", type: "background", paint: { "background-color": "#fbfbf9" } }];
const sources = {};
if (held.basemap) {
  sources.basemap = { type: "raster", tiles: [held.basemap.template], tileSize: 256, attribution: held.basemap.credit };
  background.push({ id: "basemap", type: "raster", source: "basemap", paint: { "raster-opacity": 0.6 } });
}
const isNarrow = window.innerWidth <= 700;
byId("controls").open = !isNarrow;
const map = new maplibregl.Map({
  container: "map", bounds: held.bounds, maxZoom: 24, maxPitch: 0, dragRotate: false,
  attributionControl: held.basemap && held.basemap.credit ? {} : false,
  fitBoundsOptions: { padding: { top: isNarrow ? 140 : 40, bottom: 40, left: isNarrow ? 30 : 310, right: 40 } },
  canvasContextAttributes: { preserveDrawingBuffer: true },
  style: { version: 8, sources, layers: background },
});
map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "top-right");
map.addControl(new maplibregl.ScaleControl(), "bottom-right");
map.on("error", (event) => { document.body.dataset.error = String(event.error); });

const shownKinds = new Set(Object.keys(held.kinds)), shownWhats = new Set(Object.keys(held.disagreement));
let until = held.times.length - 1;

function addCheck(parent, name, isChecked, text, colour, changed) {
  const label = document.createElement("label");
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: isChecked, name });
  box.addEventListener("change", () => changed(box.checked));
  label.append(box);
  if (colour) label.append(Object.assign(document.createElement("i"), { style: `background:${colour}` }));
  label.append(` ${text}`);
  parent.append(label);
}
const isDrawn = (id) => map.getLayer(id) && map.getLayoutProperty(id, "visibility") !== "none";
const countOf = (id, test) => held.layers[id].features.filter((one) => test(one.properties)).length;

function applyFilters() {
  const kind = ["in", ["get", "kind"], ["literal", [...shownKinds]]];
  const filters = { truth: kind, fused: kind, observed: ["all", kind, ["<=", ["get", "n"], until]],
    disagreement: ["in", ["get", "what"], ["literal", [...shownWhats]]] };
  for (const [id, filter] of Object.entries(filters)) if (map.getLayer(id)) map.setFilter(id, filter);
}
function toggle(set, name, isShown) {
  if (isShown) set.add(name); else set.delete(name);
  applyFilters();
}

function describe(layer, properties) {
  const content = document.createElement("div"), table = document.createElement("table");
  const kind = properties.kind.replace("_", " ");
  content.append(Object.assign(document.createElement("h2"), { textContent: `${held.titles[layer]}: ${kind}` }));
  const rows = Object.entries(properties).filter(([name, value]) => !HIDDEN.has(name) && name !== "n" && value !== "");
  if (layer === "observed") rows.push(["observation", String(properties.n + 1)], ["time", held.times[properties.n]]);
  for (const [name, value] of rows) {
    const row = table.insertRow();
    row.insertCell().textContent = name;
    row.insertCell().textContent = value;
  }
  content.append(table);
  return content;
}
let popup = null;
function openPopup(layer, properties, lngLat) {
  if (popup) popup.remove();
  popup = new maplibregl.Popup().setLngLat(lngLat).setDOMContent(describe(layer, properties)).addTo(map);
}
function find(point) {
  const area = [[point.x - 4, point.y - 4], [point.x + 4, point.y + 4]];
  for (const id of CLICKED.filter(isDrawn)) {
    const found = map.queryRenderedFeatures(area, { layers: [id] });
    if (found.length) return found[0];
  }
  return null;
}
let hovered = null;
function hover(event) {
  const found = measured ? null : find(event.point);
  const row = found && found.layer.id === "fused" ? found.id : null;
  map.getCanvas().style.cursor = measured ? "crosshair" : found ? "pointer" : "";
  map.getCanvas().title = found ? `${held.titles[found.layer.id]}: ${found.properties.kind.replace("_", " ")}` : "";
  if (row === hovered) return;
  if (hovered !== null) map.setFeatureState({ source: "fused", id: hovered }, { hovered: false });
  if (row !== null) map.setFeatureState({ source: "fused", id: row }, { hovered: true });
  hovered = row;
}

let measured = null;
function drawMeasure() {
  const points = measured || [];
  const data = { type: "FeatureCollection", features: [
    { type: "Feature", properties: {}, geometry: { type: "LineString", coordinates: points } },
    { type: "Feature", properties: {}, geometry: { type: "MultiPoint", coordinates: points } }] };
  map.getSource("measure").setData(data);
  let metres = 0;
  for (let k = 1; k < points.length; k++) {
    const [east, north] = [0, 1].map((axis) => (points[k][axis] - points[k - 1][axis]) * held.metresPerDegree[axis]);
    metres += Math.hypot(east, north);
  }
  byId("distance").textContent = measured ? (points.length < 2 ? "click two points" : `${metres.toFixed(2)} m`) : "";
}
function setMeasuring(isOn) {
  measured = isOn ? [] : null;
  byId("measure").setAttribute("aria-pressed", String(isOn));
  drawMeasure();
}
byId("measure").addEventListener("click", () => setMeasuring(!measured));
document.addEventListener("keydown", (event) => { if (event.key === "Escape" && measured) setMeasuring(false); });

byId("search").addEventListener("change", (event) => {
  const asked = event.target.value.trim().toLowerCase();
  const found = asked ? held.layers.fused.features.filter((one) => (one.properties.id || "").startsWith(asked)) : [];
  byId("message").textContent = !asked ? "" : found.length === 0 ? `No published element has an id that begins with ${asked}.`
    : found.length > 1 ? `The first of ${found.length} elements whose ids begin with ${asked}.` : "";
  if (!found.length) return;
  const line = found[0].geometry.coordinates;
  const bounds = line.reduce((all, point) => all.extend(point), new maplibregl.LngLatBounds(line[0], line[0]));
  map.fitBounds(bounds, { padding: isNarrow ? 60 : { top: 80, bottom: 80, left: 330, right: 80 }, maxZoom: 20, duration: 0 });
  openPopup("fused", found[0].properties, line[Math.floor(line.length / 2)]);
});

byId("colour").addEventListener("change", (event) => {
  map.setPaintProperty("fused", "line-color", event.target.value === "kind" ? byKind : byScore);
  byId("confidence").hidden = event.target.value === "kind";
});
byId("until").addEventListener("input", (event) => {
  const box = document.querySelector("#layers input[name=observed]");
  if (!box.checked) box.click();
  until = Number(event.target.value);
  showUntil();
  applyFilters();
});
function showUntil() {
  document.querySelector("#time output").textContent =
    `Observations 1 to ${until + 1} of ${held.times.length}, until ${held.times[until]}`;
}

map.on("load", () => {
  for (const layer of LAYERS) {
    const data = held.layers[layer.id];
    if (!data.features.length) continue;
    map.addSource(layer.id, { type: "geojson", data, tolerance: 0.05, generateId: true });
    map.addLayer({ id: layer.id, type: "line", source: layer.id, paint: layer.paint,
      layout: { visibility: layer.shown ? "visible" : "none", "line-cap": "round", "line-join": "round" } });
    const setShown = (isShown) => map.setLayoutProperty(layer.id, "visibility", isShown ? "visible" : "none");
    addCheck(byId("layers"), layer.id, layer.shown, `${held.titles[layer.id]} (${data.features.length})`, null, setShown);
  }
  for (const [kind, colour] of Object.entries(held.kinds)) {
    if (!["truth", "observed", "fused"].some((id) => countOf(id, (one) => one.kind === kind))) continue;
    const text = `${kind.replace("_", " ")} (${countOf("fused", (one) => one.kind === kind)})`;
    addCheck(byId("kinds"), kind, true, text, colour, (isShown) => toggle(shownKinds, kind, isShown));
  }
  for (const [what, colour] of Object.entries(held.disagreement)) {
    const number = countOf("disagreement", (one) => one.what === what);
    if (number) addCheck(byId("disagreements"), what, true, `${held.disagreementNames[what]} (${number})`, colour,
      (isShown) => toggle(shownWhats, what, isShown));
  }
  byId("disagreements").querySelector("legend").textContent = held.titles.disagreement;
  byId("disagreements").hidden = !held.layers.disagreement.features.length;
  byId("time").hidden = held.times.length < 2;
  if (held.times.length > 1) {
    Object.assign(byId("until"), { max: until, value: until });
    showUntil();
  }
  byId("search").parentElement.hidden = !held.layers.fused.features.some((one) => one.properties.id);
  byId("confidence").firstElementChild.style.background =
    `linear-gradient(90deg, ${held.confidence.map(([at, colour]) => `${colour} ${100 * at}%`).join(", ")})`;
  applyFilters();
  map.addSource("measure", { type: "geojson", data: { type: "FeatureCollection", features: [] } });
  map.addLayer({ id: "measure-line", type: "line", source: "measure", paint: { "line-color": "#263238", "line-width": 2 } });
  map.addLayer({ id: "measure-points", type: "circle", source: "measure", filter: ["==", ["geometry-type"], "Point"],
    paint: { "circle-radius": 4, "circle-color": "#263238" } });
  const asked = new URLSearchParams(location.hash.slice(1)).get("show");
  for (const box of document.querySelectorAll("#layers input")) {
    if (asked && box.checked !== asked.split(",").includes(box.name)) box.click();
  }
  map.on("mousemove", hover);
  map.on("click", (event) => {
    if (measured) {
      measured.push(event.lngLat.toArray());
      drawMeasure();
      return;
    }
    const found = find(event.point);
    if (found) openPopup(found.layer.id, found.properties, event.lngLat);
  });
  map.once("idle", () => {
    const layers = ["fused"].filter((id) => map.getLayer(id));
    document.body.dataset.ready = layers.length ? map.queryRenderedFeatures({ layers }).length : 0;
  });
});
