# SPDX-License-Identifier: Apache-2.0
"""A command whose optional packages are not installed is refused by one line before it begins, and needs no others."""

from __future__ import annotations

import os
import subprocess
import sys
import typing
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

import pytest

from manyeyes.cli import main as cli
from manyeyes.cli.requirements import EXTRAS, REQUIREMENTS, check_requirements
from manyeyes.datatypes import MissingExtraError

ALL_COMMANDS = {command for command in cli.COMMANDS if command not in cli.COMMAND_GROUPS}
ALL_COMMANDS |= {f"{group} {command}" for group, commands in cli.COMMAND_GROUPS.items() for command in commands}
OPTIONAL = sorted({module for modules in EXTRAS.values() for module in modules})


class Finder:
    """A finder that hides packages, installed or not."""

    def __init__(self, hidden: Sequence[str]) -> None:
        self.hidden = set(hidden)

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Refuse a hidden package, and leave others to the finders behind this one."""
        if name.partition(".")[0] in self.hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.fixture
def hide(monkeypatch: pytest.MonkeyPatch) -> Iterator[Finder]:
    finder = Finder(())
    for name in [name for name in sys.modules if name.partition(".")[0] in OPTIONAL]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    yield finder


def test_every_command_declares_what_it_needs() -> None:
    assert set(REQUIREMENTS) == ALL_COMMANDS
    for requirement in (r for requirements in REQUIREMENTS.values() for r in requirements):
        assert set(requirement.modules) <= set(EXTRAS[requirement.extra])


@pytest.mark.parametrize("command", sorted(ALL_COMMANDS))
def test_declared_options_are_options_of_the_command(command: str) -> None:
    for option in {r.option for r in REQUIREMENTS[command] if r.option}:
        kind: type = cli.load_command(command).options
        for name in option.split("."):
            hints = typing.get_type_hints(kind)
            assert name in hints
            kind = hints[name]


CASES = [
    ("demo", "libsumo", "demo needs the 'sim' extra: pip install 'manyeyes[sim]'"),
    ("demo", "sumo", "demo needs the 'sim' extra"),
    ("demo", "pyarrow", "demo needs the 'sim' extra"),
    ("demo", "matplotlib", "demo needs the 'view' extra: pip install 'manyeyes[view]'"),
    ("demo", "PIL libsumo", "demo needs the 'sim' and 'view' extras: pip install 'manyeyes[sim,view]'"),
    ("simulate", "libsumo", "simulate needs the 'sim' extra"),
    ("simulate --cameras", "PIL", "simulate with cameras needs the 'view' extra"),
    ("simulate --preset carla-maps-camera", "PIL", "simulate with preset *-camera needs the 'view' extra"),
    ("train --data d", "matplotlib", "train needs the 'view' extra"),
    ("train --data d --preset map-small-lidar", "shapely", "train with preset map-* needs the 'map' extra"),
    ("train --data d --tensorboard", "tensorboard", "train with tensorboard needs the 'train' extra"),
    ("finetune --data d --tensorboard", "tensorboard", "finetune with tensorboard needs the 'train' extra"),
    ("replay d", "PIL", "replay needs the 'view' extra"),
    ("view d", "PIL", "view needs the 'view' extra"),
    ("view d --rerun a.rrd", "rerun PIL", "view with rerun needs the 'rerun' extra: pip install 'manyeyes[rerun]'"),
    ("view d --mcap a.mcap", "mcap PIL", "view with mcap needs the 'live' extra: pip install 'manyeyes[live]'"),
    ("view d --mcap a.mcap --map .", "shapely", "view with map needs the 'map' extra: pip install 'manyeyes[map]'"),
    ("pose d --correctors voting gicp", "small_gicp", "pose with correctors gicp needs the 'icp' extra"),
    ("map build d", "matplotlib", "map build needs the 'view' extra"),
    ("map build d", "shapely", "map build needs the 'map' extra"),
    ("map simulate", "pyarrow", "map simulate needs the 'map' extra"),
    ("map import d", "pyarrow", "map import needs the 'map' extra"),
    ("map import a.osm b.gpkg", "pyproj", "map import with sources *.gpkg, *.geojson needs the 'map' extra"),
    ("map fuse d", "pyarrow", "map fuse needs the 'map' extra"),
    ("map fuse d --method polymerge", "shapely", "map fuse with method polymerge, "),
    ("map fuse d --store s", "shapely", "map fuse with store needs the 'map' extra"),
    ("map fuse d --store s --executor dask", "distributed", "map fuse with executor dask needs the 'dask' extra"),
    ("map retract s --reason r --agent a --executor ray", "ray", "map retract with executor ray needs the 'ray' extra"),
    ("map retract s3://b/c --reason r --agent a", "s3fs", "map retract with store s3://* needs the 'cloud' extra"),
    ("map export s3://b/c a.geojson", "s3fs", "map export with folder s3://* needs the 'cloud' extra"),
    (
        "map view gs://b/c",
        "fsspec",
        "map view with folder *://* needs the 'cloud' extra: pip install 'manyeyes[cloud]'",
    ),
    ("map view m --truth s3://b/c", "s3fs", "map view with truth s3://* needs the 'cloud' extra"),
    ("map diff m s3://b/c", "s3fs", "map diff with new s3://* needs the 'cloud' extra"),
    ("map evaluate s3://b/c", "s3fs", "map evaluate with folder s3://* needs the 'cloud' extra"),
    ("map import a.osm s3://b/c", "s3fs", "map import with sources s3://* needs the 'cloud' extra"),
    ("view d --mcap a.mcap --map s3://b/c", "s3fs", "view with map s3://* needs the 'cloud' extra"),
    ("map evaluate m", "shapely", "map evaluate needs the 'map' extra"),
    ("map diff m n", "pyarrow", "map diff needs the 'map' extra"),
    ("map export m a.gpkg", "pyogrio", "map export with file *.gpkg, *.pmtiles needs the 'map' extra"),
    (
        "map export m a.zip --format pmtiles",
        "pyogrio",
        "map export with format geopackage, pmtiles needs the 'map' extra",
    ),
    ("map export m a.parquet", "shapely", "map export with file *.parquet needs the 'map' extra"),
    ("map view m --out m.png", "matplotlib", "map view with out *.png needs the 'view' extra"),
    ("live run d", "zenoh", "live run with transport zenoh needs the 'live' extra: pip install 'manyeyes[live]'"),
    ("live run d --record r.mcap", "mcap", "live run with record needs the 'live' extra"),
    ("live run d --transport udp --security warn", "cryptography", "live run with security warn, require needs"),
    (
        "live run d --transport udp --metrics 127.0.0.1:1",
        "prometheus_client",
        "live run with metrics needs the 'metrics' extra",
    ),
    ("live map --transport udp", "pyarrow", "live map needs the 'map' extra"),
    ("live demo", "zenoh", "live demo needs the 'live' extra"),
    ("live replay r.mcap", "mcap", "live replay needs the 'live' extra"),
    ("live export r.mcap", "mcap", "live export needs the 'live' extra"),
    ("live export r.mcap", "cryptography", "live export needs the 'live' extra"),
    ("keys anchor", "cryptography", "keys anchor needs the 'live' extra: pip install 'manyeyes[live]'"),
    ("keys issue a", "cryptography", "keys issue needs the 'live' extra"),
    ("keys pool --out p", "cryptography", "keys pool needs the 'live' extra"),
    ("keys verify c", "cryptography", "keys verify needs the 'live' extra"),
    ("keys revoke c", "cryptography", "keys revoke needs the 'live' extra"),
    ("keys trust t", "cryptography", "keys trust needs the 'live' extra"),
    ("keys demo", "cryptography", "keys demo needs the 'live' extra"),
    ("report docs", "matplotlib", "report docs needs the 'view' extra"),
    ("study robustness --data d", "matplotlib", "study robustness needs the 'view' extra"),
    ("study qualitative --data d", "PIL", "study qualitative needs the 'view' extra"),
    (
        "study pose-estimation --data d --correctors gicp",
        "small_gicp",
        "study pose-estimation with correctors gicp needs",
    ),
    ("study semi-global --data d", "shapely", "study semi-global needs the 'map' extra"),
    ("study fusion", "shapely", "study fusion needs the 'map' extra"),
]


@pytest.mark.parametrize(("words", "hidden", "error"), CASES)
def test_a_command_is_refused_before_it_reads_or_writes(
    words: str,
    hidden: str,
    error: str,
    hide: Finder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    hide.hidden = set(hidden.split())
    assert cli.main(words.split()) == 1
    output = capsys.readouterr()
    assert output.err.startswith(f"manyeyes: {error}") and output.err.count("\n") == 1
    assert output.out == "" and not any(tmp_path.iterdir())


def test_every_unconditional_requirement_is_refused_by_some_case() -> None:
    commands = {command for command in ALL_COMMANDS if any(not r.option for r in REQUIREMENTS[command])}
    groups = {command.partition(" ")[0] if command.startswith("study") else command for command in commands}
    cases = [words for words, _, _ in CASES]
    assert [command for command in sorted(groups) if not any(words.startswith(command) for words in cases)] == []


def test_an_option_that_is_not_given_requires_nothing(hide: Finder) -> None:
    from manyeyes.cli.map.fuse import Options

    hide.hidden = {"shapely", "dask", "distributed", "ray"}
    check_requirements("map fuse", Options(Path("observations")))
    with pytest.raises(MissingExtraError, match="with store"):
        check_requirements("map fuse", Options(Path("observations"), store=Path("city")))


RUN_WITHOUT = """
import sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(name)
from manyeyes.cli.main import main
from manyeyes.cli.requirements import EXTRAS
for line in sys.stdin.read().splitlines():
    allowed, _, words = line.partition(" | ")
    hidden = {m for modules in EXTRAS.values() for m in modules} - set(allowed.split())
    sys.meta_path.insert(0, Finder())
    for name in [n for n in sys.modules if n.partition(".")[0] in hidden]:
        del sys.modules[name]
    if main(words.split()):
        sys.exit(f"{words} needs more than {allowed}")
