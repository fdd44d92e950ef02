# SPDX-License-Identifier: Apache-2.0
"""A fused map as one HTML file that needs no internet: MapLibre GL JS, the data and the style are all inside it.

Layers: truth, observations, fused elements coloured by confidence or kind, and where they disagree. Elements are filtered by
kind and observations by time, a click shows attributes, ids are searched, and distances are measured. The page fetches nothing,
unless it is given a basemap. MapLibre GL JS 5.13.0 (BSD-3-Clause) lies beside this file with its licence, as published on npm.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write_text
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.change_summary import MapChange
from manyeyes.evaluation.maps.map_discrepancy import MapDiscrepancy, find_discrepancies
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres
from manyeyes.viz.web_assets import read_asset, to_safe_json

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
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
class Basemap:
    """Pictures behind the map, which the page fetches. template: URL of a tile with {z}, {x} and {y}; credit: of their source.

    Raises:
        ConfigError: the template lacks one of the three.
    """

    template: str
    credit: str = ""

    def __post_init__(self) -> None:
        if not all(part in self.template for part in ("{z}", "{x}", "{y}")):
            raise ConfigError(
                "A basemap is the URL of its tiles with {z}, {x} and {y}, such as "
                f"https://tiles.example.org/{{z}}/{{x}}/{{y}}.png; got {self.template!r}."
            )


@dataclass(frozen=True)
class ObservedElements:
    """Elements of observations in the order of their times. number: (N,) int64, of which one each element is, from 0;
    times: a text for each observation.
    """

    elements: MapElements
    number: Ints
    times: Sequence[str]

    @classmethod
    def of(cls, observations: Sequence[Observation]) -> ObservedElements:
        """Return the elements of observations in the map's frame, at their prior poses."""
        ordered = sorted(observations, key=lambda one: (one.time_ns, one.agent, one.pass_id))
        elements = MapElements.cat([one.elements_in_map() for one in ordered])
        number = np.repeat(np.arange(len(ordered)), [len(one.elements) for one in ordered])
        return cls(elements, number, [_format_time(one.time_ns) for one in ordered])


@dataclass(frozen=True)
class MapPage:
    """What the page shows; elements in the map's metric frame, whose origin lies at (latitude, longitude) degrees.

    attributes: name and text of what is shown of each fused element; its ``id`` is what the search finds. facts: (name, value)
    pairs under the title. names: other words for layers and disagreements, as (the page's own, the shown) pairs.
    """

    title: str
    fused: MapElements
    origin: tuple[float, float]
    truth: MapElements | None = None
    observed: ObservedElements | None = None
    discrepancy: MapDiscrepancy = MapDiscrepancy()
    attributes: Sequence[Mapping[str, str]] = ()
    facts: Sequence[tuple[str, str]] = ()
    names: Sequence[tuple[str, str]] = ()
    basemap: Basemap | None = None


def make_page(
    title: str,
    vector_map: VectorMap,
    truth: MapElements | None = None,
    observations: Sequence[Observation] = (),
    evaluated: MapElements | None = None,
    max_observations: int | None = None,
    basemap: Basemap | None = None,
) -> MapPage:
    """Return the page of what a map publishes.

    Args:
        title: of the page. vector_map: with its frame. truth: a map behind it, in the same frame.
        observations: those that it was fused from, drawn up to max_observations, the earliest ones.
        evaluated: what of the map the ground truth covers, where that is not all.
        basemap: pictures behind it; by default none, and the page fetches nothing.
    """
    published = vector_map.select_published()
    elements = published.elements
    drawn = sorted(observations, key=lambda one: one.time_ns)[:max_observations]
    facts = [("Elements", str(len(published))), ("Length", f"{elements.lengths().sum() / 1000:.2f} km")]
    if observations:
        all_drawn = len(drawn) == len(observations)
        facts.append(("Observations", f"{len(observations)}" if all_drawn else f"{len(drawn)} of {len(observations)}"))
    observed = ObservedElements.of(drawn) if drawn else None
    discrepancy = find_discrepancies(elements, truth, observed.elements if observed else None)
    if evaluated is not None and truth is not None:
        discrepancy = replace(discrepancy, false_positives=find_discrepancies(evaluated, truth).false_positives)
    origin = (vector_map.frame.latitude, vector_map.frame.longitude)
    return MapPage(
        title, elements, origin, truth, observed, discrepancy, _list_attributes(published), facts, basemap=basemap
    )


