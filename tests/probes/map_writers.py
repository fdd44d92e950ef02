# SPDX-License-Identifier: Apache-2.0
"""Writers of maps that are killed, or run out of space, at random times; test_map_writers.py runs this and reads its report.

Every writer is a fork of a process that has no threads of Arrow. After each: what a reader finds, then what one more run leaves.
"""

import contextlib
import hashlib
import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np

from manyeyes.cli import main as cli
from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.store.store import MapStore
from manyeyes.studies.map_folder import read_vector_map

FRAME = MapFrame(48.0, 11.0)
IMPORTS = (
    *(
        "pyarrow.parquet",
        "pyarrow.compute",
        "shapely",
        "rich.console",
        "rich.progress",
        "tyro",
        "manyeyes.cli.arguments",
    ),
    *("manyeyes.cli.map.fuse", "manyeyes.studies.provenance", "manyeyes.studies.map_folder", "manyeyes.viz.progress"),
)


def observations(number: int) -> list[Observation]:
    """Twelve observations of a street with a crossing; another number, another pass."""
    lines = [np.array([[-20.0, y], [20.0, y]]) for y in (-3.5, 0.0, 3.5)]
    ring = np.array([[10.0, -4.0], [13.0, -4.0], [13.0, 4.0], [10.0, 4.0]])
    elements = MapElements.of([*lines, ring], [DIVIDER] * 3 + [CROSSING])
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    covariance = np.diag((0.1, 0.1, 1e-4))
    poses = [np.array([25.0 * k + number, 0.0, 0.0]) for k in range(12)]
    return [
        Observation(f"a{k % 4}", f"p{number}", 100 * number + k, pose, covariance, view, elements)
        for k, pose in enumerate(poses)
    ]


def run(*words: object) -> str:
    """Run a command; return its exit code and what it wrote to stderr."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        code = cli.main([str(word) for word in words])
    return f"{code} {errors.getvalue()}"


def append(case: Path) -> str:
    """Take a folder of observations into a store's log."""
    try:
        with MapStore(case / "city").open_for_writing() as log:
            log.ingest(case / "in")
    except OSError as error:
        return f"1 manyeyes: {error.filename}: {error.strerror}\n"
    return "0 "


def fuse_store(case: Path) -> str:
    """Take a folder of observations into a store, and publish a release."""
    return run("map", "fuse", case / "in", "--store", case / "city", "--executor", "inline")


def fuse_folder(case: Path) -> str:
    """Fuse a folder of observations to a map, in place of the one that was there."""
    return run("map", "fuse", case / "in", "--out", case / "map")


WRITERS: dict[str, Callable[[Path], str]] = {"append": append, "fuse-store": fuse_store, "fuse-folder": fuse_folder}


def state(case: Path, verb: str) -> str:
    """Hash what a reader finds, bit for bit; "none" where a reader gets a designed error."""
    if verb == "fuse-folder":
        files = [case / "map" / name for name in ("lines.parquet", "crossings.parquet")]
        try:
            read_vector_map(case / "map")
        except ManyeyesError:
            return "none"
        return hashlib.blake2b(b"".join(file.read_bytes() for file in files), digest_size=8).hexdigest()
    store = MapStore(case / "city")
    store.read()
    text = repr([tile.hashes for tile in store.manifest().tiles])
    if verb == "append":
        with store.open_for_writing() as log:
            text += repr(log.active_observations().ids)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def in_fork(
    work: Callable[[], str], kill_after_s: float | None = None, max_bytes: int | None = None
) -> tuple[str, bool]:
    """Return what work returns in a fork, and whether it was killed; max_bytes: of each file that it writes."""
    read, wrote = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        if max_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, resource.RLIM_INFINITY))
        try:
            answer = work()
        except BaseException as error:
            answer = f"traceback {type(error).__name__}: {error}"
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


def make_origin(folder: Path) -> str:
    """Make a store and a map of the first pass, and the folder with the second."""
    (folder / "in").mkdir(parents=True)
    write_observations(folder / "in/a.parquet", observations(1), FRAME)
    done = fuse_store(folder) + fuse_folder(folder)
    for number in (2, 3):
        write_observations(folder / f"in/{number}.parquet", observations(number), FRAME)
    return done


def main(folder: Path, num_kills: int, num_limits: int, seed: int, verbs: Sequence[str]) -> None:
    """Kill ``num_kills`` writers of each verb at random times; let ``num_limits`` of each run out of space."""
    draw = random.Random(seed)
    # What every fork would load again.
    fuse(observations(1))
    for name in IMPORTS:
        import_module(name)
    origin = folder / "origin"
    report: dict[str, object] = {"origin": in_fork(lambda: make_origin(origin))[0]}
    for verb, write in ((verb, WRITERS[verb]) for verb in verbs):

        def inspect(at: Path, verb: str = verb, write: Callable[[Path], str] = write) -> str:
            """Return what a reader finds, the answer of one more run, what a reader finds then, and unfinished files."""
            found = state(at, verb), write(at), state(at, verb)
            return json.dumps([*found, [path.name for path in at.rglob("*unfinished*")]])

        reference = shutil.copytree(origin, folder / "reference")
        start = time.perf_counter()
        before, answer, want, _ = json.loads(in_fork(partial(inspect, reference))[0])
        whole_s = time.perf_counter() - start
        shutil.rmtree(reference)
        plans = [(draw.random() * whole_s, None) for _ in range(num_kills)]
        plans += [(None, int(2 ** draw.uniform(5, 17))) for _ in range(num_limits)]
        cases = []
        for pause, max_bytes in plans:
            case = shutil.copytree(origin, folder / "case")
            ended, killed = in_fork(partial(write, case), pause, max_bytes)
            found = json.loads(in_fork(partial(inspect, case))[0])
            shutil.rmtree(case)
            cases.append({"pause_s": pause, "max_bytes": max_bytes, "killed": killed, "ended": ended, "found": found})
        report[verb] = {"before": before, "answer": answer, "want": want, "cases": cases}
    print(json.dumps(report))


if __name__ == "__main__":
    kills, limits, seed = (int(word) for word in sys.argv[2:5])
    main(Path(sys.argv[1]), kills, limits, seed, sys.argv[5:])
