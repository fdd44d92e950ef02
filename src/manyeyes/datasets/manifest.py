# SPDX-License-Identifier: Apache-2.0
"""Digests that the simulator writes beside its files, and the manifest of all scenarios; both are checked by readers.

A finished scenario has ``scenario.json`` with its digests, in DAIR-V2X's layout ``batches/<number>.json``. The root of a
finished recording has ``manifest.json``; while a run is unfinished the root has ``manifest.partial.json``, and the scenario
that is being written is a folder with the suffix ``.partial``.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manyeyes._io import parse_json, read_file
from manyeyes.datasets.missing import FileProblem
from manyeyes.datatypes import RecordingError

MANIFEST = "manifest.json"
UNFINISHED_MANIFEST = "manifest.partial.json"
SCENARIO = "scenario.json"
BATCHES = "batches"
PARTIAL = ".partial"
# Of files that a reader takes; whatever else lies in a scenario's folder changes nothing.
_SUFFIXES = (".pcd", ".yaml", ".png")


@dataclass(frozen=True)
class Digests:
    """Digests of the files of one scenario.

    total: SHA-256 of the lines ``<SHA-256 of a file>  <path>`` in the order of paths. by_path: SHA-256 of each file by its
    path below the folder; None in recordings of versions that wrote the total only.
    """

    total: str
    num_files: int
    num_bytes: int
    by_path: Mapping[str, str] | None

    @classmethod
    def read(cls, path: Path) -> Digests | None:
        """Read scenario.json or a file of a batch; None where the file has no digests of the simulator."""
        try:
            content = parse_json(read_file(path))
            entry, by_path = content["entry"], content.get("files")
            if by_path is not None:
                by_path = {str(name): str(digest) for name, digest in by_path.items()}
            return cls(str(entry["sha256"]), int(entry["files"]), int(entry["bytes"]), by_path)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def check(
        self,
        folder: Path,
        scenario: str,
        present: Sequence[Path],
        noted_in: str = SCENARIO,
        used: Callable[[str], bool] = lambda name: True,
    ) -> list[FileProblem]:
        """Compare the files below the folder with the digests.

        Args:
            folder: to which paths are relative.
            scenario: name for the records.
            present: the scenario's files as they are now, in the order of paths. Those of a recording that have no digest
                are mismatched.
            noted_in: name of the file with the digests, for the texts.
            used: whether the file of a relative path is compared; a total is compared over all.

        Returns:
            One record a file; one of the folder where the digests are a total only.
        """
        if self.by_path is None:
            return self._check_total(folder, scenario, present, noted_in)
        found = []
        for name, digest in self.by_path.items():
            path = folder / name
            if not used(name):
                continue
            if not path.is_file():
                found.append(FileProblem(path, "missing", scenario, f"{noted_in} lists it"))
            elif sha256_of(path) != digest:
                found.append(FileProblem(path, "mismatched", scenario, f"its SHA-256 is not that in {noted_in}"))
        for path in present:
            name = path.relative_to(folder).as_posix()
            if name not in self.by_path and path.suffix in _SUFFIXES and used(name):
                found.append(FileProblem(path, "mismatched", scenario, f"{noted_in} does not list it"))
        return found

    def _check_total(self, folder: Path, scenario: str, present: Sequence[Path], noted_in: str) -> list[FileProblem]:
        num_bytes = sum(p.stat().st_size for p in present)
        if (len(present), num_bytes) != (self.num_files, self.num_bytes):
            reason = (
                f"{len(present)} files of {num_bytes} bytes; {noted_in} counts {self.num_files} of {self.num_bytes}"
            )
        elif compute_total_digest(digest_files(present, folder)) != self.total:
            reason = f"the SHA-256 of all files is not that in {noted_in}"
        else:
            return []
        return [FileProblem(folder, "mismatched", scenario, reason)]


def sha256_of(path: Path) -> str:
    """Return SHA-256 of a file's bytes, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def digest_files(files: Iterable[Path], folder: Path) -> dict[str, str]:
    """Return SHA-256 of each file by its path below the folder, in the given order."""
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in files}


def compute_total_digest(by_path: Mapping[str, str]) -> str:
    """Return SHA-256 of the lines ``<SHA-256 of a file>  <path>``."""
    lines = [f"{digest}  {name}" for name, digest in by_path.items()]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def list_scenario_files(folder: Path) -> list[Path]:
    """Return the files of a scenario's folder in the order of paths, without scenario.json and without hidden files."""
    found = (Path(base) / name for base, _, names in os.walk(folder, followlinks=True) for name in names)
    return sorted(path for path in found if path.name != SCENARIO and not path.name.startswith("."))


def read_manifest(root: Path) -> dict[str, Any] | None:
    """Return the content of the root's manifest, or of that of an unfinished run; None where there is neither.

    Raises:
        RecordingError: the file is not one of the simulator.
    """
    path = next((p for p in (root / MANIFEST, root / UNFINISHED_MANIFEST) if p.is_file()), None)
    if path is None:
        return None
    try:
        content = parse_json(read_file(path))
        assert isinstance(content["format"], str) and isinstance(content["settings"], dict)
        assert all(isinstance(entry["split"], str) and isinstance(entry["name"], str) for entry in content["scenarios"])
    except (OSError, ValueError, KeyError, TypeError, AssertionError):
        raise RecordingError(
            f"{path}: expected a manifest of 'manyeyes simulate', found something else; choose another folder."
        ) from None
    return content


def list_scenarios(root: Path, split: str) -> tuple[str, ...]:
    """Return names of the scenarios of a split by the root's manifest in OPV2V's layout; empty where there is none."""
    try:
        content = read_manifest(root)
    except RecordingError:
        return ()
    if content is None or content["format"] != "OPV2V":
        return ()
    return tuple(entry["name"] for entry in content["scenarios"] if entry["split"] == split)
