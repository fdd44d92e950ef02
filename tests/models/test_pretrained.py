# SPDX-License-Identifier: Apache-2.0
"""Shipped weights by name: a detector is no map model, and each is asked for by its own function."""

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.maps.map_model import MapModel
from manyeyes.models.maps.presets import FORMAT, MAP_TINY
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with one map model, beside files that only their names distinguish."""
    torch.manual_seed(0)
    small = replace(
        MAP_TINY, head=replace(MAP_TINY.head, num_queries=5, num_learned_queries=0, num_one_to_many_queries=5)
    )
    made = MapModel(small)
    (tmp_path / "weights").mkdir()
    checkpoint.save(
        made,
        tmp_path / "weights" / f"{pretrained.DEFAULT_MAP_MODEL}.safetensors",
        {"towns": []},
        half=True,
        format=FORMAT,
    )
    for name in ("costr-small", "map-small-camera", pretrained.DEFAULT_FEAKM):
        (tmp_path / "weights" / f"{name}.safetensors").touch()
    monkeypatch.setattr(pretrained, "files", lambda package: tmp_path)
    return small


def test_names_are_grouped_by_model_type(package):
    assert pretrained.list_detectors() == ("costr-small",)
    assert pretrained.list_map_models() == ("map-small-camera", "map-small-lidar")


def test_a_shipped_map_model_comes_ready_with_its_fingerprint(package):
    mapper = pretrained.load_map_model()
    assert mapper.config == package and not mapper.training and not any(p.requires_grad for p in mapper.parameters())
    assert mapper.fingerprint == checkpoint.fingerprint(mapper) != bytes(8)


def test_unknown_map_model_error_lists_the_shipped_ones(package):
    with pytest.raises(CheckpointError, match="map-small-camera, map-small-lidar"):
        pretrained.load_map_model("map-large")
    with pytest.raises(CheckpointError, match="no such file"):
        pretrained.load_map_model("map-large.safetensors")


def test_bfloat16_is_chosen_where_the_processor_has_it_and_can_be_switched_off(monkeypatch):
    """In pairs, two inputs to a word: the matrices of an attention block are half as long."""

    def is_paired(detector):
        return detector.fusion.transformer.blocks[0].folded.matrices.query.dtype.kind == "i"

    assert not is_paired(pretrained.load())
    assert is_paired(pretrained.load(in_bfloat16=True)) == HAS_BFLOAT16
    monkeypatch.delenv(pretrained.BFLOAT16_VARIABLE)
    assert is_paired(pretrained.load()) == HAS_BFLOAT16
    assert not is_paired(pretrained.load(in_bfloat16=False))
    monkeypatch.setenv(pretrained.BFLOAT16_VARIABLE, "yes")
    with pytest.raises(ConfigError, match=r"MANYEYES_BFLOAT16 is 0 .* got 'yes'"):
        pretrained.load()
