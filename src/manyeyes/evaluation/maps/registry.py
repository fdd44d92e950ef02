# SPDX-License-Identifier: Apache-2.0
"""The ways to make a map of observations that studies compare, by name, with the settings that tuning found.

A method receives the observations and the frame, nothing else. Oracles receive more; evaluation.maps.oracles names them.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment
from manyeyes.evaluation.maps.oracles import ORACLES, run_oracle
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse

OURS = "manyeyes"
BASELINE_MODULES = {
    "union": ("union", "UnionConfig"),
    "chamfer-nms": ("chamfer_nms", "ChamferNmsConfig"),
    "crowdmap-literal": ("crowdmap_literal", "CrowdMapLiteralConfig"),
    "polymerge": ("polymerge", "PolyMergeConfig"),
    "frechet-clustering": ("frechet_clustering", "FrechetClusteringConfig"),
    "heatmap-buffer": ("heatmap_buffer", "HeatmapBufferConfig"),
    "global-map-builder": ("global_map_builder", "GlobalMapBuilderConfig"),
}
"""The module below ``manyeyes.maps.baselines`` and the configuration class of each baseline."""
BASELINES = tuple(BASELINE_MODULES)
METHODS = (OURS, *BASELINES)


@dataclass(frozen=True)
class MethodSettings:
    """Configurations by method's name; a method that is not listed runs with its defaults."""

    baseline_configs: tuple[tuple[str, Any], ...] = ()
    ours: MapFusionConfig = field(default_factory=MapFusionConfig)

    def config_of(self, method: str) -> Any:
        """The configuration of a method; None: its defaults."""
        if method == OURS or method in ORACLES:
            return self.ours
        return dict(self.baseline_configs).get(method)


ConfigChanges = tuple[tuple[str, Any], ...]
# What ``manyeyes map evaluate --study tuning`` found, as changes of the defaults; a method that is not here stays with its own.
# Ours: one agent suffices to publish, as in every baseline. Average precision ranks by score, so a line of one agent with a low
# score costs nothing behind lines of many agents.
TUNED_CHANGES: dict[str, ConfigChanges] = {
    OURS: (
        ("stations.evidence.publish_log_odds", 1.0),
        ("stations.evidence.publish_crossing_log_odds", 0.5),
        ("stations.evidence.publish_low_coverage_log_odds", 0.3),
        ("stations.evidence.min_publish_agents", 1),
    ),
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
    """The settings that studies use."""
    configs = {method: apply_changes(make_default_config(method), changes) for method, changes in TUNED_CHANGES.items()}
    ours = configs.pop(OURS)
    return MethodSettings(tuple(sorted(configs.items())), ours)


def make_default_config(method: str) -> Any:
    """A method's configuration as it comes."""
    if method == OURS:
        return MapFusionConfig()
    module, config_class = BASELINE_MODULES[method]
    return getattr(importlib.import_module(f"manyeyes.maps.baselines.{module}"), config_class)()


def apply_changes(config: Any, changes: ConfigChanges) -> Any:
    """A configuration with fields replaced; a dotted name goes into the part of that name."""
    for name, value in changes:
        head, _, rest = name.partition(".")
        config = replace(config, **{head: apply_changes(getattr(config, head), ((rest, value),)) if rest else value})
    return config


def check_method(method: str) -> None:
    """ConfigError for a method that is not known."""
    if method not in METHODS and method not in ORACLES:
        raise ConfigError(f"No method is called {method!r}; known: {', '.join((*METHODS, *ORACLES))}.")


def fuse_observations(
    method: str, observations: Sequence[Observation], settings: MethodSettings, frame: MapFrame | None = None
) -> VectorMap:
    """The map that a method makes of observations."""
    if method == OURS:
        return fuse(observations, settings.ours, frame)
    if method not in BASELINES:
        raise ConfigError(f"{method!r} needs more than observations; known: {', '.join(METHODS)}.")
    baseline = importlib.import_module(f"manyeyes.maps.baselines.{BASELINE_MODULES[method][0]}")
    config = settings.config_of(method)
    return baseline.fuse(observations, make_default_config(method) if config is None else config, frame)


def fuse_experiment(method: str, experiment: FleetExperiment, settings: MethodSettings) -> MapElements:
    """The published elements of a method's map of a scene."""
    if method in ORACLES:
        return run_oracle(method, experiment, settings.ours)
    return (
        fuse_observations(method, experiment.observations, settings, experiment.place.frame).select_published().elements
    )
