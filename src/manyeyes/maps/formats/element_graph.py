# SPDX-License-Identifier: Apache-2.0
"""The graph of a map's elements as numpy arrays in one .npz file: nodes, edges, and what was measured of each edge."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_replace
from manyeyes.datatypes.map_element import KINDS
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes
from manyeyes.maps.fusion.graph import RELATIONS, build_element_graph


def write_element_graph(vector_map: VectorMap, path: Path | str) -> None:
    """Write the elements as nodes and their relations as edges; docs/guides/maps.md lists the arrays.

    Args:
        vector_map: N elements, whose points stay in metres in the map's frame.
    """
    graph, attributes = build_element_graph(vector_map.elements), Attributes.of(vector_map)
    measured = {f.name: getattr(graph, f.name) for f in fields(graph) if f.name not in ("nodes", "observation")}
    with atomic_replace(Path(path), keep_suffix=True) as temporary:
        np.savez_compressed(
            temporary,
            points=graph.nodes.points,
            offsets=graph.nodes.offsets,
            kind=graph.nodes.kind,
            kind_names=np.array(KINDS),
            existence_prob=attributes.confidence,
            score=attributes.score,
            id=attributes.id,
            relation_names=np.array(RELATIONS),
            origin=np.array([vector_map.frame.latitude, vector_map.frame.longitude]),
            **measured,
        )
