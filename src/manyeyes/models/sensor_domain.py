# SPDX-License-Identifier: Apache-2.0
"""Sensors that a detector was trained on, kept in the card of its weights."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from manyeyes.datatypes import CheckpointError
from manyeyes.ops.lidar.sweep_statistics import SensorDomain

CARD_KEY = "sensor_domain"


def write_sensor_domain(domain: SensorDomain | None) -> dict[str, Any]:
    """Return the addition to a card; empty without a domain."""
    if domain is None:
        return {}
    return {CARD_KEY: {name: [float(f"{v:.4g}") for v in bounds] for name, bounds in asdict(domain).items()}}


def read_sensor_domain(card: dict[str, Any], path: Path) -> SensorDomain | None:
    """Return the domain of a card of weights; None where it has none.

    Raises:
        CheckpointError: it does not have a minimum and a maximum for each property.
    """
    stored = card.get(CARD_KEY)
    if stored is None:
        return None
    names = [field.name for field in fields(SensorDomain)]
    if not isinstance(stored, dict) or set(stored) != set(names) or not all(map(_is_bounds, stored.values())):
        raise CheckpointError(
            f"{path}: {CARD_KEY} of its card needs a minimum and a maximum of {', '.join(names)}; copy the file again."
        )
    return SensorDomain(**{name: (float(low), float(high)) for name, (low, high) in stored.items()})


def _is_bounds(value: Any) -> bool:
    if not isinstance(value, list) or len(value) != 2:
        return False
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in value):
        return False
    return value[0] <= value[1]