def _list_attributes(published: VectorMap) -> list[dict[str, str]]:
    elements, evidence = published.elements, published.point_evidence
    sigma = [evidence.sigma[a:b] for a, b in zip(elements.offsets[:-1], elements.offsets[1:])]
    return [
        {
            "id": published.id[k].tobytes().hex(),
            "kind": KINDS[int(elements.kind[k])].replace("_", " "),
            "confidence": f"{elements.score[k]:.2f}",
            "observations": str(int(published.supporters[k])),
            "agents": str(int(published.agents[k])),
            "sigma": f"{float(np.mean(sigma[k])):.2f} m" if len(sigma[k]) else "",
            "first observed": _format_time(int(published.t_first[k])),
            "last observed": _format_time(int(published.t_last[k])),
        }
        for k in range(len(published))
    ]


def _format_time(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def make_change_page(title: str, old: VectorMap, new: VectorMap, change: MapChange) -> MapPage:
    """Return the page of a difference: the new map, the old one as its background, what is new and what is gone."""
    page = make_page(title, new, old.select_published().elements)
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
    observed = page.observed
    numbers = [] if observed is None else [{"n": int(number)} for number in observed.number]
    layers = {
        "truth": _features(page.truth, page.origin),
        "observed": _features(observed.elements if observed else None, page.origin, numbers),
        "fused": _features(page.fused, page.origin, page.attributes),
        "disagreement": _pieces(page.discrepancy, page.origin),
    }
    names = dict(page.names)
    data = {
        "layers": layers,
        "bounds": _bounds(page),
        "kinds": KIND_COLOURS,
        "confidence": CONFIDENCE_STOPS,
        "disagreement": DISCREPANCY_COLOURS,
        "disagreementNames": {name: names.get(name, name.replace("_", " ")) for name in DISCREPANCY_COLOURS},
        "titles": {name: names.get(name, title) for name, title in LAYERS.items()},
        "times": list(observed.times) if observed else [],
        "metresPerDegree": (
            1 / np.diff(to_lonlat(np.array([[0.0, 0.0], [1.0, 1.0]]), page.origin), axis=0)[0]
        ).tolist(),
        "basemap": asdict(page.basemap) if page.basemap else None,
    }
    facts = "".join(f"<li><b>{_text(n)}</b>{_text(v)}</li>" for n, v in page.facts)
    return "\n".join(
        (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">',
            f"<title>{_text(page.title)}</title>",
            f"<style>{read_asset('vendor/maplibre-gl.css')}</style><style>{read_asset('web/map_page.css')}</style></head><body>",
            f'<div id="map"></div><div id="panel"><h1>{_text(page.title)}</h1><ul class="facts">{facts}</ul>',
            f"{read_asset('web/map_panel.html')}</div>",
            f'<script type="application/json" id="data">{to_safe_json(data)}</script>',
            f"<script>{read_asset('vendor/maplibre-gl.js')}</script>",
            f"<script>{read_asset('web/map_page.js')}</script></body></html>\n",
        )
    )


def save_map_page(page: MapPage, path: Path) -> None:
    """The page as a file, whole or not at all."""
    atomic_write_text(path, render(page))


def _features(
    elements: MapElements | None, origin: tuple[float, float], attributes: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Return GeoJSON of elements with attributes of each: rings closed as lines, so that one style draws them all."""
    features = []
    for row in range(0 if elements is None else len(elements)):
        assert elements is not None
        kind = KINDS[int(elements.kind[row])]
        points = np.asarray(elements.polyline(row))
        points = np.vstack((points, points[:1])) if kind == "crossing" else points
        properties = {"kind": kind, "score": round(float(elements.score[row]), 3)}
        if row < len(attributes):
            properties = {**attributes[row], **properties}
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


def _text(value: str) -> str:
    return html.escape(value, quote=True)
