# SPDX-License-Identifier: Apache-2.0
"""Where a town's roads come from: a path, the data beside the repository, CARLA, py123d's wheel, or SUMO's generator."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator
from pathlib import Path

from manyeyes._io import MAX_TEXT_BYTES, unpack_zip_member
from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.maps.formats.opendrive import read_opendrive
from manyeyes.maps.roads.road_network import RoadNetwork
from manyeyes.ops.keyed_random import keyed_generator

TOWNS = ("Town01", "Town02", "Town03", "Town04", "Town05", "Town06", "Town07", "Town10HD")
TOWN_SPLIT = {
    "train": ("Town01", "Town02", "Town03", "Town04", "Town06"),
    "val": ("Town07",),
    "test": ("Town05", "Town10HD"),
}
_MAX_SEED_DIGITS = 18
GENERATED = "generated-"
_WHEEL_FOLDER = "py123d/parser/opendrive/carla_maps"


def assert_disjoint_split(split: dict[str, tuple[str, ...]] = TOWN_SPLIT) -> None:
    """ConfigError when a town stands on two sides of a split, or twice on one."""
    seen: dict[str, str] = {}
    for side, towns in split.items():
        for town in towns:
            if town in seen:
                raise ConfigError(f"{town} is in '{seen[town]}' and in '{side}'; a town belongs to one side only.")
            seen[town] = side


def load_town(name: str, path: Path | str | None = None) -> RoadNetwork:
    """Return a town's roads; see :func:`find_town` for the places."""
    return read_opendrive(find_town(name, path), name)


def find_town(name: str, path: Path | str | None = None) -> Path | bytes:
    """Return the OpenDRIVE file of a town, or its bytes where it lies in a wheel or is generated.

    name: one of TOWNS, ``generated-<seed>``, or any name when path is a file or a folder that holds ``<name>.xodr[.gz]``.
    Searched in this order: path (a file, a folder, or py123d's wheel), $MANYEYES_TOWNS (the same), ``carla_opendrive`` of the
    data folder beside the repository or above the working directory, a CARLA installation at $CARLA_ROOT, the installed py123d.
    """
    searched: list[str] = []
    if path is not None:
        given = _in_place(name, Path(path))
        if given is not None:
            return given
        searched.append(str(path))
        if not Path(path).exists() or name not in TOWNS:
            raise ConfigError(
                f"No roads for '{name}' in {path}: give an .xodr[.gz] file, a folder with {name}.xodr[.gz], or py123d's wheel."
            )
    if name.startswith(GENERATED):
        return generate_town(_seed_of(name))
    for place in _places():
        found = _in_place(name, place)
        if found is not None:
            return found
        searched.append(str(place))
    if name not in TOWNS:
        raise ConfigError(
            f"Unknown town '{name}'; known: {', '.join(TOWNS)}, {GENERATED}<seed>. Searched: {'; '.join(searched)}."
        )
    raise ConfigError(
        f"The roads of {name} are in none of: {'; '.join(searched) or 'no place'}. Give a path, set MANYEYES_TOWNS "
        "or CARLA_ROOT, or "
        f"`pip download --no-deps py123d==0.7.0 -d DIR` and give DIR; '{GENERATED}1' needs no file."
    )


def _places() -> Iterator[Path]:
    """Folders and wheels to search when no path is given, best first."""
    if os.environ.get("MANYEYES_TOWNS"):
        yield Path(os.environ["MANYEYES_TOWNS"])
    if os.environ.get("CARLA_ROOT"):
        yield Path(os.environ["CARLA_ROOT"]) / "CarlaUE4" / "Content" / "Carla" / "Maps" / "OpenDrive"
    # find_spec of a top-level name reads the metadata of the import system only: py123d itself is not run.
    spec = importlib.util.find_spec("py123d")
    for location in (spec.submodule_search_locations or ()) if spec else ():
        yield Path(location).joinpath(*_WHEEL_FOLDER.split("/")[1:])


def _in_place(name: str, place: Path) -> Path | bytes | None:
    """Return the town in a file, a wheel or a folder; None when it is not there."""
    if place.is_file():
        return _in_wheel(name, place) if place.suffix in (".whl", ".zip") else place
    if not place.is_dir():
        return None
    for candidate in (place / f"{name}.xodr", place / f"{name}.xodr.gz"):
        if candidate.is_file():
            return candidate
    for wheel in sorted(place.glob("py123d-*.whl")):
        found = _in_wheel(name, wheel)
        if found is not None:
            return found
    return None


