# SPDX-License-Identifier: Apache-2.0
"""Weights files: round trips, and errors that name the file and the cause."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from manyeyes.datatypes import BevGrid, CheckpointError, ConfigError, PointCloud
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.checkpoint import FORMAT, config_from_json, config_to_json, fingerprint
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.models.detector.presets import COSTR_TINY


@pytest.fixture(scope="module")
def model() -> Detector:
    torch.manual_seed(0)
    model = Detector(COSTR_TINY)
    model.train().extract_features([cloud(), cloud()])
    return model.eval().requires_grad_(False)


@pytest.fixture
def path(model, tmp_path) -> Path:
    path = tmp_path / "weights.safetensors"
    checkpoint.save(model, path, {"seed": 7})
    return path


def cloud() -> PointCloud:
    return PointCloud.of(torch.rand(800, 3, generator=torch.Generator().manual_seed(0)) * 40 - 20)


def error(path: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def rewrite(path: Path, change) -> None:
    state, metadata = checkpoint._read(path)
    change(state, metadata)
    save_file(state, path, metadata)


def test_save_and_load_round_trip(model, path):
    loaded = checkpoint.load(path)
    assert loaded.config == model.config and not loaded.training
    for name, value in model.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            assert torch.equal(loaded.state_dict()[name], value), name
    assert not any(p.requires_grad for p in loaded.parameters())
    assert torch.equal(
        loaded.extract_features([cloud()]).tokens.features, model.extract_features([cloud()]).tokens.features
    )
    assert loaded.fingerprint == fingerprint(model) != bytes(8)
    assert checkpoint.read_card(path) == {"seed": 7}
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_half_precision_halves_the_file_and_rounds_to_it(model, path, tmp_path):
    small = tmp_path / "half.safetensors"
    checkpoint.save(model, small, {}, half=True)
    assert small.stat().st_size < 0.65 * path.stat().st_size
    loaded = checkpoint.load(small)
    for name, value in model.state_dict().items():
        if value.is_floating_point():
            assert torch.equal(loaded.state_dict()[name], value.half().float()), name
    assert loaded.fingerprint != fingerprint(model)


def test_fingerprint_depends_on_weights_and_configuration(model):
    other = Detector(COSTR_TINY)
    other.load_state_dict(model.state_dict())
    assert fingerprint(other) == fingerprint(model)
    with torch.no_grad():
        next(other.parameters()).view(-1)[0] += 1e-3
    assert fingerprint(other) != fingerprint(model)
    renamed = Detector(dataclasses.replace(COSTR_TINY, prune_threshold=0.2))
    renamed.load_state_dict(model.state_dict())
    assert fingerprint(renamed) != fingerprint(model)


def test_classes_are_stored_where_they_are_not_the_default_alone(model, tmp_path):
    """Weights of earlier versions have no such field; their fingerprints hold."""
    assert "classes" not in config_to_json(COSTR_TINY)
    several = dataclasses.replace(COSTR_TINY, classes=("vehicle", "pedestrian", "cyclist"))
    assert config_from_json(DetectorConfig, config_to_json(several)) == several
    assert config_from_json(DetectorConfig, config_to_json(COSTR_TINY)) == COSTR_TINY
    checkpoint.save(Detector(several), tmp_path / "several.safetensors", {"command": "test"})
    loaded = checkpoint.load(tmp_path / "several.safetensors")
    assert loaded.config.classes == several.classes and loaded.head.classes == several.classes


def test_weights_of_another_shape_name_the_tensor(path):
    rewrite(path, lambda state, _: state.update({"head.out.weight": torch.zeros(3, 5)}))
    assert "tensor head.out.weight is (3, 5) in the file" in error(path)


def test_missing_and_unexpected_tensors_are_named(path):
    rewrite(path, lambda state, _: state.pop("token_prune.score.bias"))
    assert "tensor token_prune.score.bias is nothing in the file" in error(path)
    rewrite(path, lambda state, _: state.update({"aaa": torch.zeros(1), "token_prune.score.bias": torch.zeros(1)}))
    assert "tensor aaa is (1,) in the file and nothing in the model" in error(path)


def test_values_that_are_not_numbers_are_refused(path):
    rewrite(path, lambda state, _: state["head.out.bias"].fill_(torch.nan))
    assert "tensor head.out.bias has NaN or infinite values" in error(path)


@pytest.mark.parametrize("keep", (0, 5, 100, 5000))
def test_a_truncated_file(path, keep):
    path.write_bytes(path.read_bytes()[:keep])
    assert "not a whole safetensors file" in error(path)


def test_a_missing_file_and_a_folder(tmp_path):
    assert "no such file of weights" in error(tmp_path / "none.safetensors")
    assert "no such file of weights" in error(tmp_path)


def test_another_format(path):
    state = load_file(path)
    save_file(state, path)
    assert f"format is None, not '{FORMAT}'" in error(path)
    save_file(state, path, {"format": "manyeyes-detector-9", "config": "{}"})
    assert "format is 'manyeyes-detector-9'" in error(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("{", "not JSON"), ('{"grid": 3}', "has fields"), ("[1]", "has fields"), (None, "head_stride")],
)
def test_a_damaged_configuration_names_the_file(model, path, text, expected):
    config = json.loads(config_to_json(model.config))
    config["encoder"]["head_stride"] = 3
    rewrite(path, lambda _, metadata: metadata.update(config=json.dumps(config) if text is None else text))
    assert expected in error(path)


def test_a_misspelt_field_is_an_error():
    values = json.loads(config_to_json(COSTR_TINY))
    values["head_chanels"] = values.pop("head_channels")
    with pytest.raises(ConfigError, match="head_chanels"):
        config_from_json(DetectorConfig, json.dumps(values))


def test_an_unknown_name_lists_the_known():
    with pytest.raises(
        CheckpointError, match=r"No weights are named 'costr-huge'; known are .*costr-small.*safetensors"
    ):
        pretrained.load("costr-huge")
    with pytest.raises(CheckpointError, match="no such file of weights"):
        pretrained.load("somewhere/else.safetensors")


def test_a_path_is_loaded_unchanged(model, path):
    assert pretrained.load(path).fingerprint == fingerprint(model)


@pytest.mark.skipif(not pretrained.list_detectors(), reason="no weights are shipped yet")
@pytest.mark.parametrize("name", pretrained.list_detectors())
def test_shipped_weights_load_and_predict(name):
    loaded = pretrained.load(name)
    assert len(loaded.extract_features([cloud()]).tokens.features) >= 0
    assert checkpoint.read_card(Path(pretrained.__file__).parent / "weights" / f"{name}.safetensors")


def test_optional_configuration_field_round_trips_and_defaults_when_absent():
    area = BevGrid(-10.0, -5.0, -3.0, 10.0, 5.0, 3.0)
    config = DetectorConfig(BevGrid(-10.0, -10.0, -3.0, 10.0, 10.0, 3.0), output_range=area)
    text = config_to_json(config)
    assert config_from_json(DetectorConfig, text) == config and Detector(config).detection_range == area
    older = {k: v for k, v in json.loads(text).items() if k != "output_range"}
    read = config_from_json(DetectorConfig, json.dumps(older))
    assert read.output_range is None and Detector(read).detection_range == read.grid
    with pytest.raises(ConfigError):
        config_from_json(DetectorConfig, json.dumps({k: v for k, v in older.items() if k != "grid"}))
