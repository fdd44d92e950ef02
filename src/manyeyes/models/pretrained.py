# SPDX-License-Identifier: Apache-2.0
"""Load the weights that ship with the package by name, other weights by path, and detectors of third parties by name."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

from torch import Tensor

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.datatypes.registry import Registry
from manyeyes.models import checkpoint
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.detector.protocols import BoxDetector, check_detector
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.models.pose import candidate_verifier, feakm
from manyeyes.models.token_peaks import read_token_peaks
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16

DEFAULT_DETECTOR = "costr-small"
DEFAULT_FEAKM = "feakm-small"
"""The shipped FeaKM network. It is not a detector, so list_detectors leaves it out."""
DEFAULT_POSE_VERIFIER = "pose-verifier-small"
"""The shipped verifier of candidate poses; no detector either."""
DEFAULT_MAP_MODEL = "map-small-lidar"
"""The map model for LiDAR; map-small-camera and map-small-fusion take images, or both."""
BFLOAT16_VARIABLE = "MANYEYES_BFLOAT16"
"""Environment variable that switches products of bfloat16 off, by 0."""
_MAP_PREFIX = "map-"

_DETECTORS: Registry[Callable[[], BoxDetector]] = Registry("detector", "manyeyes.detector")

register_detector = _DETECTORS.register
"""Return a decorator that registers a detector, a class or function without arguments, under a name."""


def list_detectors() -> tuple[str, ...]:
    """List the names of the shipped detectors, then of those of third parties (entry points of manyeyes.detector)."""
    return (*_shipped_detectors(), *_DETECTORS.names())


def list_map_models() -> tuple[str, ...]:
    """List the names of the shipped map models."""
    return tuple(name for name in _shipped() if name.startswith(_MAP_PREFIX))


def _shipped_detectors() -> tuple[str, ...]:
    others = (DEFAULT_FEAKM, DEFAULT_POSE_VERIFIER)
    return tuple(name for name in _shipped() if name not in others and not name.startswith(_MAP_PREFIX))


def _shipped() -> tuple[str, ...]:
    folder = files("manyeyes.models") / "weights"
    found = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(Path(f.name).stem for f in found if f.name.endswith(".safetensors")))


def load(name_or_path: str | Path = DEFAULT_DETECTOR, *, in_bfloat16: bool | None = None) -> BoxDetector:
    """Load a detector for inference; norms of shipped and trained weights are folded into the convolutions.

    To continue training, or to inspect the stored weights, use checkpoint.load. Fingerprint and messages do not depend on
    in_bfloat16: agents with and without it decode each other's tokens.

    Args:
        name_or_path: a shipped name, a registered name, or a .safetensors file written by 'manyeyes train'.
        in_bfloat16: encoder and attention multiply bfloat16 with float32 sums where the processor has such products
            (``fold_norms``). None: unless the environment variable MANYEYES_BFLOAT16 is 0.

    Raises:
        CheckpointError: there are no such weights. ConfigError: a registered detector lacks something, or the variable is
        neither 0 nor 1.
    """
    name, shipped = str(name_or_path), _shipped_detectors()
    if name in _DETECTORS and name not in shipped:
        detector = _DETECTORS.get(name)()
        check_detector(detector)
        return detector
    with _weights_file(name, list_detectors()) as path:
        return fold_norms(checkpoint.load(path), _is_bfloat16_wanted() if in_bfloat16 is None else in_bfloat16)


def product_type() -> Literal["bfloat16", "float32"]:
    """Return the type in which weights that are loaded here multiply by default; sums are float32 in both."""
    return "bfloat16" if HAS_BFLOAT16 and _is_bfloat16_wanted() else "float32"


def _is_bfloat16_wanted() -> bool:
    """Return whether weights may be multiplied in bfloat16 in this environment."""
    value = os.environ.get(BFLOAT16_VARIABLE, "1")
    if value not in ("0", "1"):
        raise ConfigError(
            f"{BFLOAT16_VARIABLE} is 0 (float32) or 1 (bfloat16 where the processor has it); got {value!r}."
        )
    return value == "1"


def load_feakm(name_or_path: str | Path = DEFAULT_FEAKM) -> feakm.FeakmNet:
    """Load FeaKM's network: the shipped one by name, or a .safetensors file of 'manyeyes train --preset feakm-small'."""
    with _weights_file(name_or_path, tuple(name for name in _shipped() if name == DEFAULT_FEAKM)) as path:
        return feakm.load(path)


def load_pose_verifier(name_or_path: str | Path = DEFAULT_POSE_VERIFIER) -> candidate_verifier.CandidateVerifier:
    """Load a verifier of candidate poses: the shipped one by name, or a .safetensors file of 'manyeyes train --preset
    pose-verifier-small'.
    """
    with _weights_file(name_or_path, tuple(name for name in _shipped() if name == DEFAULT_POSE_VERIFIER)) as path:
        return candidate_verifier.load(path)


def load_map_model(name_or_path: str | Path = DEFAULT_MAP_MODEL) -> MapModel:
    """Load a map model for inference: a shipped name, or a .safetensors file of 'manyeyes train --preset
    map-small-lidar'.
    """
    with _weights_file(name_or_path, list_map_models()) as path:
        model = checkpoint.load_as(path, FORMAT, MapModelConfig, MapModel)
        card = checkpoint.read_card(path, FORMAT)
        model.token_peaks = read_token_peaks(card, model.config.token_channels, path)
    model.fingerprint = checkpoint.fingerprint(model)
    return model


def read_training_towns(name_or_path: str | Path = DEFAULT_MAP_MODEL) -> tuple[str, ...]:
    """Read the names of the training towns of a map model from its card."""
    with _weights_file(name_or_path, list_map_models()) as path:
        return tuple(checkpoint.read_card(path, FORMAT)["towns"])


def read_training_seed(name_or_path: str | Path) -> int | None:
    """Read the seed of the training of detector weights; None where the card has none, and of registered detectors."""
    if str(name_or_path) in _DETECTORS.names():
        return None
    with open_detector_file(name_or_path) as path:
        seed = checkpoint.read_card(path).get("seed")
    return seed if isinstance(seed, int) else None


def load_map_model_state(name_or_path: str | Path = DEFAULT_MAP_MODEL) -> dict[str, Tensor]:
    """Read the tensors of a map model by name, to initialise training."""
    with _weights_file(name_or_path, list_map_models()) as path:
        return checkpoint.read_state(path, FORMAT)


@contextmanager
def open_detector_file(name_or_path: str | Path = DEFAULT_DETECTOR) -> Iterator[Path]:
    """Give the path of the file of a shipped detector by name, or of a .safetensors file, while the context lasts."""
    with _weights_file(name_or_path, _shipped_detectors()) as path:
        yield path


@contextmanager
def _weights_file(name_or_path: str | Path, names: tuple[str, ...]) -> Iterator[Path]:
    """Open the file of shipped weights of one of these names, or of a path."""
    name = str(name_or_path)
    if name in names:
        with as_file(files("manyeyes.models") / "weights" / f"{name}.safetensors") as path:
            yield path
    elif name.endswith(".safetensors"):
        yield Path(name)
    else:
        raise CheckpointError(
            f"No weights are named {name!r}; known are {', '.join(names) or 'none'}, or give a .safetensors file of "
            "'manyeyes train'."
        )
