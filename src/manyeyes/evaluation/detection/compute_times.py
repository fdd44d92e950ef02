# SPDX-License-Identifier: Apache-2.0
"""Compute time of each method as a constant of the protocol (compute_times.toml): results do not depend on a machine's load."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from manyeyes.agents.strategies.names import current_name

OTHER = "other"
"""Row of strategies that the file does not list."""


@cache
def load_compute_times_ms() -> Mapping[str, float]:
    """Return milliseconds of an agent's own step by method, and those of OTHER."""
    content = tomllib.loads((Path(__file__).parent / "compute_times.toml").read_text(encoding="utf-8"))
    return {name: float(value) for name, value in content["compute_ms"].items()}


def compute_time_s(method: str) -> float:
    """Return the seconds that an agent needs for share and perceive with a method."""
    times_ms = load_compute_times_ms()
    return times_ms.get(current_name(method), times_ms[OTHER]) / 1e3
