# SPDX-License-Identifier: Apache-2.0
"""An observation with which the fusion fails is found, goes to the quarantine, and the rest is fused to the map without it."""

import json
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes import MissingExtraError
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.fusion import fuse as fusion
from manyeyes.maps.isolation import isolate_failures
from manyeyes.maps.store import tiled_fusion
from manyeyes.maps.store.executors import ExecutorSession
from manyeyes.maps.store.store import MapStore
from manyeyes.studies.map_folder import read_vector_map

pytest.importorskip("pyarrow", reason="the map extra is not installed")
pytest.importorskip("shapely", reason="the map extra is not installed")

B = TypeVar("B")
R = TypeVar("R")
FRAME = MapFrame(48.137, 11.575)


def observation(k: int, agent: str) -> Observation:
    line = MapElements.of([np.array([[-20.0, 1.0], [20.0, 1.0]])], DIVIDER)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    return Observation(agent, "pass", k, np.array([100.0 + 9.0 * k, 0.0, 0.0]), np.diag((0.1, 0.1, 1e-4)), view, line)


HONEST = [observation(k, f"agent{k % 3}") for k in range(9)]
HOSTILE = [observation(20, "hostile-a"), observation(3, "hostile-b")]


@pytest.mark.parametrize("bad", [(), (0,), (12,), (3, 4, 9)])
def test_rows_that_fail_alone_are_found(bad) -> None:
    runs = []

    def run(rows: Sequence[int]) -> list[int]:
        runs.append(rows)
        if found := set(rows) & set(bad):
            raise MemoryError(f"row {min(found)}")
        return list(rows)

    result, failures = isolate_failures(run, 13)
    assert result == [row for row in range(13) if row not in bad] and tuple(f.row for f in failures) == bad
    assert all(f"MemoryError: row {f.row}" in f.reason and "\n" not in f.reason for f in failures)
    assert len(runs) <= 1 + 6 * len(bad)


def test_rows_that_fail_only_together_lose_the_later_one() -> None:
    def run(rows: Sequence[int]) -> int:
        if {2, 5} <= set(rows):
            raise ValueError("both")
        return len(rows)

    result, failures = isolate_failures(run, 8)
    assert result == 7 and [f.row for f in failures] == [5]


@pytest.mark.parametrize(
    "error", [MemoryError("large"), OSError(28, "full"), MissingExtraError("map", "x"), RuntimeError()]
)
def test_an_error_that_no_row_causes_is_raised(error) -> None:
    runs = []

    def run(rows: Sequence[int]) -> None:
        runs.append(rows)
        raise error

    with pytest.raises(type(error)):
        isolate_failures(run, 1000)
    assert len(runs) < 60


def failing(function: Callable, agents_of: Callable) -> Callable:
    """Wrap a step of the fusion so that it fails with hostile observations."""

    def step(*args, **kwargs):
        if any(agent.startswith("hostile") for agent in agents_of(*args)):
            raise np.linalg.LinAlgError("singular\nmatrix")
        return function(*args, **kwargs)

    return step


def write_folder(folder: Path, observations: Sequence[Observation]) -> Path:
    folder.mkdir()
    write_observations(folder / "a.parquet", observations, FRAME)
    return folder


def test_map_fuse_leaves_out_what_it_fails_with(tmp_path, monkeypatch, capsys) -> None:
    assert cli.main(["map", "fuse", str(write_folder(tmp_path / "honest", HONEST))]) == 0
    monkeypatch.setattr(fusion, "solve_poses", failing(fusion.solve_poses, lambda many, *_: [o.agent for o in many]))
    capsys.readouterr()
    assert cli.main(["map", "fuse", str(write_folder(tmp_path / "all", [*HOSTILE, *HONEST]))]) == 0
    output = [text for text in capsys.readouterr().out.splitlines() if text.startswith("rejected")]
    assert [o.id in text and "LinAlgError: singular matrix" in text for o, text in zip(HOSTILE, output)] == [True, True]
    held = json.loads((tmp_path / "all/map/fuse.json").read_text())["result"]
    assert (held["observations"], held["rejected"], len(held["quarantine"])) == (9, 2, 2)
    assert HOSTILE[0].id in held["quarantine"][0]["reason"]
    assert (
        read_vector_map(tmp_path / "all/map").quantised_hash()
        == read_vector_map(tmp_path / "honest/map").quantised_hash()
    )


class RemoteExecutor:
    """A stand-in for a cluster: functions, blocks and results pass through pickle."""

    @contextmanager
    def open(self) -> Iterator[ExecutorSession]:
        yield self

    def run(self, fn: Callable[[B], R], blocks: Sequence[B]) -> Iterator[tuple[int, R]]:
        for index, block in enumerate(blocks):
            remote_fn, remote_block = pickle.loads(pickle.dumps((fn, block)))
            yield index, pickle.loads(pickle.dumps(remote_fn(remote_block)))


def agents_of_arrays(arrays, *_) -> tuple[str, ...]:
    return arrays.agents


def agents_of_solutions(solutions, *_) -> list[str]:
    ids = {o.id: o.agent for o in (*HONEST, *HOSTILE)}
    return [ids[name] for solution in solutions for name in solution.ids]


def agents_of_stations(table, *_) -> list[str]:
    ids = {bytes.fromhex(o.id): o.agent for o in (*HONEST, *HOSTILE)}
    return [ids[row.tobytes()] for row in table.line_evidence.observations]


@pytest.mark.parametrize(
    ("step", "agents_of"),
    [
        ("search_coarse_poses", agents_of_arrays),
        ("run_step", agents_of_arrays),
        ("build_stations", agents_of_arrays),
        ("link_block", agents_of_stations),
        ("solve_domain", agents_of_solutions),
    ],
)
def test_a_store_quarantines_what_a_tile_fails_with(step, agents_of, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tiled_fusion, step, failing(getattr(tiled_fusion, step), agents_of))
    store = MapStore.create(tmp_path / "city", FRAME)
    with store.open_for_writing() as log:
        log.append([*HONEST, *HOSTILE])
    manifest = store.fuse(executor=RemoteExecutor())
    assert manifest.watermark.observations == 9 and len(store.log.rejected) == 2
    monkeypatch.undo()
    for path in (tmp_path / "city").glob("catalogue.sqlite*"):
        path.unlink()
    again = MapStore(tmp_path / "city")
    with again.open_for_writing() as log:
        assert set(log.active_observations().ids) == {o.id for o in HONEST}
        reasons = [reason for *_, reason in log.index.list_rejected()]
        assert len(reasons) == 2 and all(any(o.id in reason for reason in reasons) for o in HOSTILE)
        assert log.append(HOSTILE) == (0, 2)
        assert log.retract(log.find(agent="hostile-a"), "made up") == 1
    assert again.read().quantised_hash() == fusion.fuse(HONEST, frame=FRAME).quantised_hash()


def test_the_command_lists_the_quarantine_of_a_store(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(tiled_fusion, "run_step", failing(tiled_fusion.run_step, agents_of_arrays))
    folder, store = write_folder(tmp_path / "in", [*HONEST, *HOSTILE]), tmp_path / "city"
    assert cli.main(["map", "fuse", str(folder), "--store", str(store), "--executor", "inline"]) == 0
    output = capsys.readouterr().out
    assert output.count("rejected: ") == 2 and "release 1 after 11 new observations, 0 known, 2 rejected" in output
    held = json.loads((store / "fuse.json").read_text())["result"]
    assert (held["release"], held["observations"], held["rejected"], len(held["quarantine"])) == (1, 9, 2, 2)
