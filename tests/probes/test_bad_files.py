# SPDX-License-Identifier: Apache-2.0
"""Input files with absurd numbers, or that unpack to more than they should: a designed error of one line, in little memory."""

from __future__ import annotations

import gzip
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from manyeyes._io import MAX_TEXT_BYTES, read_file
from manyeyes.datasets.dair_v2x.json_files import read_calibration
from manyeyes.datasets.formats.image_io import read_image
from manyeyes.datasets.formats.json_file import load_json
from manyeyes.datasets.formats.pcd import read_pcd
from manyeyes.datasets.opv2v.metadata import load_yaml, read_protocol, read_record
from manyeyes.datatypes import ManyeyesError
from manyeyes.maps.formats.lanelet2 import read_lanelet2
from manyeyes.maps.formats.opendrive import read_opendrive
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.simulator.scene.towns import load_town

MAX_GROWTH_BYTES = 768 << 20
Read = Callable[[Path], object]


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def opendrive(
    length: str = "10", geometry: str = "<line/>", piece_length: str = "10", width: str = "3", lanes: int = 1
) -> str:
    lane = "".join(
        f'<lane id="-{k + 1}" type="driving"><width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane>'
        for k in range(lanes)
    )
    return (
        f'<OpenDRIVE><road id="7" length="{length}" junction="-1"><planView><geometry s="0" x="0" y="0" hdg="0" '
        f'length="{piece_length}">{geometry}</geometry></planView><lanes><laneSection s="0"><center><lane id="0"/></center>'
        f"<right>{lane}</right></laneSection></lanes></road></OpenDRIVE>"
    )


def read_road(text: str) -> Read:
    return lambda folder: read_opendrive(write(folder / "a.xodr", text))


def pcd(count: str = "1 1 1", points: int = 1, data: str = "binary", body: bytes = bytes(12)) -> bytes:
    header = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {count}\nWIDTH {points}\nHEIGHT 1\nPOINTS {points}\n"
    )
    return f"{header}DATA {data}\n".encode() + body


def read_cloud(content: bytes) -> Read:
    return lambda folder: read_pcd(write(folder / "a.pcd", content))


def read_yaml(text: str) -> Read:
    return lambda folder: read_record(write(folder / "a.yaml", text))


def read_world(text: str) -> Read:
    def read(folder: Path) -> object:
        write(folder / "data_protocol.yaml", text)
        return read_protocol(folder)

    return read


POSES = "lidar_pose: [0, 0, 0, 0, 0, 0]\n"
VEHICLE = "{location: [0, 0, 0], center: [0, 0, 0], extent: [1, 1, 1], angle: [0, 0, 0]}"


def merge_bomb(levels: int) -> str:
    """Each level merges ten copies of the level below; keys stay few, the copied pairs grow tenfold."""
    lines = [f"a0: &a0 {{{', '.join(f'k{k}: 0' for k in range(10))}}}"]
    lines += [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, levels)]
    return "\n".join(lines) + "\n"


def alias_bomb(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines) + f"\nlidar_pose: *a{levels - 1}\nvehicles: {{}}\n"


def gzip_bomb(folder: Path) -> Path:
    """0.1 MB that unpack to 130 MB."""
    with gzip.open(folder / "bomb.xodr.gz", "wb", 9) as file:
        for _ in range(130):
            file.write(b" " * (1 << 20))
    return folder / "bomb.xodr.gz"


