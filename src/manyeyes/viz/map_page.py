# SPDX-License-Identifier: Apache-2.0
"""A fused map as one HTML file that needs no internet: MapLibre GL JS, the data and the style are all inside it.

Layers: truth, observations, fused elements coloured by confidence, and where they disagree. MapLibre GL JS 5.13.0 (BSD-3-Clause)
lies beside this file with its licence, as published on npm.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write_text
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.change_summary import MapChange
from manyeyes.evaluation.maps.map_discrepancy import MapDiscrepancy, find_discrepancies
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres
from manyeyes.viz.web_assets import read_asset, to_safe_json

Floats = NDArray[np.float64]
_DEGREES = 7

KIND_COLOURS = {"divider": "#e07b00", "boundary": "#2e7d32", "crossing": "#1565c0", "stop_line": "#8e24aa"}
CONFIDENCE_STOPS = ((0.0, "#d7301f"), (0.5, "#fdae61"), (0.8, "#41b6c4"), (1.0, "#0c2c84"))
DISCREPANCY_COLOURS = {"false_positives": "#d50000", "false_negatives": "#ff6fae", "unsupported": "#9e9d24"}
LAYERS = {"truth": "Truth", "observed": "Observations", "fused": "Fused map", "disagreement": "Disagreement"}
CHANGE_NAMES = (
    ("truth", "Old map"),
    ("fused", "New map"),
    ("disagreement", "Changes"),
    ("false_positives", "new"),
    ("false_negatives", "gone"),
)


@dataclass(frozen=True)
class MapPage:
    """What the page shows; elements in the map's metric frame, whose origin lies at (latitude, longitude) degrees.

    descriptions: one line of text a fused element, shown when it is clicked. facts: (name, value) pairs under the title. names:
    other words for layers and disagreements, as (the page's own, the shown) pairs.
    """

    title: str
    fused: MapElements
    origin: tuple[float, float]
    truth: MapElements | None = None
    observed: MapElements | None = None
    discrepancy: MapDiscrepancy = MapDiscrepancy()
    descriptions: Sequence[str] = ()
    facts: Sequence[tuple[str, str]] = ()
    names: Sequence[tuple[str, str]] = ()


def make_page(
    title: str,
    vector_map: VectorMap,
    truth: MapElements | None,
    observed: MapElements | None,
    num_observations: int,
    evaluated: MapElements | None = None,
) -> MapPage:
    """Return the page of what a map publishes. evaluated: what of it the ground truth covers, where that is not all."""
    published = vector_map.select_published()
    elements = published.elements
    facts = [("Elements", str(len(published))), ("Length", f"{elements.lengths().sum() / 1000:.2f} km")]
    facts += [("Observations", str(num_observations))] if num_observations else []
    descriptions = [
        f"{KINDS[int(elements.kind[k])].replace('_', ' ')}, confidence {elements.score[k]:.2f}, {int(published.supporters[k])} "
        f"observations by {int(published.agents[k])} agents, id {published.id[k].tobytes().hex()[:12]}"
        for k in range(len(published))
    ]
    origin = (vector_map.frame.latitude, vector_map.frame.longitude)
    discrepancy = find_discrepancies(elements, truth, observed)
    if evaluated is not None and truth is not None:
        discrepancy = replace(discrepancy, false_positives=find_discrepancies(evaluated, truth).false_positives)
    return MapPage(title, elements, origin, truth, observed, discrepancy, descriptions, facts)


def make_change_page(title: str, old: VectorMap, new: VectorMap, change: MapChange) -> MapPage:
    """Return the page of a difference: the new map, the old one as its background, what is new and what is gone."""
    page = make_page(title, new, old.select_published().elements, None, 0)
    facts = [
        (c.kind.replace("_", " "), f"+{c.added_length_m:.0f} m, -{c.removed_length_m:.0f} m")
        for c in change.kinds
        if c.added_length_m + c.removed_length_m > 0
    ]
    discrepancy = MapDiscrepancy(false_positives=change.added, false_negatives=change.removed)
    return replace(page, discrepancy=discrepancy, facts=facts, names=CHANGE_NAMES)


def to_lonlat(points: Floats, origin: tuple[float, float]) -> Floats:
    """Return (N, 2) longitude and latitude in degrees of metres east and north of an origin (latitude, longitude)."""
    return degrees_from_metres(points, origin)[:, ::-1]


def render(page: MapPage) -> str:
    """Return the page as text."""
    layers = {
        "truth": _features(page.truth, page.origin),
        "observed": _features(page.observed, page.origin),
        "fused": _features(page.fused, page.origin, page.descriptions),
        "disagreement": _pieces(page.discrepancy, page.origin),
    }
    names = dict(page.names)
    data = {
        "layers": layers,
        "bounds": _bounds(page),
        "kinds": KIND_COLOURS,
        "confidence": CONFIDENCE_STOPS,
        "disagreement": DISCREPANCY_COLOURS,
        "titles": {name: names.get(name, title) for name, title in LAYERS.items()},
    }
    facts = "".join(f"<li><b>{_text(n)}</b>{_text(v)}</li>" for n, v in page.facts)
    return "\n".join(
        (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">',
            f"<title>{_text(page.title)}</title>",
            f"<style>{read_asset('vendor/maplibre-gl.css')}</style><style>{read_asset('web/map_page.css')}</style></head><body>",
            f'<div id="map"></div><div id="panel"><h1>{_text(page.title)}</h1><ul class="facts">{facts}</ul>',
            f'<div id="layers"></div>{_legend(page, names)}</div>',
            f'<script type="application/json" id="data">{to_safe_json(data)}</script>',
            f"<script>{read_asset('vendor/maplibre-gl.js')}</script>",
            f"<script>{read_asset('web/map_page.js')}</script></body></html>\n",
        )
    )


def save_map_page(page: MapPage, path: Path) -> None:
    """The page as a file, whole or not at all."""
    atomic_write_text(path, render(page))


def _features(
    elements: MapElements | None, origin: tuple[float, float], descriptions: Sequence[str] = ()
) -> dict[str, Any]:
    """Return GeoJSON of elements: rings closed as lines, so that one style draws them all."""
    features = []
    for row in range(0 if elements is None else len(elements)):
        assert elements is not None
        kind = KINDS[int(elements.kind[row])]
        points = np.asarray(elements.polyline(row))
        points = np.vstack((points, points[:1])) if kind == "crossing" else points
        properties = {"kind": kind, "score": round(float(elements.score[row]), 3)}
        if row < len(descriptions):
            properties["about"] = descriptions[row]
        features.append(_feature(points, origin, properties))
    return {"type": "FeatureCollection", "features": features}


def _pieces(discrepancy: MapDiscrepancy, origin: tuple[float, float]) -> dict[str, Any]:
    features = [
        _feature(piece, origin, {"what": category})
        for category in DISCREPANCY_COLOURS
        for piece in getattr(discrepancy, category)
    ]
    return {"type": "FeatureCollection", "features": features}


def _feature(points: Floats, origin: tuple[float, float], properties: dict[str, Any]) -> dict[str, Any]:
    line = np.round(to_lonlat(points, origin), _DEGREES).tolist()
    return {"type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": line}}


def _bounds(page: MapPage) -> list[list[float]]:
    """South-west and north-east corner of what is fused and true, or of a hundred metres where nothing is."""
    known = [e.points for e in (page.fused, page.truth) if e is not None and len(e.points)]
    points = np.concatenate(known) if known else np.array([[-50.0, -50.0], [50.0, 50.0]])
    return to_lonlat(np.stack((points.min(0), points.max(0))), page.origin).tolist()


def _legend(page: MapPage, names: dict[str, str]) -> str:
    """Explain the colours of what the page holds."""
    stops = ", ".join(f"{colour} {100 * at:g}%" for at, colour in CONFIDENCE_STOPS)
    parts = [
        f'<b>Confidence of fused elements</b><div class="bar" style="background:linear-gradient(90deg, {stops})"></div>'
        '<div class="ends"><span>0</span><span>1</span></div>'
    ]
    shown = [names.get(name, title) for name, title, held in (
        ("truth", "Truth", page.truth), ("observed", "observations", page.observed),
    ) if held is not None]  # fmt: skip
    if shown:
        kinds = {kind.replace("_", " "): colour for kind, colour in KIND_COLOURS.items()}
        heading = " and ".join(shown)
        parts.append(f"<b>{heading[0].upper()}{heading[1:]}</b>{_keys(kinds)}")
    disagreements = {
        names.get(name, name.replace("_", " ")): colour
        for name, colour in DISCREPANCY_COLOURS.items()
        if len(getattr(page.discrepancy, name))
    }
    if disagreements:
        parts.append(f"<b>{names.get('disagreement', LAYERS['disagreement'])}</b>{_keys(disagreements)}")
    return f'<div class="legend">{"".join(parts)}</div>'


def _keys(colours: dict[str, str]) -> str:
    items = "".join(f'<span><i style="background:{colour}"></i>{name}</span>' for name, colour in colours.items())
    return f"<div>{items}</div>"


def _text(value: str) -> str:
    return html.escape(value, quote=True)
