# SPDX-License-Identifier: Apache-2.0
"""Check the weights that ship with the package against their manifest: size, SHA-256, and fingerprint of the loaded model."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

from manyeyes.datatypes import CheckpointError, ManyeyesError
from manyeyes.models import checkpoint, pretrained

MANIFEST = "manifest.json"
"""Beside the weights: the list of their entries (ShippedWeights)."""


@dataclass(frozen=True)
class ShippedWeights:
    """A file of weights. fingerprint: checkpoint.fingerprint of the model as stored, in hexadecimal."""

    name: str
    bytes: int
    sha256: str
    fingerprint: str


@dataclass(frozen=True)
class WeightsStatus:
    """The state of weights: their fingerprint (empty where they do not load), and what is wrong with them, if anything."""

    name: str
    fingerprint: str
    problem: str = ""


def describe_weights(path: Path) -> ShippedWeights:
    """Compute the manifest's entry of a file of weights.

    Raises:
        CheckpointError: it is damaged, or of another type than its name stands for. OSError: it cannot be read.
    """
    content = path.read_bytes()
    return ShippedWeights(path.stem, len(content), hashlib.sha256(content).hexdigest(), _load_fingerprint(path))


def check_shipped_weights() -> tuple[WeightsStatus, ...]:
    """Check every file of weights of this installation against the manifest, by name."""
    with as_file(files("manyeyes.models") / "weights") as folder:
        return check_weights(folder)


def check_weights(folder: Path) -> tuple[WeightsStatus, ...]:
    """Check the files of weights of a folder against its manifest, by name; a file without an entry is a problem too."""
    expected = {entry.name: entry for entry in read_manifest(folder)}
    names = sorted({*expected, *(path.stem for path in folder.glob("*.safetensors"))})
    return tuple(_check(folder / f"{name}.safetensors", expected.get(name)) for name in names)


def read_manifest(folder: Path) -> tuple[ShippedWeights, ...]:
    """Read the manifest of a folder of weights.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    path = folder / MANIFEST
    try:
        return tuple(ShippedWeights(**entry) for entry in json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: expected a list of weights, found {error}; install manyeyes again.") from None


def _check(path: Path, expected: ShippedWeights | None) -> WeightsStatus:
    if expected is None:
        return WeightsStatus(path.stem, "", f"{path} is not in {MANIFEST}")
    try:
        size = path.stat().st_size
        if size != expected.bytes:
            return WeightsStatus(path.stem, "", f"{path} has {size:,} bytes instead of {expected.bytes:,}")
        found = describe_weights(path)
    except OSError as error:
        return WeightsStatus(path.stem, "", f"{path}: {error.strerror}")
    except ManyeyesError as error:
        return WeightsStatus(path.stem, "", str(error))
    if found.sha256 != expected.sha256:
        return WeightsStatus(path.stem, found.fingerprint, f"{path} is not the released file: its SHA-256 differs")
    differs = f"{path} loads with the fingerprint {found.fingerprint} instead of {expected.fingerprint}"
    return WeightsStatus(path.stem, found.fingerprint, "" if found == expected else differs)


def _load_fingerprint(path: Path) -> str:
    """Load weights as the type that their name stands for, and return their fingerprint in hexadecimal."""
    if path.stem in pretrained.list_map_models():
        return pretrained.load_map_model(path).fingerprint.hex()
    if path.stem == pretrained.DEFAULT_FEAKM:
        return checkpoint.fingerprint(pretrained.load_feakm(path)).hex()
    if path.stem == pretrained.DEFAULT_POSE_VERIFIER:
        return checkpoint.fingerprint(pretrained.load_pose_verifier(path)).hex()
    return checkpoint.load(path).fingerprint.hex()
