# SPDX-License-Identifier: Apache-2.0
"""Names of object types in data sets."""

from __future__ import annotations

from manyeyes.datasets.object_types import find_label
from manyeyes.datatypes import LABELS


def test_types_of_real_recordings() -> None:
    labels = {name: find_label(name) for name in ("Car", "ScooterRider", "BicycleRider", "RoadWorker", "LongVehicle")}
    found = {name: None if label is None else LABELS[label] for name, label in labels.items()}
    assert found == {
        "Car": "car",
        "ScooterRider": "motorcyclist",
        "BicycleRider": "cyclist",
        "RoadWorker": "pedestrian",
        "LongVehicle": "van",
    }
    assert find_label("TrashCan") is None and find_label("Cone") is None


def test_names_are_distinguished_by_their_letters_alone() -> None:
    bus = LABELS.index("bus")
    assert find_label("BUS") == find_label(" Bus ") == bus
    assert find_label("EMERGENCY_VEHICLE") == LABELS.index("van")
    assert find_label("Person_sitting") == find_label("person sitting") == LABELS.index("pedestrian")
    assert find_label("") is None and find_label("DontCare") is None
