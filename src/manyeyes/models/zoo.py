# SPDX-License-Identifier: Apache-2.0
"""Weights that ship with the package, by name; anything else is a path."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint, feakm
from manyeyes.models.detector import Detector
from manyeyes.models.folded import folded

DEFAULT = "costr-small"
FEAKM = "feakm"
"""The shipped net that recognises objects; no detector, so that it is not among the names."""


def names() -> tuple[str, ...]:
    """The shipped detectors."""
    folder = files("manyeyes.models") / "weights"
    return (
        tuple(sorted({Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".safetensors")} - {FEAKM}))
        if folder.is_dir()
        else ()
    )


def load(name_or_path: str | Path = DEFAULT) -> Detector:
    """A detector for inference, norms folded in: a shipped name, or a .safetensors file of 'manyeyes train'.

    To train on from a file, or to look at its weights as they are, use checkpoint.load.
    """
    if str(name_or_path) in names():
        with as_file(files("manyeyes.models") / "weights" / f"{name_or_path}.safetensors") as path:
            return folded(checkpoint.load(path))
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        raise CheckpointError(
            f"No weights are named {name_or_path!r}; shipped are {', '.join(names()) or 'none'}, or give a .safetensors file."
        )
    return folded(checkpoint.load(path))


def load_feakm(name_or_path: str | Path = FEAKM) -> feakm.FeakmNet:
    """FeaKM's net: the shipped one by its name, or a .safetensors file of 'manyeyes train --preset feakm'."""
    if str(name_or_path) != FEAKM:
        return feakm.load(Path(name_or_path))
    shipped = files("manyeyes.models") / "weights" / f"{FEAKM}.safetensors"
    if not shipped.is_file():
        raise CheckpointError(
            "No weights of FeaKM are shipped; train them (manyeyes train --preset feakm) and give the .safetensors file."
        )
    with as_file(shipped) as path:
        return feakm.load(path)
