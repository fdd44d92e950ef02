# SPDX-License-Identifier: Apache-2.0
"""Runs are distinguished by settings, seed and initial weights, and runs of older code go on."""

import json
from dataclasses import replace

import pytest

from manyeyes.models import checkpoint
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.run_identity import RunIdentity

CONFIG = TRAINING_PRESETS["costr-small/stage4"]
RUN = RunIdentity(CONFIG, 3, "00ff")


def change_config(change) -> dict[str, object]:
    """A record of RUN whose settings are changed as plain values."""
    record = RUN.to_record()
    config = json.loads(record["config"])
    change(config)
    return {**record, "config": json.dumps(config)}


@pytest.mark.parametrize("name", TRAINING_PRESETS)
def test_every_preset_is_equal_to_its_record(name):
    run = RunIdentity(TRAINING_PRESETS[name], 0)
    assert run.list_differences(run.to_record()) == []


def test_fields_that_are_newer_than_a_record_have_their_defaults():
    def drop(config):
        del config["validate_frames"], config["augment"]["early_fusion_prob"]

    older = change_config(drop)
    assert RUN.list_differences(older) == ["augment.early_fusion_prob is 0.15 there and 0.2 here"]
    default = replace(RUN, config=replace(CONFIG, augment=replace(CONFIG.augment, early_fusion_prob=0.15)))
    assert default.list_differences(older) == []


def test_every_difference_is_named_with_both_values():
    record = change_config(lambda config: config["detector"]["encoder"].update(channels=[8] * 6))
    config = replace(CONFIG, augment=replace(CONFIG.augment, sensors=None))
    found = RunIdentity(config, 4).list_differences(record)
    assert found[0].startswith("augment.sensors is {") and found[0].endswith("there and None here")
    assert found[1:] == [
        f"detector.encoder.channels is {[8] * 6} there and {list(CONFIG.detector.encoder.channels)} here",
        "the seed is 3 there and 4 here",
        "initial weights are 00ff there and random here",
    ]


@pytest.mark.parametrize("config", ["no JSON", '{"unknown": 1}'])
def test_settings_that_cannot_be_read_are_a_difference(config):
    (found,) = RUN.list_differences({**RUN.to_record(), "config": config})
    assert found.startswith("its settings are not those of this version of manyeyes (") and "\n" not in found


def test_a_record_without_settings_differs():
    assert RUN.list_differences({**RUN.to_record(), "config": "null"}) == ["it has no settings"]


def test_a_record_is_text_and_numbers():
    assert RUN.to_record() == {"config": checkpoint.config_to_json(CONFIG), "seed": 3, "begun": "00ff"}
