# SPDX-License-Identifier: Apache-2.0
"""Classes of boxes: which labels belong together."""

from __future__ import annotations

import pytest
import torch

from manyeyes.datatypes import CLASSES, LABELS, VEHICLE_LABELS, Boxes, ConfigError, GroundTruth, Transform


def one_of_each() -> Boxes:
    n = len(LABELS)
    return Boxes.of(torch.zeros(n, 3), torch.ones(n, 3), torch.zeros(n), label=torch.arange(n), id=torch.arange(n) + 5)


def test_labels_of_vehicles_come_first_so_that_shipped_weights_keep_their_meaning() -> None:
    assert LABELS[:4] == VEHICLE_LABELS == ("car", "van", "truck", "bus")
    assert len(LABELS) <= 8  # three bits of a message


def test_vehicles_are_the_default_class() -> None:
    assert [LABELS[i] for i in one_of_each().of_classes().label] == list(VEHICLE_LABELS)


def test_rows_are_positions_in_the_list_that_is_asked_for() -> None:
    boxes = one_of_each()
    assert boxes.class_rows(CLASSES).tolist() == [0, 0, 0, 0, 1, 2, 2]
    assert boxes.class_rows(("cyclist", "vehicle")).tolist() == [1, 1, 1, 1, -1, 0, 0]
    assert len(boxes.of_classes(CLASSES)) == len(LABELS) and len(boxes.of_classes(())) == 0


def test_an_unknown_class_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'horse'.*vehicle, pedestrian, cyclist"):
        one_of_each().of_classes(("horse",))


def test_truth_of_some_classes_keeps_who_has_seen_each_box() -> None:
    seen = torch.arange(2 * len(LABELS)).reshape(2, -1) % 3 == 0
    truth = GroundTruth.of(one_of_each(), Transform.stack([Transform.identity()] * 2), seen)
    some = truth.of_classes(("pedestrian", "cyclist"))
    assert some.boxes.id.tolist() == [9, 10, 11] and torch.equal(some.seen, seen[:, 4:])
    vehicles = truth.of_classes()
    assert vehicles.of_classes() is vehicles