def zip_bomb(folder: Path) -> object:
    with (
        zipfile.ZipFile(folder / "towns.zip", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("Town01.xodr", "w", force_zip64=True) as file,
    ):
        for _ in range(130):
            file.write(b" " * (1 << 20))
    return load_town("Town01", folder / "towns.zip")


def sparse(name: str, size: int, read: Read) -> Read:
    """A file of so many bytes that takes no space on the disk."""

    def check(folder: Path) -> object:
        path = write(folder / name, b"x")
        os.truncate(path, size)
        return read(path)

    return check


def pipe(folder: Path) -> object:
    os.mkfifo(folder / "a.json")
    return load_json(folder / "a.json")


def weights(change: Callable[[dict], None] | None = None, text: str | None = None) -> Read:
    """Weights of the smallest detector with another configuration."""

    def read(folder: Path) -> object:
        config = json.loads(checkpoint.config_to_json(COSTR_TINY))
        if change is not None:
            change(config)
        metadata = {"format": checkpoint.FORMAT, "config": text or json.dumps(config), "card": "{}"}
        state = {
            k: v.contiguous()
            for k, v in Detector(COSTR_TINY).state_dict().items()
            if not k.endswith("num_batches_tracked")
        }
        save_file(state, folder / "a.safetensors", metadata)
        return checkpoint.load(folder / "a.safetensors")

    return read


def changed(*path_and_value: object) -> Read:
    *path, last, value = path_and_value

    def change(config: dict) -> None:
        for key in path:
            config = config[key]
        config[last] = value

    return weights(change)


def big_image(folder: Path) -> object:
    """A PNG of 30,000 x 30,000 pixels with its header alone."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return read_image(
        write(folder / "a.png", content + struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT")))
    )


def read_rotation(folder: Path) -> object:
    return read_calibration(write(folder / "a.json", f'{{"rotation": {"[" * 400}1{"]" * 400}, "translation": 1}}'))


DEEP = 100_000
# What is read, and what the error names beside the file.
CASES: dict[str, tuple[Read, str]] = {
    "road of 1e12 m": (read_road(opendrive(length="1e12", piece_length="1e12")), "length"),
    "road of -5 m": (read_road(opendrive(length="-5")), "length"),
    "geometry of -5 m": (read_road(opendrive(piece_length="-5")), "length"),
    "geometry of 1e300 m": (read_road(opendrive(piece_length="1e300")), "length"),
    "poly3 of 1e12 m": (read_road(opendrive("9", '<poly3 a="0" b="0" c="0" d="0"/>', "1e12")), "length"),
    "poly3 of 1e300": (read_road(opendrive("9", '<poly3 a="1e300" b="1e300" c="0" d="0"/>')), "1e+08 m"),
    "lane width of 1e300": (read_road(opendrive(width="1e300")), "1e+08 m"),
    "12 million points": (read_road(opendrive("1e5", "<line/>", "1e5", lanes=120)), "10,000,000 points"),
    "road without numbers": (read_road(opendrive(length="nan")), "length"),
    "xml entities": (
        read_road('<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
            f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(9)) + "]><OpenDRIVE>&j;</OpenDRIVE>"),
        "xml",
    ),
    "xml in an unknown encoding": (read_road('<?xml version="1.0" encoding="nonsense"?><OpenDRIVE/>'), "xml"),
    "gzip bomb": (lambda folder: read_opendrive(gzip_bomb(folder)), f"{MAX_TEXT_BYTES:,}"),
    "damaged gzip": (lambda folder: read_opendrive(write(folder / "a.gz", b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + b"abc" * 99)), "gzip"),
    "zip bomb": (zip_bomb, f"{MAX_TEXT_BYTES:,}"),
    "sparse xml": (sparse("a.osm", 1 << 40, read_lanelet2), f"{MAX_TEXT_BYTES:,}"),
    "sparse yaml": (sparse("a.yaml", 1 << 40, read_record), "maximum"),
    "sparse pcd": (sparse("a.pcd", 1 << 40, read_pcd), "maximum"),
    "sparse json": (sparse("a.json", 1 << 40, load_json), "maximum"),
    "pipe": (pipe, "regular file"),
    "pcd with COUNT 1e9": (read_cloud(pcd(count="1000000000 1 1")), "count"),
    "pcd with COUNT -1": (read_cloud(pcd(count="-1 1 1")), "count"),
    "pcd with COUNT 0": (read_cloud(pcd(count="0 1 1")), "count"),
    "pcd with 1e15 points": (read_cloud(pcd(points=10**15)), "points"),
    "compressed pcd of 4 GB": (
        read_cloud(pcd("1 1 1", 357_000_000, "binary_compressed", struct.pack("<III", 4, 12 * 357_000_000, 0))),
        "points",
    ),
    "ascii pcd with 1e12 fields": (read_cloud(pcd(count="1 1 1000000000000", data="ascii", body=b"0 0 0\n")), "count"),
    "lidar_pose: abc": (read_yaml("lidar_pose: abc\nvehicles: 5\n"), "vehicles"),
    "vehicles: 5": (read_yaml(f"{POSES}vehicles: 5\n"), "vehicles"),
    "vehicles: [1]": (read_yaml(f"{POSES}vehicles: [1]\n"), "vehicles"),
    "vehicle id of 1e400": (read_yaml(f"{POSES}vehicles: {{.inf: {VEHICLE}}}\n"), "id"),
    "vehicle id of 10**30": (read_yaml(f"{POSES}vehicles: {{{10**30}: {VEHICLE}}}\n"), "id"),
    "pose of 10**400": (read_yaml(f"lidar_pose: [0, 0, 0, 0, 0, 1{'0' * 400}]\nvehicles: {{}}\n"), "lidar_pose"),
    "world: [1]": (read_world("world: [1]\n"), "world"),
    "period of 1e300 s": (read_world("world: {fixed_delta_seconds: 1.0e+300}\n"), "fixed_delta_seconds"),
    "history of 1e30 frames": (read_world(f"history_frames: {10**30}\n"), "history_frames"),
    "yaml with 10**20 aliases": (read_yaml(alias_bomb(20)), "lidar_pose"),
    "yaml with 10**9 merged entries": (read_yaml(merge_bomb(9) + f"{POSES}vehicles: {{}}\n"), "merges"),
    "yaml with 10**10 merged entries": (
        read_yaml(f"a: &a {{{', '.join(f'k{k}: 0' for k in range(9000))}}}\nb: {{<<: [{', '.join(['*a'] * 9000)}]}}\n"), "merges",
    ),
    "nested yaml": (lambda folder: load_yaml(write(folder / "a.yaml", "[" * 10_000)), "yaml"),
    "yaml of a python object": (read_yaml("a: !!python/object/apply:os.getcwd []"), "yaml"),
    "nested json": (lambda folder: load_json(write(folder / "a.json", "[" * DEEP + "]" * DEEP)), "nested"),
    "nested rotation": (
read_rotation, "rotation",
    ),
    "image of 9e8 pixels": (big_image, "pixels"),
    "expansion of -1": (changed("dast", "expansion", -1), "expansion"),
    "1e7 stages": (weights(lambda config: config.update(codebook={"stages": 10**7, "size": 256})), "stages"),
    "1e7 blocks": (changed("dast", "blocks", 10**7), "blocks"),
    "-1 heads": (changed("dast", "heads", -1), "heads"),
    "0 heads": (changed("dast", "heads", 0), "heads"),
    "5 heads": (changed("dast", "heads", 5), "configuration"),
    "pillar of 1e-6": (changed("grid", "pillar", 1e-6), "pillar"),
    "pillar of nan": (changed("grid", "pillar", float("nan")), "pillar"),
    "pillar as text": (changed("grid", "pillar", "0.4"), "pillar"),
    "65,536 channels": (changed("head_channels", 65_536), "head"),
    "2,048 channels": (changed("head_channels", 2048), "larger model"),
    "64 blocks of attention": (changed("dast", "blocks", 64), "larger model"),
    "10**30 channels": (changed("head_channels", 10**30), "head_channels"),
    "layers as text": (changed("encoder", "layers", "222222"), "layers"),
    "a million layers": (changed("encoder", "layers", [10**6] * 6), "layers"),
    "a list of 1e5 layers": (changed("encoder", "layers", [1] * 10**5), "layers"),
    "nested configuration": (weights(text="[" * DEEP), "configuration"),
    "sweeps of 3": (changed("sweeps", 3), "sweeps"),
}  # fmt: skip


def check(name: str, folder: Path) -> None:
    read, expected = CASES[name]
    try:
        read(folder)
    except ManyeyesError as error:
        text = " ".join(str(error).split())
        assert len(text) < 1500 and expected in text.lower(), text
    else:
        raise AssertionError(f"{name} is accepted")


@pytest.mark.parametrize("name", CASES)
def test_a_bad_file_is_a_designed_error(name: str, tmp_path: Path) -> None:
    check(name, tmp_path)


@pytest.mark.slow
def test_bad_files_take_little_memory(tmp_path: Path) -> None:
    """All cases once more in a process that cannot take more than 768 MB above what its imports take."""
    command = [sys.executable, __file__, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_an_honest_file_is_read(tmp_path: Path) -> None:
    network = read_opendrive(gzip.compress(opendrive().encode()))
    assert len(network.lanes) == 1
    assert read_file(write(tmp_path / "a", "abc"), 3) == b"abc"
    assert read_record(
        write(tmp_path / "a.yaml", f"{POSES}vehicles: {{7: &v {VEHICLE}, 8: {{<<: *v}}}}\n")
    ).id.tolist() == [7, 8]
    assert isinstance(weights()(tmp_path), Detector)


def main(folder: Path) -> None:
    import resource

    torch.set_num_threads(1)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + MAX_GROWTH_BYTES, size + MAX_GROWTH_BYTES))
    for number, name in enumerate(CASES):
        (folder / str(number)).mkdir()
        check(name, folder / str(number))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