"""
SEQUENCE = """\
pyarrow shapely | map simulate cross --observations 6 --size 100 --out m
pyarrow shapely | map evaluate m/truth --truth m/truth
pyarrow | map fuse m --method union
pyarrow | map diff m/union m/union --out m/change.html
pyarrow | map export m/union m/a.geojson
pyarrow | map export m/union m/a.osm
pyarrow | map export m/union m/a.npz
pyarrow | map export m/union m/a.json --format nuscenes
pyarrow | map export m/union m/a.json --format argoverse2
pyarrow shapely | map export m/union m/a.parquet
pyarrow shapely pyogrio | map export m/union m/a.gpkg
pyarrow shapely pyogrio | map export m/union m/a.pmtiles
pyarrow shapely | map view m/union"""


@pytest.mark.slow
def test_map_commands_need_no_more_than_they_declare(tmp_path: Path) -> None:
    for module in ("pyarrow", "shapely", "pyogrio"):
        pytest.importorskip(module, reason="the 'map' extra is not installed")
    # Modules cannot be unloaded safely, so each set of packages has a process of its own.
    for allowed, lines in groupby(SEQUENCE.splitlines(), lambda line: line.partition(" | ")[0]):
        part = "\n".join(lines)
        words = [sys.executable, "-c", RUN_WITHOUT]
        done = subprocess.run(words, input=part, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True)
        assert done.returncode == 0, f"{allowed}: {done.stderr}"
