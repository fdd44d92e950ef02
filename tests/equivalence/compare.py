# SPDX-License-Identifier: Apache-2.0
"""Run the probes of an older commit and of this checkout in turn, and compare what they computed bit for bit.

``python tests/equivalence/compare.py COMMIT [PROBE ...]``; exits with 1 and names what differs. COMMIT holds this folder too. The
older code runs in a worktree of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[2]
PROBE = Path("tests") / "equivalence" / "probe.py"
RENAMED = {
    "alone": "no-fusion",
    "none": "no-fusion",
    "intermediate": "intermediate-temporal",
    "late-remembering": "late-temporal",
    "learned": "intermediate-mi-temporal",
    "confidence": "intermediate-confidence-temporal",
    "random": "intermediate-random-temporal",
    "fused": "intermediate-multihop-temporal",
    "codes": "codebook",
    "vote": "voting",
    "given": "identity",
    "odist": "v2x-reg-odist",
    "oiou": "v2x-reg-oiou",
    "first": "offsets",
}
"""Parts of the keys of arrays, between slashes, in the older code and in this one."""


def run(code: Path, place: Path, name: str, probes: list[str]) -> dict[str, np.ndarray]:
    """The arrays that the probes of one checkout compute."""
    environment = {**os.environ, "PYTHONPATH": f"{code / 'src'}:{code}", "OMP_NUM_THREADS": "1"}
    maps = REPOSITORY.parent / "shared" / "data"
    environment.setdefault("MANYEYES_TOWNS", str(maps / "carla_opendrive"))
    environment.setdefault("MANYEYES_MAPS", str(maps))
    words = [sys.executable, str(code / PROBE), str(place / f"{name}.npz"), str(place / name), *probes]
    subprocess.run(words, check=True, env=environment, cwd=place)
    with np.load(place / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


def rename_keys(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of the older code under the keys of this one; a key that occurs twice is an error."""
    renamed = {"/".join(RENAMED.get(part, part) for part in key.split("/")): array for key, array in arrays.items()}
    assert len(renamed) == len(arrays), "two keys of the older code map to one"
    return renamed


def differences(old: dict[str, np.ndarray], new: dict[str, np.ndarray]) -> list[str]:
    """One line for each key that is missing, or whose array differs in shape, type or any bit."""
    lines = [f"{key}: only in the {'old' if key in old else 'new'} code" for key in sorted(old.keys() ^ new.keys())]
    for key in sorted(old.keys() & new.keys()):
        a, b = old[key], new[key]
        if a.dtype != b.dtype or a.shape != b.shape:
            lines.append(f"{key}: {a.dtype}{a.shape} became {b.dtype}{b.shape}")
        elif a.tobytes() != b.tobytes():
            lines.append(f"{key}: {int((a != b).sum())} of {a.size} values differ")
    return lines


def main() -> int:
    commit, *probes = sys.argv[1:]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        subprocess.run(["git", "worktree", "add", "--detach", str(place / "code"), commit], check=True, cwd=REPOSITORY)
        probe = place / "code" / PROBE
        # Targets left the package, and with them the thresholds beside them.
        probe.write_text(
            probe.read_text().replace('("_ms", "_s", "seconds")', '("_ms", "_s", "seconds", "iou", "bar")')
        )
        try:
            old = rename_keys(run(place / "code", place, "old", probes))
            new = run(REPOSITORY, place, "new", probes)
        finally:
            remove = ["git", "worktree", "remove", "--force", str(place / "code")]
            subprocess.run(remove, check=False, cwd=REPOSITORY)
    lines = differences(old, new)
    print("\n".join(lines) or f"{len(old)} arrays, all equal bit for bit")
    return int(bool(lines))


if __name__ == "__main__":
    raise SystemExit(main())
