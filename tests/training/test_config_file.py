# SPDX-License-Identifier: Apache-2.0
"""Settings as TOML: printed and read back they are equal; what a file gives replaces that alone; errors name file and field."""

from __future__ import annotations

from dataclasses import replace

import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.training.config_file import print_config, read_config
from manyeyes.training.presets import TRAINING_PLANS, TRAINING_PRESETS

ALL = {**TRAINING_PRESETS, **TRAINING_PLANS}


@pytest.mark.parametrize("name", ALL)
def test_a_printed_preset_read_back_is_equal(name, tmp_path):
    path = tmp_path / "preset.toml"
    path.write_text(print_config(ALL[name]))
    assert read_config(path, ALL[name]) == ALL[name]


def test_all_fields_of_a_file_replace_those_of_another_preset(tmp_path):
    path = tmp_path / "preset.toml"
    for name, other in (("costr-small/stage4", "costr-tiny"), ("costr-tiny", "costr-small/stage4")):
        path.write_text(print_config(ALL[name]))
        assert read_config(path, ALL[other]) == ALL[name] != ALL[other]


def test_fields_that_a_file_does_not_name_stay(tmp_path):
    path, preset, plan = tmp_path / "some.toml", TRAINING_PRESETS["costr-tiny"], TRAINING_PLANS["costr-tiny/plan"]
    path.write_text("steps = 7\n[augment]\nflip = false\n")
    assert read_config(path, preset) == replace(preset, steps=7, augment=replace(preset.augment, flip=False))
    path.write_text('codebook = "none"\n[stages.stage2]\nsteps = 9\n')
    changed = read_config(path, plan)
    assert changed == replace(plan, codebook=None, stages=(plan.stages[0], ("stage2", replace(preset, steps=9))))


@pytest.mark.parametrize(
    ("preset", "text", "error"),
    [
        ("costr-tiny", "step = 7", "step is no field of DetectorTrainConfig; did you mean steps?"),
        ("costr-tiny", "[augment]\nflipp = true", "augment.flipp is no field of AugmentConfig; did you mean flip?"),
        ("costr-tiny", 'steps = "many"', "configuration.steps needs an integer"),
        ("costr-tiny", "steps = ", "not a TOML file"),
        ("costr-tiny/plan", "[stages.stage3]\nsteps = 1", "stages.stage3 is no stage of this plan"),
        ("costr-tiny/plan", "[stages.stage1]\nbatchs = 1", r"stages.stage1.batchs is no field .* did you mean batch\?"),
        ("costr-tiny/plan", 'codebook_frames = "all"', "codebook_frames has another type"),
    ],
)
def test_an_error_names_the_file_and_the_field(preset, text, error, tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=error) as caught:
        read_config(path, ALL[preset])
    assert str(caught.value).startswith(str(path))


def test_classes_replace_those_of_every_detector_of_a_preset(capsys):
    """Of a stage, and of all stages of a plan and the weights that it releases; a map model has none."""
    words = ["--classes", "vehicle", "pedestrian", "--print-config"]
    assert cli.main(["train", "--preset", "costr-tiny", *words]) == 0
    assert capsys.readouterr().out.count('classes = ["vehicle", "pedestrian"]') == 1
    plan = TRAINING_PLANS["costr-small"]
    assert cli.main(["train", "--preset", "costr-small", *words]) == 0
    expected = len(plan.stages) + (plan.released is not None)
    assert capsys.readouterr().out.count('classes = ["vehicle", "pedestrian"]') == expected
    assert cli.main(["train", "--preset", "map-small-lidar", *words]) == 1
    assert "--classes is for presets of a detector; this one has no classes" in capsys.readouterr().err
    assert cli.main(["train", "--classes", "vehicle", "vehicle", "--print-config"]) == 1
    assert "at least one class, each once" in capsys.readouterr().err
    assert cli.main(["train", "--classes", "tram"]) == 2


def test_the_command_prints_what_its_options_make_of_a_file(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text("steps = 7\nbatch = 3\n")
    words = ["train", "--preset", "costr-tiny", "--config", str(path), "--batch", "5", "--print-config"]
    assert cli.main(words) == 0
    path.write_text(capsys.readouterr().out)
    preset = TRAINING_PRESETS["costr-tiny"]
    assert read_config(path, preset) == replace(preset, steps=7, batch=5)
    assert cli.main(["train", "--preset", "costr-tiny"]) == 1
    assert "--data is missing" in capsys.readouterr().err
