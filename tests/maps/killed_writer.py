# SPDX-License-Identifier: Apache-2.0
"""A program that is killed while it writes to a store, at one place after the other; test_store.py runs it and reads its report.

Each writer is a fork that appends a second batch and publishes a second release. The k-th writer kills itself (SIGKILL) at its
k-th file operation; others are killed by their parent after a time. After each: what a reader sees, then whether a new writer
can go on.
"""

import json
import os
import shutil
import signal
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.store.store import MapStore, compute_watermark

FRAME = MapFrame(48.0, 11.0)
_AUDITED_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "sqlite3.connect", "shutil.rmtree")


def batch(number: int) -> list[Observation]:
    """Forty observations of one line; their tiles differ."""
    line = np.array([[0.0, 0.0], [20.0, float(number)]])
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    elements = MapElements.of([line], DIVIDER)
    return [
        Observation(
            f"a{k}", "p", 1000 * number + k, np.array([40.0 * k, 0.0, 0.0]), np.diag((0.5, 0.5, 0.001)), view, elements
        )
        for k in range(40)
    ]


def fused(number: int) -> VectorMap:
    """A map of five lines, of which the last two change with the number."""
    lines = [np.array([[0.0, 100.0 * k], [30.0, 100.0 * k + (number if k > 2 else 0)]]) for k in range(5)]
    return VectorMap.of(MapElements.of(lines, DIVIDER), FRAME)


def write(folder: Path, number: int) -> None:
    """Append a batch, publish a release."""
    store = MapStore.create(folder, FRAME)
    with store.open_for_writing() as log:
        log.append(batch(number))
        standing = log.active_observations()
    if len(store.releases()) < number:
        store.publish(fused(number), "test", "", compute_watermark(standing.ids, standing.time_ns))


def in_fork(work, kill_after_s: float | None = None) -> tuple[str, bool]:
    """What work returns, run in a fork; and whether it was killed."""
    read, wrote = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        try:
            answer = str(work())
        except BaseException as error:
            answer = f"{type(error).__name__}: {error}"
        os.write(wrote, answer.encode()[:4000])
        os._exit(0)
    os.close(wrote)
    if kill_after_s is not None:
        time.sleep(kill_after_s)
        os.kill(child, signal.SIGKILL)
    with os.fdopen(read) as pipe:
        answer = pipe.read()
    _, status = os.waitpid(child, 0)
    return answer, os.WIFSIGNALED(status)


def dying_write(folder: Path, at: int) -> None:
    """Write the second batch and release, and die at the ``at``-th operation on a file or folder of the store."""
    count = 0

    def audit(event: str, about: tuple) -> None:
        nonlocal count
        if event in _AUDITED_EVENTS and str(about[0]).startswith(str(folder)):
            count += 1
            if count == at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(audit)
    write(folder, 2)


def read_report(folder: Path) -> dict:
    """What a reader sees, without a lock; then what a new writer finds."""
    store = MapStore(folder)
    release = store.manifest().number
    content = store.read().quantised_hash()
    with store.open_for_writing() as log:
        ids = set(log.active_observations().ids)
    first, second = ({o.id for o in batch(k)} for k in (1, 2))
    return {
        "release": release,
        "whole": content == fused(release).quantised_hash(),
        "first": first <= ids,
        "second": len(second & ids),
    }


def finished(folder: Path) -> dict:
    """What stands when the writer runs once more and is let live."""
    write(folder, 2)
    store = MapStore(folder)
    store.collect_garbage()
    files = sorted(str(p.relative_to(folder)) for p in (folder / "tiles").rglob("*.parquet"))
    unfinished = [str(p) for p in folder.rglob("*unfinished*")]
    log = sorted(p.name for p in (folder / "log").iterdir())
    return {"release": store.manifest().number, "map": store.read().quantised_hash(), "files": files, "log": log,
            "unfinished": unfinished}  # fmt: skip


def main(folder: Path, step: int, timed: int) -> None:
    """Kill at every ``step``-th operation until a writer lives to its end, then ``timed`` writers at times between."""
    origin = folder / "origin"
    # What every fork would load again.
    batch(1)
    fused(1)
    import_module("pyarrow.parquet")
    import_module("pyarrow.compute")
    start = time.perf_counter()
    in_fork(lambda: write(origin, 1))
    reference = folder / "reference"
    shutil.copytree(origin, reference)
    begin = time.perf_counter()
    want, _ = in_fork(lambda: json.dumps(finished(reference)))
    whole_s = time.perf_counter() - begin
    report = {"want": json.loads(want), "start_s": begin - start, "cases": []}
    at, alive = 1, False
    plans: list[float] = [whole_s * (k + 0.5) / max(timed, 1) for k in range(timed)]
    while not alive or plans:
        case = folder / f"case{len(report['cases'])}"
        shutil.copytree(origin, case)
        if not alive:
            place = at
            _, killed = in_fork(lambda case=case, place=place: dying_write(case, place))
            alive = not killed
            at += step
            name = f"operation {place}"
        else:
            pause = plans.pop(0)
            _, killed = in_fork(lambda case=case: write(case, 2), pause)
            name = f"{pause:.3f} s"
        after, _ = in_fork(lambda case=case: json.dumps(read_report(case)))
        end, _ = in_fork(lambda case=case: json.dumps(finished(case)))
        report["cases"].append({"name": name, "killed": killed, "seen": after, "end": end})
        shutil.rmtree(case)
    print(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
