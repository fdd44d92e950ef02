# SPDX-License-Identifier: Apache-2.0
"""Names of object types in data sets, as labels of boxes.

Two- and three-wheelers count as their riders, with a rider or without. What is neither a vehicle nor a person, such as cones, bins
and animals, has no label, and readers leave it out.
"""

from __future__ import annotations

from manyeyes.datatypes import LABELS

_TYPES = {
    "car": ("car", "policecar", "tourcar", "regularvehicle"),
    "van": ("van", "longvehicle", "ambulance", "emergencyvehicle"),
    "truck": (
        "truck", "concretetruck", "excavator", "crane", "forklift", "roadroller", "bulldozer", "trailer", "largevehicle",
        "boxtruck", "truckcab", "vehiculartrailer",
    ),
    "bus": ("bus", "tram", "schoolbus", "articulatedbus"),
    "pedestrian": ("pedestrian", "person", "personsitting", "roadworker", "child", "officialsignaler"),
    "cyclist": ("cyclist", "bicyclist", "bicyclerider", "bicycle", "tricyclist", "wheeledrider"),
    "motorcyclist": (
        "motorcyclist", "motorcyclerider", "motorcylerider", "motorcycle", "scooterrider", "scooter", "trimotorcycle",
        "freighttricycle",
    ),
}  # fmt: skip
_LABEL_OF_TYPE = {name: LABELS.index(label) for label, names in _TYPES.items() for name in names}


def find_label(stated_type: str) -> int | None:
    """Return the index into LABELS of a type by its letters, whatever their case; None of another object."""
    return _LABEL_OF_TYPE.get("".join(letter for letter in stated_type.lower() if letter.isalpha()))
