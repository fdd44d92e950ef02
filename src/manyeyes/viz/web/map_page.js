// SPDX-License-Identifier: Apache-2.0
const held = JSON.parse(document.getElementById("data").textContent);
const byKind = ["match", ["get", "kind"], ...Object.entries(held.kinds).flat(), "#000"];
const byScore = ["interpolate", ["linear"], ["get", "score"], ...held.confidence.flat()];
const byWhat = ["match", ["get", "what"], ...Object.entries(held.disagreement).flat(), "#000"];
const LAYERS = [
  { id: "truth", shown: true, paint: { "line-color": byKind, "line-width": 5, "line-opacity": 0.25 } },
  { id: "observed", shown: false,
    paint: { "line-color": byKind, "line-width": 1, "line-opacity": 0.35 } },
  { id: "fused", shown: true, paint: { "line-color": byScore, "line-width": 2.4 } },
  { id: "disagreement", shown: false,
    paint: { "line-color": byWhat, "line-width": 4, "line-opacity": 0.8 } },
];
const map = new maplibregl.Map({
  container: "map", bounds: held.bounds, attributionControl: false, maxZoom: 24, maxPitch: 0, dragRotate: false,
  fitBoundsOptions: { padding: { top: 40, bottom: 40, left: window.innerWidth > 700 ? 310 : 30, right: 40 } },
  canvasContextAttributes: { preserveDrawingBuffer: true },
  style: { version: 8, sources: {}, layers: [{ id: "paper", type: "background", paint: { "background-color": "#fbfbf9" } }] },
});
map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "top-right");
map.addControl(new maplibregl.ScaleControl(), "bottom-right");
map.on("error", (event) => { document.body.dataset.error = String(event.error); });
map.on("load", () => {
  for (const layer of LAYERS) {
    const data = held.layers[layer.id];
    if (!data.features.length) continue;
    map.addSource(layer.id, { type: "geojson", data, tolerance: 0.05 });
    map.addLayer({ id: layer.id, type: "line", source: layer.id, paint: layer.paint,
      layout: { visibility: layer.shown ? "visible" : "none", "line-cap": "round", "line-join": "round" } });
    const label = document.createElement("label");
    const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: layer.shown, name: layer.id });
    box.addEventListener("change", () => map.setLayoutProperty(layer.id, "visibility", box.checked ? "visible" : "none"));
    label.append(box, ` ${held.titles[layer.id]} (${data.features.length})`);
    document.getElementById("layers").append(label);
  }
  const asked = new URLSearchParams(location.hash.slice(1)).get("show");
  for (const box of document.querySelectorAll("#layers input")) {
    if (asked && box.checked !== asked.split(",").includes(box.name)) box.click();
  }
  if (map.getLayer("fused")) map.on("click", "fused", (event) => {
    const text = event.features[0].properties.about || event.features[0].properties.kind;
    new maplibregl.Popup().setLngLat(event.lngLat).setText(text).addTo(map);
  });
  map.once("idle", () => {
    const layers = ["fused"].filter((id) => map.getLayer(id));
    document.body.dataset.ready = layers.length ? map.queryRenderedFeatures({ layers }).length : 0;
  });
});
