# SPDX-License-Identifier: Apache-2.0
"""The ways to make a map of observations that studies compare, by name, with the settings that tuning found.

A method is told the observations and the frame, nothing else. Oracles, which are told more, are named in map_oracle.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.experiment import Scene
from manyeyes.evaluation.maps.oracles import ORACLES, oracle
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import FuseConfig, fuse

OURS = "manyeyes"
RIVALS = (
    "union",
    "chamfer_nms",
    "crowdmap_literal",
    "polymerge",
    "frechet_clustering",
    "heatmap_buffer",
    "global_map_builder",
)
METHODS = (OURS, *RIVALS)


@dataclass(frozen=True)
class Settings:
    """Configurations by method's name; a method that is not listed runs with its defaults."""

    chosen: tuple[tuple[str, Any], ...] = ()
    ours: FuseConfig = field(default_factory=FuseConfig)

    def of(self, method: str) -> Any:
        """The configuration of a method; None: its defaults."""
        if method == OURS or method in ORACLES:
            return self.ours
        return dict(self.chosen).get(method)


Changes = tuple[tuple[str, Any], ...]
# What ``manyeyes map evaluate --study tuning`` found, as changes of the defaults; a method that is not here stays with its own.
# Ours: one agent's word publishes, as it does for every rival, since average precision ranks: a line that one agent saw costs
# nothing behind those that many saw.
TUNED: dict[str, Changes] = {
    OURS: (
        ("stations.evidence.publish", 1.0),
        ("stations.evidence.publish_ring", 0.5),
        ("stations.evidence.publish_seldom", 0.3),
        ("stations.evidence.publish_agents", 1),
    ),
    "chamfer_nms": (("gate_m", 0.75), ("rules.min_score", 0.2)),
    "polymerge": (("gate_m", 0.75), ("share", 0.3), ("rules.min_score", 0.5)),
    "heatmap_buffer": (("buffer_m", 0.5), ("share", 0.3), ("simplify_m", 0.1), ("rules.min_score", 0.0)),
    "crowdmap_literal": (("gate_m", 0.75), ("accept_m", 1.0), ("rules.min_score", 0.2)),
}


def tuned() -> Settings:
    """The settings that studies use."""
    chosen = {method: configured(defaults(method), changes) for method, changes in TUNED.items()}
    ours = chosen.pop(OURS)
    return Settings(tuple(sorted(chosen.items())), ours)


def defaults(method: str) -> Any:
    """A method's configuration as it comes."""
    return FuseConfig() if method == OURS else importlib.import_module(f"manyeyes.maps.baselines.{method}").Config()


def configured(config: Any, changed: Changes) -> Any:
    """A configuration with fields replaced; a dotted name goes into the part of that name."""
    for name, value in changed:
        head, _, rest = name.partition(".")
        config = replace(config, **{head: configured(getattr(config, head), ((rest, value),)) if rest else value})
    return config


def check_method(method: str) -> None:
    """ConfigError for a method that is not known."""
    if method not in METHODS and method not in ORACLES:
        raise ConfigError(f"No method is called {method!r}; known: {', '.join((*METHODS, *ORACLES))}.")


def map_of(
    method: str, observations: Sequence[Observation], settings: Settings, frame: Frame | None = None
) -> VectorMap:
    """The map that a method makes of observations."""
    if method == OURS:
        return fuse(observations, settings.ours, frame)
    if method not in RIVALS:
        raise ConfigError(f"{method!r} is told more than observations; known: {', '.join(METHODS)}.")
    rival, config = importlib.import_module(f"manyeyes.maps.baselines.{method}"), settings.of(method)
    return rival.fuse(observations, rival.Config() if config is None else config, frame)


def make_map(method: str, scene: Scene, settings: Settings) -> MapElements:
    """The published elements of a method's map of a scene."""
    if method in ORACLES:
        return oracle(method, scene, settings.ours)
    return map_of(method, scene.observations, settings, scene.place.frame).published().elements
