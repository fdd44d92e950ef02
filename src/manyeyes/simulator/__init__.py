# SPDX-License-Identifier: Apache-2.0
"""Simulation of towns, traffic, sensors and map fleets, reproducible from a seed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.simulator.fleet.config import CrowdConfig as CrowdConfig, crowd_config as crowd_config
    from manyeyes.simulator.fleet.place import Place as Place, load_place as load_place
    from manyeyes.simulator.fleet.simulate import Crowd as Crowd, simulate_crowd as simulate_crowd
    from manyeyes.simulator.presets import (
        SimulationPreset as SimulationPreset,
        simulate as simulate,
        simulation_preset as simulation_preset,
    )
    from manyeyes.simulator.scene.scenario import (
        ScenarioSpec as ScenarioSpec,
        SimulatedScenario as SimulatedScenario,
        make_scenario as make_scenario,
    )
    from manyeyes.simulator.scene.towns import load_town as load_town

__getattr__, __dir__ = attach(__name__)
