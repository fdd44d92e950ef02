# SPDX-License-Identifier: Apache-2.0
"""What studies run the methods of maps with: the settings that tuning found, and oracles beside the methods.

A method receives the observations and the frame, nothing else. Oracles receive more; evaluation.maps.oracles names them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment
from manyeyes.evaluation.maps.oracles import ORACLES, run_oracle
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import MAP_FUSION_METHODS, OURS, list_map_fusions


@dataclass(frozen=True)
class MethodSettings:
    """Configurations by method's name; a method that is not listed runs with its defaults, an oracle as our own method."""

    configs: tuple[tuple[str, Any], ...] = ()

    def config_of(self, method: str) -> Any:
        """Return the configuration of a method."""
        method = OURS if method in ORACLES else method
        return dict(self.configs).get(method) or make_default_config(method)


ConfigChanges = tuple[tuple[str, Any], ...]
# What ``manyeyes study tuning`` found, as changes of the defaults; a method that is not here stays with its own.
TUNED_CHANGES: dict[str, ConfigChanges] = {
    "chamfer-nms": (("max_chamfer_m", 0.75), ("rules.min_score", 0.2)),
    "polymerge": (("max_vertex_distance_m", 0.75), ("min_fraction", 0.3), ("rules.min_score", 0.5)),
    "heatmap-buffer": (("buffer_m", 0.5), ("min_view_fraction", 0.3), ("simplify_m", 0.1), ("rules.min_score", 0.0)),
    "crowdmap-literal": (
        ("max_overlap_chamfer_m", 0.75),
        ("max_registered_chamfer_m", 1.0),
        ("rules.min_score", 0.2),
    ),
}


def make_tuned_settings() -> MethodSettings:
    """Return the settings that studies use."""
    configs = {method: apply_changes(make_default_config(method), changes) for method, changes in TUNED_CHANGES.items()}
    return MethodSettings(tuple(sorted(configs.items())))


def make_default_config(method: str) -> Any:
    """Return a method's configuration as it comes."""
    return MAP_FUSION_METHODS.get(method).config_class()


def apply_changes(config: Any, changes: ConfigChanges) -> Any:
    """Return a configuration with fields replaced; a dotted name goes into the part of that name."""
    for name, value in changes:
        head, _, rest = name.partition(".")
        config = replace(config, **{head: apply_changes(getattr(config, head), ((rest, value),)) if rest else value})
    return config


def check_method(method: str) -> None:
    """ConfigError for a method that is not known."""
    if method not in ORACLES and method not in MAP_FUSION_METHODS:
        raise ConfigError(f"No method is called {method!r}; known: {', '.join((*list_map_fusions(), *ORACLES))}.")


def fuse_observations(
    method: str, observations: Sequence[Observation], settings: MethodSettings, frame: MapFrame | None = None
) -> VectorMap:
    """Return the map that a method makes of observations."""
    if method in ORACLES:
        raise ConfigError(f"{method!r} needs more than observations; known: {', '.join(list_map_fusions())}.")
    return MAP_FUSION_METHODS.get(method).fuse(observations, settings.config_of(method), frame)


def fuse_experiment(method: str, experiment: FleetExperiment, settings: MethodSettings) -> MapElements:
    """Return the published elements of a method's map of a scene."""
    if method in ORACLES:
        return run_oracle(method, experiment, settings.config_of(method))
    return (
        fuse_observations(method, experiment.observations, settings, experiment.place.frame).select_published().elements
    )
