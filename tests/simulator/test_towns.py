# SPDX-License-Identifier: Apache-2.0
"""Where towns are found, and in which order."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.scene import towns
from manyeyes.simulator.scene.towns import TOWN_SPLIT, TOWNS, assert_disjoint_split, find_town, load_town

ROAD = b"""<OpenDRIVE><road id="1" length="9" junction="-1"><planView><geometry s="0" x="0" y="0" hdg="0" length="9"><line/>
</geometry></planView><lanes><laneSection s="0"><right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/>
</lane></right></laneSection></lanes></road></OpenDRIVE>"""


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No town anywhere but where a test puts it."""
    for name in ("MANYEYES_TOWNS", "CARLA_ROOT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_split_covers_every_town_once():
    assert_disjoint_split()
    assert sorted(t for side in TOWN_SPLIT.values() for t in side) == sorted(TOWNS)
    with pytest.raises(ConfigError, match="Town05 is in 'train' and in 'test'"):
        assert_disjoint_split({"train": ("Town05",), "test": ("Town05",)})


def test_path_before_variable_before_carla(nowhere: Path, monkeypatch: pytest.MonkeyPatch):
    carla = nowhere / "carla" / "CarlaUE4" / "Content" / "Carla" / "Maps" / "OpenDrive"
    places = {"given": nowhere / "given", "variable": nowhere / "variable", "carla": carla}
    for place in places.values():
        place.mkdir(parents=True)
        (place / "Town05.xodr").write_bytes(ROAD)
    monkeypatch.setenv("CARLA_ROOT", str(nowhere / "carla"))
    assert find_town("Town05") == carla / "Town05.xodr"
    monkeypatch.setenv("MANYEYES_TOWNS", str(places["variable"]))
    assert find_town("Town05") == places["variable"] / "Town05.xodr"
    assert find_town("Town05", places["given"]) == places["given"] / "Town05.xodr"
    assert load_town("any", places["given"] / "Town05.xodr").name == "any"


def test_wheel_is_read_without_unpacking(nowhere: Path):
    wheel = nowhere / "wheels" / "py123d-0.7.0-py3-none-any.whl"
    wheel.parent.mkdir()
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("py123d/parser/opendrive/carla_maps/Town07.xodr.gz", gzip.compress(ROAD))
    assert find_town("Town07", wheel) == find_town("Town07", wheel.parent) == gzip.compress(ROAD)
    assert len(load_town("Town07", wheel).lanes) == 1


def test_installed_wheel_is_found_but_not_imported(nowhere: Path, monkeypatch: pytest.MonkeyPatch):
    package = nowhere / "site" / "py123d"
    maps = package / "parser" / "opendrive" / "carla_maps"
    maps.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (maps / "Town01.xodr.gz").write_bytes(gzip.compress(ROAD))
    monkeypatch.syspath_prepend(str(nowhere / "site"))
    assert find_town("Town01") == maps / "Town01.xodr.gz"


def test_errors_list_towns_places_and_remedy(nowhere: Path):
    with pytest.raises(ConfigError, match=r"Unknown town 'Town99'; known: Town01, .*generated-<seed>"):
        find_town("Town99")
    with pytest.raises(ConfigError, match=r"Town05 are in none of: .*pip download --no-deps py123d==0\.7\.0"):
        find_town("Town05")
    with pytest.raises(ConfigError, match="missing-folder"):
        find_town("Town05", nowhere / "missing-folder")
    with pytest.raises(ConfigError, match="at most 18 digits; got 'generated-x'"):
        find_town("generated-x")
    (nowhere / "torn.whl").write_bytes(b"PK")
    with pytest.raises(ConfigError, match=r"torn\.whl: expected a wheel"):
        find_town("Town05", nowhere / "torn.whl")


@pytest.mark.slow
def test_generated_town_is_the_same_for_the_same_seed():
    pytest.importorskip("sumo")
    one, again, other = find_town("generated-1"), find_town("generated-1"), find_town("generated-3")
    assert one == again
    assert one != other
    network = load_town("generated-1")
    assert len(network.junctions) >= 3
    assert {"driving", "sidewalk"} <= {lane.kind for lane in network.lanes}
    junctions = {road.id for road in network.roads if road.junction_id is not None}
    assert not [mark for mark in network.marks if mark.road_id in junctions]


def test_seeds_draw_grids_webs_and_random_nets_alike(monkeypatch: pytest.MonkeyPatch):
    drawn = []

    def record(program: str, kind: str, *options: str) -> None:
        drawn.append(kind)
        raise ConfigError(program)

    monkeypatch.setattr(towns, "run_sumo_tool", record)
    for seed in range(60):
        with pytest.raises(ConfigError, match="netgenerate"):
            towns.generate_town(seed)
    assert {kind: drawn.count(kind) > 10 for kind in drawn} == {"--grid": True, "--spider": True, "--rand": True}
