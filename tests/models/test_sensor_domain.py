# SPDX-License-Identifier: Apache-2.0
"""The sensors of the training, in the card of weights and back; damaged ones are refused by name."""

from pathlib import Path

import pytest

from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.sensor_domain import CARD_KEY, read_sensor_domain, write_sensor_domain
from manyeyes.ops.lidar.sweep_statistics import SensorDomain

DOMAIN = SensorDomain((16.0, 64.0), (0.0, 1.0), (1.9, 2.25), (0.05, 0.1))


def test_a_card_keeps_the_domain(tmp_path):
    path = tmp_path / "w.safetensors"
    checkpoint.save(Detector(COSTR_TINY), path, write_sensor_domain(DOMAIN))
    assert checkpoint.load(path).sensor_domain == DOMAIN


def test_weights_without_a_domain_state_none(tmp_path):
    path = tmp_path / "w.safetensors"
    checkpoint.save(Detector(COSTR_TINY), path, write_sensor_domain(None))
    assert checkpoint.load(path).sensor_domain is None


@pytest.mark.parametrize(
    "change",
    [
        {"num_beams": [64.0, 16.0]},
        {"num_beams": [16.0]},
        {"num_beams": [16.0, float("nan")]},
        {"num_beams": "many"},
        {"other": [0.0, 1.0]},
    ],
)
def test_damaged_domains_are_refused_by_name(change):
    card = write_sensor_domain(DOMAIN)
    card[CARD_KEY].update(change)
    with pytest.raises(CheckpointError, match=r"card\.safetensors: sensor_domain"):
        read_sensor_domain(card, Path("card.safetensors"))
