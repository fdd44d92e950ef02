# SPDX-License-Identifier: Apache-2.0
"""What OPV2V's yaml does not say: the class of a vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from manyeyes.datasets.opv2v import metadata


@dataclass(frozen=True)
class Size:
    """A CARLA vehicle and what it is."""

    lwh: tuple[float, float, float]
    label: str


@pytest.mark.parametrize(
    "vehicle",
    [
        Size((4.90, 2.06, 1.49), "car"),  # Lincoln MKZ
        Size((5.36, 2.03, 1.41), "car"),  # Chevrolet Impala
        Size((3.81, 1.97, 1.92), "car"),  # Jeep Wrangler
        Size((4.44, 2.03, 2.04), "van"),  # Volkswagen T2
        Size((5.92, 1.99, 2.56), "van"),  # Mercedes Sprinter
        Size((5.20, 2.61, 2.47), "truck"),  # delivery truck
        Size((8.47, 2.89, 3.83), "truck"),  # fire engine
        Size((10.27, 3.94, 4.25), "bus"),  # Mitsubishi Fuso Rosa
    ],
    ids=lambda v: f"{v.label} {v.lwh[0]}",
)
def test_labels_by_size(vehicle: Size) -> None:
    assert metadata.LABELS[metadata._label({}, np.array(vehicle.lwh))] == vehicle.label


def test_labels_by_name_come_before_size() -> None:
    size = np.array([4.5, 1.9, 1.5])
    assert metadata.LABELS[metadata._label({"obj_type": "Truck"}, size)] == "truck"
    assert metadata.LABELS[metadata._label({"bp_id": "vehicle.mercedes.sprinter"}, size)] == "van"