def _in_wheel(name: str, wheel: Path) -> bytes | None:
    """Return a town's bytes out of py123d's wheel, or of any zip that holds <name>.xodr[.gz]; nothing is imported."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            for member in archive.namelist():
                if member.rsplit("/", 1)[-1] in (f"{name}.xodr", f"{name}.xodr.gz"):
                    return unpack_zip_member(archive, member, MAX_TEXT_BYTES)
    except (zipfile.BadZipFile, OSError) as error:
        raise ConfigError(f"{wheel}: expected a wheel or zip with {name}.xodr[.gz]; {error}.") from error
    return None


def _seed_of(name: str) -> int:
    text = name[len(GENERATED) :]
    if not text.isdecimal() or len(text) > _MAX_SEED_DIGITS:
        raise ConfigError(
            f"A generated town is named {GENERATED}<seed> of at most {_MAX_SEED_DIGITS} digits; got '{name[:60]}'."
        )
    return int(text)


def sumo_tool(name: str) -> str:
    """Return the path of one of SUMO's programs, from the eclipse-sumo package beside this Python."""
    try:
        import sumo
    except ImportError as error:
        raise MissingExtraError("sim", f"SUMO's {name}") from error
    folder = Path(sumo.SUMO_HOME) / "bin"
    for candidate in (folder / name, folder / f"{name}.exe", Path(sys.executable).parent / name):
        if candidate.is_file():
            return str(candidate)
    raise MissingExtraError("sim", f"SUMO's {name}, which is not in {folder},")


def run_sumo_tool(name: str, *arguments: str) -> None:
    """Run one of SUMO's programs; ConfigError with its last error line when it fails."""
    done = subprocess.run([sumo_tool(name), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("Error")] or lines[-1:]
        raise ConfigError(f"SUMO's {name} failed with {done.returncode}: {' '.join(errors)[:300]}")


def generate_town(seed: int) -> bytes:
    """Return OpenDRIVE bytes of a road network from SUMO's netgenerate: a grid, a web or a random net, the seed decides."""
    draw = keyed_generator(seed, "town")
    kind = ("grid", "spider", "rand")[int(draw.integers(3))]
    shape = {
        "grid": [
            "--grid.x-number", str(draw.integers(3, 6)),
            "--grid.y-number", str(draw.integers(3, 6)),
            "--grid.length", str(draw.integers(80, 140)),
            "--grid.attach-length", "60",
        ],
        "spider": [
            "--spider.arm-number", str(draw.integers(4, 7)),
            "--spider.circle-number", str(draw.integers(2, 4)),
            "--spider.space-radius", str(draw.integers(80, 130)),
            "--spider.omit-center", "true",
        ],
        "rand": [
            "--rand.iterations", str(draw.integers(30, 50)),
            "--rand.min-distance", "60",
            "--rand.max-distance", "140",
            "--rand.min-angle", "60",
            "--rand.connectivity", "0.95",
        ],
    }[kind]  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="manyeyes-town-") as folder:
        net, xodr = str(Path(folder) / "net.net.xml"), Path(folder) / "net.xodr"
        run_sumo_tool(
            "netgenerate", f"--{kind}", *shape, "--seed", str(seed), "--default.lanenumber", "2", "--rand.random-lanenumber",
            "--tls.guess", "true", "--no-turnarounds", "true", "--default.speed", "13.9", "--default.lanewidth", "3.5",
            "--sidewalks.guess", "true", "--crossings.guess", "true", "--output-file", net,
        )  # fmt: skip
        run_sumo_tool("netconvert", "--sumo-net-file", net, "--opendrive-output", str(xodr))
        return _as_streets(xodr.read_bytes())


def _as_streets(xodr: bytes) -> bytes:
    """What SUMO's writer lacks: a pavement of 2.5 m right of each street, and junctions without lines through their middle.

    The header's time of writing goes, so that one seed gives the same bytes.
    """
    root = ET.fromstring(xodr)
    header = root.find("header")
    if header is not None:
        header.attrib.pop("date", None)
    for road in root.findall("road"):
        if road.get("junction", "-1") != "-1":
            for mark in road.iter("roadMark"):
                mark.set("type", "none")
            continue
        for section in road.findall("lanes/laneSection"):
            right = section.find("right")
            if right is not None:
                outermost = min(int(lane.get("id", "0")) for lane in right.findall("lane"))
                pavement = ET.SubElement(right, "lane", id=str(outermost - 1), type="sidewalk", level="false")
                ET.SubElement(pavement, "width", sOffset="0", a="2.5", b="0", c="0", d="0")
    return ET.tostring(root, xml_declaration=True, encoding="UTF-8")
