# SPDX-License-Identifier: Apache-2.0
"""The command train on a map preset: from a simulated recording of generated towns to weights that draw tiles."""

import json
from pathlib import Path

import pytest

from manyeyes.cli import main as cli, train
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.simulator.presets import simulate
from manyeyes.studies.map_recordings import load_true_maps
from manyeyes.studies.maps import model_study
from manyeyes.studies.options import MapModelOptions

pytestmark = pytest.mark.training


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    simulate("smoke-opv2v", folder)
    return folder


@pytest.mark.slow
def test_train_then_judge(recorded, tmp_path, capsys):
    out = tmp_path / "run"
    train.main(train.Options((recorded,), preset="map-tiny", out=out, steps=2, batch=1))
    weights = out / "weights.safetensors"
    model = checkpoint.load_as(weights, FORMAT, MapModelConfig, MapModel)
    assert model.config.tile.x_max == 60.0 and (out / "loss.png").exists() and (out / "train.json").exists()
    card = checkpoint.read_card(weights, FORMAT)
    assert card["towns"] == ["generated-1"] and card["command"]
    study = ("study", "semi-global", "--data", recorded, "--weights", weights, "--workers", 1)
    common = [str(word) for word in (*study, "--seeds", 1, "--scenario-stride", 2, "--out", tmp_path / "study")]
    assert cli.main(common) == 0
    rows = json.loads((tmp_path / "study" / "semi-global.json").read_text())["result"]["rows"]["LiDAR"]
    assert [row["name"] for row in rows] == ["1", "2", "5", "10"] and (tmp_path / "study" / "semi-global.png").exists()
    assert cli.main([*common, "--split", "train"]) == 1
    assert "Split by place" in capsys.readouterr().err


@pytest.mark.slow
def test_true_maps_are_those_of_the_scenarios_towns(recorded):
    maps = load_true_maps(Opv2vRecording(recorded, "train"))
    assert list(maps) == ["generated-1"] and len(maps["generated-1"]) > 10


def test_an_unknown_preset_names_the_map_presets():
    with pytest.raises(ConfigError, match="map-small-lidar"):
        train.main(train.Options((Path("nowhere"),), preset="map-large"))


@pytest.mark.slow
def test_a_model_with_cameras_needs_pictures(recorded, capsys):
    with pytest.raises(ConfigError, match="no pictures in generated-1_0000"):
        train.main(train.Options((recorded,), preset="map-small-camera"))
    # Of the models that ship those are evaluated whose sensors the recording has.
    options = MapModelOptions(data=recorded, split="test")
    assert [model.sensors for model in model_study.resolve_models(options)] == ["LiDAR"]
