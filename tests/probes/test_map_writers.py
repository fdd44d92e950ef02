# SPDX-License-Identifier: Apache-2.0
"""A writer of maps that is killed, or runs out of space, at any time leaves a complete map, and one more run finishes the work."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

SEED = 22


def test_a_killed_or_full_writer_leaves_a_complete_map_and_the_next_one_finishes(is_long: bool) -> None:
    num_kills, num_limits = (40, 20) if is_long else (1, 1)
    verbs = ("append", "fuse-store", "fuse-folder") if is_long else ("fuse-store", "fuse-folder")
    script = Path(__file__).with_name("map_writers.py")
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        command = [sys.executable, str(script), folder, str(num_kills), str(num_limits), str(SEED), *verbs]
        report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert report.pop("origin") == "0 0 "
    for verb, done in report.items():
        assert done["before"] != done["want"] and done["answer"] == "0 ", verb
        assert len(done["cases"]) == num_kills + num_limits
        for case in done["cases"]:
            seen, again, end, left = case["found"]
            # Between two renames a folder of a map holds none; a store always has its last release.
            complete = {done["before"], done["want"]} | ({"none"} if verb == "fuse-folder" else set())
            assert seen in complete and again == "0 " and end == done["want"] and left == [], (verb, case)
            lines = case["ended"].splitlines()
            if case["max_bytes"] is not None and case["ended"] != "0 ":
                assert len(lines) == 1 and lines[0].startswith("1 manyeyes: ") and "free " in lines[0], (verb, case)
    if is_long:
        killed = [case["killed"] for done in report.values() for case in done["cases"]]
        assert sum(killed) >= len(report) * num_kills // 2
