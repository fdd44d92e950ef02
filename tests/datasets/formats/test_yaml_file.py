# SPDX-License-Identifier: Apache-2.0
"""Yaml with numpy's tags: values as numpy wrote them, nothing else constructed, every size bounded."""

from __future__ import annotations

import base64
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from manyeyes.datasets.formats.yaml_file import load_yaml
from manyeyes.datasets.opv2v.metadata import read_record
from manyeyes.datatypes import RecordingError


def load(tmp_path: Path, text: str) -> object:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    return load_yaml(path)["a"]  # type: ignore[index]


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
@pytest.mark.parametrize(
    "value",
    [
        np.arange(16.0).reshape(4, 4) / 7,
        np.arange(6, dtype=np.float32) * 1.25,
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(4, dtype=">i4"),
        np.float64(-3.25),
        np.float32(0.5),
        np.int64(-(2**40)),
        np.bool_(True),
        (1.5, (2, 3)),
    ],
    ids=lambda value: f"{type(value).__name__} {getattr(value, 'shape', '')} {getattr(value, 'dtype', '')}",
)
def test_values_read_back_as_numpy_wrote_them(tmp_path: Path, core: str, value: object) -> None:
    found = load(tmp_path, yaml.dump({"a": value}).replace("numpy._core", core))
    expected = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else [1.5, [2, 3]]
    assert found == expected


def array(shape: str, data: bytes = bytes(8), dtype: str = "f8") -> str:
    return (
        "a: !!python/object/apply:numpy.core.multiarray._reconstruct\n"
        "  args: [!!python/name:numpy.ndarray '', !!python/tuple [0], !!binary Yg==]\n"
        f"  state: !!python/tuple [1, !!python/tuple [{shape}], !!python/object/apply:numpy.dtype {{args: [{dtype}, false, true], "
        "state: !!python/tuple [3, <, null, null, null, -1, -1, 0]}, false, "
        f"!!binary {base64.b64encode(data).decode()}]\n"
    )


def test_the_hand_written_array_is_sound(tmp_path: Path) -> None:
    assert load(tmp_path, array("1")) == [0.0]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (array("1000000000000"), "shape"),
        (array("999999999"), "maximum"),
        (array("999999999, 0", b""), "maximum"),
        (array("4096, 4096, 4096, 0", b""), "maximum"),
        (array("1, 1, 1, 1, 1, 1"), "4 axes"),
        (array("-1"), "shape"),
        (array("2"), "8 bytes"),
        (array("1", dtype="O8"), "numpy type"),
        (array("1", dtype="V999999999"), "numpy type"),
        (array("1", dtype="U250000000"), "numpy type"),
        ("a: !!python/object/apply:os.system [echo]", "os.system"),
        ("a: !!python/object/new:os.system [echo]", "os.system"),
        ("a: !!python/name:os.system ''", "os.system"),
        ("a: !!python/module:os ''", "module:os"),
        (
            "a: !!python/object/apply:numpy.core.multiarray.scalar [!!python/object/apply:numpy.dtype [f8], !!binary AAAA]",
            "args",
        ),
        ("a: !!python/object/apply:numpy.core.multiarray._reconstruct {args: [], state: 5}", "5 entries"),
        ("a: !!python/object/apply:numpy.fromfile [/etc/passwd]", "numpy.fromfile"),
    ],
)
def test_what_is_no_bounded_number_is_refused_with_the_file_and_a_remedy(
    tmp_path: Path, text: str, reason: str
) -> None:
    with pytest.raises(RecordingError, match=reason) as caught:
        load(tmp_path, text)
    assert str(tmp_path / "a.yaml") in str(caught.value) and "\n" not in str(caught.value)
    assert "tolist" in str(caught.value) and "download" not in str(caught.value)


def bomb(levels: int, inner: str) -> str:
    lines = [f"a0: &a0 [{', '.join([inner] * 10)}]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines)


def many_arrays() -> str:
    """3,000 arrays that share the bytes of one, by an alias: 12 million numbers in a file of 0.5 MB."""
    data = base64.b64encode(bytes(8 * 4096)).decode()
    dtype = "!!python/object/apply:numpy.dtype {args: [f8, false, true], state: [3, <, 0, 0, 0, -1, -1, 0]}"
    one = (
        f"!!python/object/apply:numpy.core.multiarray._reconstruct {{args: [], state: [1, [4096], {dtype}, false, *d]}}"
    )
    return f"d: &d !!binary {data}\nlidar_pose:\n" + f"- {one}\n" * 3000


HOSTILE = {
    "aliases in a matrix": bomb(20, "1.0") + "\nlidar_pose: [*a19, *a19, *a19, *a19]\nvehicles: {}\n",
    "aliases in rows of four": bomb(20, "1.0")
    + "\nlidar_pose: [[*a19, *a19, *a19, *a19], [1, 2, 3, 4], [1, 2, 3, 4], [1, 2, 3, 4]]\n"
    "vehicles: {}\n",
    "aliases of tuples": bomb(20, "1.0").replace(": &", ": !!python/tuple &") + "\nlidar_pose: *a19\nvehicles: {}\n",
    "a long matrix": "r: &r [" + "1, " * 100_000 + "1]\nlidar_pose: [" + "*r, " * 100_000 + "*r]\nvehicles: {}\n",
    "many arrays": many_arrays() + "vehicles: {}\n",
    "aliases in a shape": bomb(20, "1") + "\n" + array("*a19, 1").replace("a:", "lidar_pose:") + "vehicles: {}\n",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_metadata_are_refused_within_a_second_and_half_a_gigabyte(tmp_path: Path, name: str) -> None:
    """In a process of its own, so that its memory can be bounded."""
    path = tmp_path / "0" / "000001.yaml"
    path.parent.mkdir()
    path.write_text(HOSTILE[name])
    code = (
        "import resource, sys, time\nfrom pathlib import Path\n"
        "from manyeyes.datasets.opv2v.metadata import read_record\nfrom manyeyes.datatypes import RecordingError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF)\n"
        "try:\n    read_record(Path(sys.argv[1]))\nexcept RecordingError as error:\n    print(str(error)[:300])\n"
        "after = resource.getrusage(resource.RUSAGE_SELF)\n"
        "print((after.ru_maxrss - before.ru_maxrss) // 1024, after.ru_utime - before.ru_utime)\n"
    )
    limit = 8 << 30
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    assert done.returncode == 0, done.stderr[-500:]
    *error, numbers = done.stdout.strip().splitlines()
    megabytes, seconds = map(float, numbers.split())
    assert error and "000001.yaml" in error[0]
    assert megabytes < 512 and seconds < 5


def test_a_record_with_numpy_numbers_is_read(tmp_path: Path) -> None:
    vehicle = {
        "location": np.array([1.0, 2.0, 3.0]), "center": [0, 0, np.float64(0.5)], "extent": (2.0, 1.0, 0.8), "angle": np.zeros(3)
    }  # fmt: skip
    (tmp_path / "a.yaml").write_text(yaml.dump({"lidar_pose": np.arange(6.0), "vehicles": {np.int64(5): vehicle}}))
    record = read_record(tmp_path / "a.yaml")
    assert (
        record.id.tolist() == [5]
        and record.location.tolist() == [[1, 2, 3]]
        and record.lidar_pose == (0, 1, 2, 3, 4, 5)
    )
