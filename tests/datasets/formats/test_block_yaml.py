# SPDX-License-Identifier: Apache-2.0
"""Plain block yaml by lines: equal to the complete loader wherever it gives a result, and None for everything unusual."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, strategies as st

from manyeyes.datasets.formats.block_yaml import parse_block_yaml
from manyeyes.datasets.formats.yaml_file import load_yaml
from manyeyes.datasets.opv2v.metadata import AgentRecord, write_record

AS_OPV2V = """\
RSU: false
camera0:
  cords:
  - 213.19
  - -5.5
  extrinsic:
  - - 1.0
    - -2.12e-07
  - - 0.5
    - 3
ego_speed: 0
lidar_pose:
- 1.5
- -2.0
plan_trajectory: []
vehicles:
  211:
    angle:
    - 0
    - -1.0e-05
    bp_id: vehicle.tesla.model3
    color: 72, 37, 37
    location: [1.0, -2, 3.5e+10]
  -7: {}
weather: ClearNoon
"""


def slow(text: str) -> Any:
    return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def test_a_file_as_opv2v_has_it_reads_as_the_complete_loader_reads_it() -> None:
    found = parse_block_yaml(AS_OPV2V.encode())
    assert found is not None and repr(found) == repr(slow(AS_OPV2V))
    assert found["camera0"]["extrinsic"] == [[1.0, -2.12e-07], [0.5, 3]]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "\n",
        "a:",
        "a:\nb: 1",
        "a: ",
        "a: null",
        "a: ~",
        "a: yes",
        "a: On",
        "no: 1",
        "a: TRUE",
        "a: 'text'",
        'a: "text"',
        "a: two words",
        "a: 1 # why",
        "# why\na: 1",
        "---\na: 1",
        "a: 1\n...",
        "a: 1\r\nb: 2\r\n",
        "a:\t1",
        "a:  1",
        "a: 1 ",
        "a : 1",
        "a: .inf",
        "a: .nan",
        "a: 1e5",
        "a: 012",
        "a: 0x10",
        "a: 1_000",
        "a: 12:30",
        "a: 2024-01-01",
        "a: 123456789012345678901",
        "a: &x 1",
        "a: &x [1]\nb: *x",
        "<<: 1",
        "a: !!python/object/apply:os.system [echo]",
        "a: !!float 1",
        "a: |\n  text",
        "a: {b: 1}",
        "a: [b]",
        "a: [1,2]",
        "a: [[1]]",
        "- 1\n- 2",
        "a: 1\n- 2",
        "a:\n- 1\n  - 2",
        "a:\n- b: 1",
        "a:\n-\n  - 1",
        "a:\n  b: 1\n c: 2",
        "a:\n  - 1\n  b: 2",
        "a:\n  b: 1\n  - 2",
        "a:\n- 1\nb: 2\n- 3",
        " a: 1",
        "a: 1\n  b: 2",
        "a:\n - 1\n- 2",
        "? a\n: 1",
        "a: \u00e4",
        "a: 1\n\nb: 2",
        "a: -\n",
        "? 1",
        "1.5: 2",
        "a: word:",
    ],
)  # fmt: skip
def test_what_is_unusual_or_wrong_is_left_to_the_complete_loader(text: str) -> None:
    assert parse_block_yaml(text.encode()) is None


def test_deep_nesting_is_left_to_the_complete_loader() -> None:
    deep = "".join(f"{'  ' * depth}a:\n" for depth in range(2000)) + "  " * 2000 + "b: 1"
    assert parse_block_yaml(deep.encode()) is None
    assert parse_block_yaml(("a:\n" + "- " * 2000 + "1").encode()) is None


@pytest.mark.parametrize(
    ("head", "repeated", "tail", "count"),
    [
        ("a: ", "9", "", 1_000_000),
        ("a: ", "9", ".5", 1_000_000),
        ("a: [", "1, ", "]", 300_000),
        ("a:\n", "- ", "", 300_000),
        ("", " ", "", 1_000_000),
        ("", "a", "", 1_000_000),
        ("a: ", "a", "!", 1_000_000),
        ("", "a: &x [1]\n", "", 50_000),
        ("", "a: 1, 2, ", "", 100_000),
    ],
)
def test_hostile_text_takes_time_in_proportion_to_its_length(head: str, repeated: str, tail: str, count: int) -> None:
    """Sixteen times the length takes sixteen times the time, where a quadratic parser would take 256 times."""

    def measure_seconds(count: int, times: int) -> float:
        text = (head + repeated * count + tail).encode()
        start = time.process_time()
        for _ in range(times):
            assert parse_block_yaml(text) is None
        return time.process_time() - start

    short_s = min(measure_seconds(count // 16, 16) for _ in range(2))
    long_s = min(measure_seconds(count, 1) for _ in range(2))
    assert long_s < 5.0 * short_s + 0.05


words = st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,12}", fullmatch=True) | st.sampled_from(["Yes", "null", "true", "off"])
numbers = st.floats(allow_nan=True, allow_infinity=True) | st.integers(-(10**20), 10**20)
scalars = numbers | st.booleans() | words | st.none() | st.text(max_size=4)
keys = st.integers(-1000, 10**6) | words | st.booleans()
trees = st.dictionaries(
    keys,
    st.recursive(
        scalars,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
        max_leaves=12,
    ),
    min_size=1,
    max_size=5,
)


@given(trees, st.sampled_from([False, None, True]))
def test_any_tree_that_is_read_reads_as_the_complete_loader_reads_it(tree: dict[Any, Any], flow: bool | None) -> None:
    text = yaml.dump(tree, default_flow_style=flow, allow_unicode=True)
    found = parse_block_yaml(text.encode())
    assert found is None or repr(found) == repr(slow(text))


plain_words = words.filter(lambda word: word.lower() not in ("yes", "no", "on", "off", "true", "false", "null"))
plain_scalars = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(10**17), 10**17) | plain_words
plain_trees = st.dictionaries(
    st.integers(0, 10**6) | st.from_regex(r"k[A-Za-z0-9_]{0,8}", fullmatch=True),
    st.recursive(
        plain_scalars | st.lists(st.lists(plain_scalars, min_size=1, max_size=3) | plain_scalars, max_size=4),
        lambda inner: st.dictionaries(st.integers(0, 99), inner, max_size=4),
        max_leaves=10,
    ),
    min_size=1,
    max_size=5,
)


@given(plain_trees)
def test_plain_trees_are_read_without_the_complete_loader(tree: dict[Any, Any]) -> None:
    text = yaml.dump(tree, default_flow_style=False)
    found = parse_block_yaml(text.encode())
    assert found is not None and repr(found) == repr(slow(text)) and found == tree


pieces = st.sampled_from(
    ["a", "b:", ": ", "- ", "-", " ", "  ", "\n", "\n  ", "\n- ", "1", "-2.5", "[", "]", ", ", "{}", "#", "&a", "*a", "'", "true"]
)  # fmt: skip


@given(st.lists(pieces, max_size=14).map("".join))
def test_any_text_that_is_read_reads_as_the_complete_loader_reads_it(text: str) -> None:
    found = parse_block_yaml(text.encode())
    if found is not None:
        assert repr(found) == repr(slow(text))


def test_what_the_writer_writes_is_read_without_the_complete_loader(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    record = AgentRecord(
        lidar_pose=tuple(rng.normal(size=6) * 1e-6),
        ego_pose=tuple(rng.normal(size=6) * 1e17),
        speed_kmh=0.0,
        is_infrastructure=True,
        id=np.array([3, 7]),
        label=np.array([0, 1]),
        **{name: rng.normal(size=(2, 3)) for name in ("location", "center", "extent", "angle")},
        speed=np.array([-1e-9, 30.0]),
        link=np.full(2, -1),
        has_matrix=False,
        has_links=False,
        has_named_types=False,
    )
    camera = {"cords": record.lidar_pose, "extrinsic": rng.normal(size=(4, 4)).tolist()}
    path = tmp_path / "000001.yaml"
    write_record(path, record, record.ego_pose, {"camera0": camera})
    found = parse_block_yaml(path.read_bytes())
    assert found is not None and repr(found) == repr(slow(path.read_text()))
    assert load_yaml(path) == found
