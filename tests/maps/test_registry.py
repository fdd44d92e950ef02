# SPDX-License-Identifier: Apache-2.0
"""Methods of map fusion by name, those of other distributions too, and the function that takes observations or files."""

from __future__ import annotations

import linecache
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.baselines.union import UnionConfig
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.registry import MAP_FUSION_METHODS, MAP_MODEL, OURS, VARIANTS, fuse_maps, list_map_fusions
from manyeyes.studies.maps.fleet_cells import method_source

THEIRS = """
from dataclasses import dataclass
from manyeyes.maps.baselines.union import UnionConfig, fuse as unite
from manyeyes.maps.registry import register_map_fusion

@dataclass(frozen=True)
class Config:
    max_observations: int = 1

@register_map_fusion("first-observations", Config)
def fuse(observations, config, frame):
    return unite(observations[: config.max_observations], UnionConfig(), frame)
"""
VIEW = np.array([[-10.0, -20.0], [60.0, -20.0], [60.0, 20.0], [-10.0, 20.0]])


def observe(agent: str) -> Observation:
    lines = MapElements.of([[[0.0, 1.0], [40.0, 1.0]]], DIVIDER, score=[0.9])
    return Observation(agent, agent, 1, np.array([5.0, 0.0, 0.0]), np.eye(3) * 0.1, VIEW, lines)


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A distribution with one method, installed."""
    module, info = tmp_path / "their_module.py", tmp_path / "theirs-1.0.dist-info"
    module.write_text(THEIRS)
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[manyeyes.map_fusion]\nfirst-observations = their_module\n")
    assert "first-observations" not in list_map_fusions()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(MAP_FUSION_METHODS, "_entry_points", None)
    monkeypatch.setattr(MAP_FUSION_METHODS, "_items", dict(MAP_FUSION_METHODS._items))
    yield module
    MAP_FUSION_METHODS._entry_points = None
    sys.modules.pop("their_module", None)


def test_our_method_comes_first_and_each_baseline_with_its_configuration() -> None:
    names = list_map_fusions()
    assert names[:3] == (OURS, *VARIANTS) and {"union", "polymerge", "crowdmap-literal"} < set(names)
    assert MAP_FUSION_METHODS.get("union").config_class() == UnionConfig()


def test_lines_that_map_models_detect_in_half_of_the_views_are_published_by_their_variant() -> None:
    """Eight agents with one view each; four of them detect a line, with scores that the default gives little weight."""
    seen, unseen = MapElements.of([[[0.0, 1.0], [40.0, 1.0]]], DIVIDER, score=[0.45]), MapElements.of([], DIVIDER)
    observations = [
        replace(observe(agent), elements=seen if number % 2 else unseen) for number, agent in enumerate("abcdefgh")
    ]
    published = {m: len(fuse_maps(observations, m).select_published().elements) for m in (OURS, MAP_MODEL)}
    assert published == {OURS: 0, MAP_MODEL: 1}


def test_observations_and_their_file_give_one_map(tmp_path: Path) -> None:
    observations, frame = [observe("a"), observe("b")], MapFrame(48.0, 11.0)
    (tmp_path / "observations").mkdir()
    write_observations(tmp_path / "observations" / "part.parquet", observations, frame)
    for method in ("union", OURS):
        fused = fuse_maps(observations, method, frame=frame)
        assert fuse_maps(tmp_path, method).quantised_hash() == fused.quantised_hash()
        assert fuse_maps(str(tmp_path), method).frame == frame
    assert len(fuse_maps(observations, "union")) == 2
    with pytest.raises(ConfigError, match="known: chamfer-nms, crowdmap-graph"):
        fuse_maps(observations, "magic")


def test_rows_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    write_observations(tmp_path / "a.parquet", [observe("a")], MapFrame())
    (tmp_path / "b.parquet").write_bytes(b"no parquet")
    with pytest.warns(UserWarning, match=r"1 rows were rejected; the first, .*b\.parquet"):
        assert len(fuse_maps(tmp_path, "union")) == 1
    write_observations(tmp_path / "a.parquet", [], MapFrame())
    with pytest.warns(UserWarning, match="rejected"), pytest.raises(ConfigError, match="no usable observation"):
        fuse_maps(tmp_path, "union")


def test_a_distribution_that_is_installed_adds_a_method(theirs: Path, tmp_path: Path) -> None:
    write_observations(tmp_path / "a.parquet", [observe("a"), observe("b")], MapFrame())
    assert "first-observations" in list_map_fusions()
    assert cli.main(["map", "fuse", str(tmp_path / "a.parquet"), "--method", "first-observations"]) == 0
    assert (tmp_path / "first-observations" / "lines.parquet").is_file()
    assert len(fuse_maps([observe("a"), observe("b")], "first-observations")) == 1


def test_the_source_of_their_method_is_part_of_a_cells_key(theirs: Path) -> None:
    before = method_source("first-observations")
    theirs.write_text(THEIRS + "MORE = 1\n")
    linecache.checkcache()
    assert method_source("first-observations") != before
