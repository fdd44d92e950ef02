# SPDX-License-Identifier: Apache-2.0
"""Shipped weights by name: a detector is no map model, and each is asked for by its own function."""

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.maps.map_model import Mapper
from manyeyes.models.maps.presets import FORMAT, TOY


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package that ships one map model, beside files that are told apart by their names alone."""
    torch.manual_seed(0)
    small = replace(TOY, head=replace(TOY.head, elements=5, learned=0, many=5))
    made = Mapper(small)
    (tmp_path / "weights").mkdir()
    checkpoint.save(
        made, tmp_path / "weights" / f"{pretrained.MAPPER}.safetensors", {"towns": []}, half=True, format=FORMAT
    )
    for name in ("costr-small", "map-small-camera", pretrained.FEAKM):
        (tmp_path / "weights" / f"{name}.safetensors").touch()
    monkeypatch.setattr(pretrained, "files", lambda package: tmp_path)
    return small


def test_names_are_told_apart_by_what_they_are(package):
    assert pretrained.names() == ("costr-small",)
    assert pretrained.mappers() == ("map-small", "map-small-camera")


def test_a_shipped_map_model_comes_ready_with_its_fingerprint(package):
    mapper = pretrained.load_mapper()
    assert mapper.config == package and not mapper.training and not any(p.requires_grad for p in mapper.parameters())
    assert mapper.fingerprint == checkpoint.fingerprint(mapper) != bytes(8)


def test_an_unknown_map_model_names_those_that_ship(package):
    with pytest.raises(CheckpointError, match="map-small, map-small-camera"):
        pretrained.load_mapper("map-large")
    with pytest.raises(CheckpointError, match="no such file"):
        pretrained.load_mapper("map-large.safetensors")
