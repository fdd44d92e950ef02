# SPDX-License-Identifier: Apache-2.0
"""Methods that make a map of observations, by name: our own, the baselines and those of third parties.

A method is a function of observations, its configuration and the frame, and receives nothing else.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.registry import Registry
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import find_observation_files, read_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse
from manyeyes.maps.isolation import IsolatedFailure, isolate_failures

OURS, TWO_AGENTS, MAP_MODEL = "manyeyes", "manyeyes-two-agents", "manyeyes-map-model"
VARIANTS = (TWO_AGENTS, MAP_MODEL)
"""Our own method with other settings."""
FuseFunction = Callable[[Sequence[Observation], Any, MapFrame | None], VectorMap]
Fuse = TypeVar("Fuse", bound=FuseFunction)


@dataclass(frozen=True)
class MapFusionMethod:
    """A registered function and the class of its configuration, whose defaults are those of the method."""

    fuse: FuseFunction
    config_class: Callable[[], Any]


MAP_FUSION_METHODS: Registry[MapFusionMethod] = Registry(
    "map fusion method", "manyeyes.map_fusion", "manyeyes.maps.baselines"
)


def register_map_fusion(name: str, config_class: Callable[[], Any]) -> Callable[[Fuse], Fuse]:
    """Register a function of observations, configuration and frame under a name, as a decorator.

    Args:
        name: what commands, studies and ``fuse_maps`` call it. config_class: makes the default configuration without arguments.

    Raises:
        ConfigError: another method has the name.
    """

    def decorate(function: Fuse) -> Fuse:
        MAP_FUSION_METHODS.register(name)(MapFusionMethod(function, config_class))
        return function

    return decorate


def make_two_agents_config() -> MapFusionConfig:
    """Return the default configuration, but publish nothing that fewer than two agents detected, except by a surveyed pole."""
    return _with_evidence(min_publish_agents=2)


def make_map_model_config() -> MapFusionConfig:
    """Return the configuration for observations of our map models: they detect fewer lines, and score those lower, than agents of
    the simulated fleets, whose errors the defaults describe. Chosen on Town07.
    """
    return _with_evidence(detection_prob=0.5, score_low=0.2, score_high=0.5)


def _with_evidence(**changes: float) -> MapFusionConfig:
    """Return the default configuration with fields of its EvidenceConfig replaced."""
    config = MapFusionConfig()
    evidence = replace(config.stations.evidence, **changes)
    return replace(config, stations=replace(config.stations, evidence=evidence))


register_map_fusion(OURS, MapFusionConfig)(fuse)
register_map_fusion(TWO_AGENTS, make_two_agents_config)(fuse)
register_map_fusion(MAP_MODEL, make_map_model_config)(fuse)


def list_map_fusions() -> tuple[str, ...]:
    """Return the names of all methods, our own first."""
    own = (OURS, *VARIANTS)
    return (*own, *(name for name in MAP_FUSION_METHODS.names() if name not in own))


def fuse_maps(
    observations: Sequence[Observation] | Path | str,
    method: str = OURS,
    config: Any = None,
    frame: MapFrame | None = None,
) -> VectorMap:
    """Fuse observations of many agents into one map.

    Args:
        observations: the observations, or a Parquet file, a folder of them, or a folder of 'map simulate'. Rows that cannot be
            used are left out with a warning.
        method: a registered name. config: of the method's class; its defaults without. frame: the map's origin on earth; by
            default that of the files, or none.

    Returns:
        All elements with their states; ``select_published`` gives the map to use.

    Raises:
        ConfigError: the method is not known, or there is no usable observation. ObservationError: no file can be read.
    """
    chosen = MAP_FUSION_METHODS.get(method)
    if isinstance(observations, Path | str):
        loaded = read_observations(find_observation_files(Path(observations)), frame)
        if loaded.rejected:
            first = loaded.rejected[0]
            warnings.warn(
                f"{len(loaded.rejected)} rows were rejected; the first, {first.file}: {first.reason}", stacklevel=2
            )
        if not loaded.observations:
            raise ConfigError(f"{observations} holds no usable observation; 'manyeyes map simulate' makes some.")
        observations, frame = loaded.observations, loaded.frame
    return chosen.fuse(observations, chosen.config_class() if config is None else config, frame)


def fuse_isolated(
    observations: Sequence[Observation], method: str, config: Any, frame: MapFrame
) -> tuple[VectorMap, tuple[IsolatedFailure, ...]]:
    """Fuse observations into one map, without those that make the method fail; see :func:`fuse_maps` for the arguments.

    Returns:
        The map, and rows of the observations that were left out, with the error of each.
    """
    fuse_method = MAP_FUSION_METHODS.get(method).fuse
    return isolate_failures(
        lambda rows: fuse_method([observations[row] for row in rows], config, frame), len(observations)
    )
