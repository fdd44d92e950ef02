# SPDX-License-Identifier: Apache-2.0
"""Notes on sensors that differ from those that a detector was trained on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from manyeyes.datasets.recording_check import ReadSensor, measure_first_sweeps
from manyeyes.ops.lidar.sweep_statistics import SensorDomain

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.datasets.base import Recording

REMEDY = "expect fewer and false boxes; see 'manyeyes check', and train on with 'manyeyes finetune'"


def describe_deviations(sensors: Iterable[ReadSensor], domain: SensorDomain) -> dict[str, tuple[int, ...]]:
    """Return what lies outside of a domain, each with the agents that it is true of."""
    found: dict[str, list[int]] = {}
    for sensor in sensors:
        for text in domain.find_deviations(sensor.sweep, sensor.period_s):
            agents = found.setdefault(text, [])
            if sensor.agent_id not in agents:
                agents.append(sensor.agent_id)
    return {text: tuple(agents) for text, agents in found.items()}


def print_sensor_note(recording: Recording, scenario: str, detector: object, console: Console) -> None:
    """Print one line where sensors of a scenario lie outside of what the detector was trained on.

    Args:
        recording: what is played.
        scenario: the one whose first sweeps are measured.
        detector: one whose weights state their sensors (``models.sensor_domain``); of others nothing is known.
        console: for the line.
    """
    domain = getattr(detector, "sensor_domain", None)
    if not isinstance(domain, SensorDomain):
        return
    found = describe_deviations(measure_first_sweeps(recording, scenario), domain)
    if found:
        listed = "; ".join(f"{text} of agent {', '.join(map(str, agents))}" for text, agents in found.items())
        console.print(f"note: {scenario}: {listed}: {REMEDY}", highlight=False, markup=False, soft_wrap=True)
