# SPDX-License-Identifier: Apache-2.0
"""Weights that ship with the package, by name; anything else is a path."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path

from torch import Tensor

from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.fold_norms import folded
from manyeyes.models.maps.map_model import Mapper, MapperConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.models.pose import feakm

DEFAULT = "costr-small"
FEAKM = "feakm"
"""The shipped net that recognises objects; no detector, so that it is not among the names."""
MAPPER = "map-small"
"""The map model of agents with LiDAR; those with cameras are map-small-camera and map-small-both."""
_MAPPERS = "map-"


def names() -> tuple[str, ...]:
    """The shipped detectors."""
    return tuple(name for name in _shipped() if name != FEAKM and not name.startswith(_MAPPERS))


def mappers() -> tuple[str, ...]:
    """The shipped map models."""
    return tuple(name for name in _shipped() if name.startswith(_MAPPERS))


def _shipped() -> tuple[str, ...]:
    folder = files("manyeyes.models") / "weights"
    found = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(Path(f.name).stem for f in found if f.name.endswith(".safetensors")))


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


def load_mapper(name_or_path: str | Path = MAPPER) -> Mapper:
    """A map model for inference: a shipped name, or a .safetensors file of 'manyeyes train --preset map-small'."""
    with _mapper_file(name_or_path) as path:
        mapper = checkpoint.load_as(path, FORMAT, MapperConfig, Mapper)
    mapper.fingerprint = checkpoint.fingerprint(mapper)
    return mapper


def mapper_towns(name_or_path: str | Path = MAPPER) -> tuple[str, ...]:
    """The towns whose maps taught a map model, as its card says."""
    with _mapper_file(name_or_path) as path:
        return tuple(checkpoint.read_card(path, FORMAT)["towns"])


def mapper_state(name_or_path: str | Path = MAPPER) -> dict[str, Tensor]:
    """The tensors of a map model by name, to begin a training from."""
    with _mapper_file(name_or_path) as path:
        return checkpoint.read_state(path, FORMAT)


@contextmanager
def _mapper_file(name_or_path: str | Path) -> Iterator[Path]:
    if str(name_or_path) in mappers():
        with as_file(files("manyeyes.models") / "weights" / f"{name_or_path}.safetensors") as path:
            yield path
        return
    path = Path(name_or_path)
    if path.suffix != ".safetensors":
        raise CheckpointError(
            f"No map weights are named {name_or_path!r}; shipped are {', '.join(mappers()) or 'none'}: train some "
            "(manyeyes train --preset map-small) and give the .safetensors file."
        )
    yield path
