# SPDX-License-Identifier: Apache-2.0
"""Random numbers that are a pure function of a key: independent of call order, process, worker count and global state.

The key is any tuple of integers and strings, by convention (seed, purpose, scenario, frame, agent). It is written
without ambiguity (("a", "b") is not ("ab",), 1 is not "1"), hashed by BLAKE2b to 128 bits, and those are the key of the
counter-based generator Philox. A longer draw begins with the shorter draw of the same key.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError


def keyed_generator(*key: int | str) -> np.random.Generator:
    """Return a NumPy generator of its own for this key. Source: Salmon et al., SC 2011 (Philox)."""
    return np.random.Generator(_philox(key))


def keyed_torch_generator(*key: int | str) -> torch.Generator:
    """Return a torch generator on the CPU for this key, e.g. for initial weights or torch.randperm."""
    return torch.Generator().manual_seed(int.from_bytes(_digest(key)[:8], "little") >> 1)


def keyed_uniform(shape: tuple[int, ...], *key: int | str) -> Tensor:
    """Return uniform draws in the open interval (0, 1), of the shape, float64: 52 bits each, centred in their bin.

    Made from Philox's raw words, whose stream NumPy keeps across versions (it does not for its distributions).
    """
    words = _philox(key).random_raw(math.prod(shape)) if shape else np.array([_philox(key).random_raw()])
    return torch.from_numpy(((words >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52).reshape(shape)


def keyed_normal(shape: tuple[int, ...], *key: int | str) -> Tensor:
    """Return standard normal draws of the shape, float64: the inverse distribution function of :func:`keyed_uniform`."""
    return torch.special.ndtri(keyed_uniform(shape, *key))


def _philox(key: tuple[int | str, ...]) -> np.random.Philox:
    return np.random.Philox(key=int.from_bytes(_digest(key), "little"))


def _digest(key: tuple[int | str, ...]) -> bytes:
    """16 bytes of the key; each part is written as its kind, its length and its text."""
    digest = hashlib.blake2b(digest_size=16, person=b"manyeyes")
    for part in key:
        if not isinstance(part, int | np.integer | str):
            raise ConfigError(
                f"A random key is made of integers and strings; got {part!r} of type {type(part).__name__}."
            )
        text = (part if isinstance(part, str) else str(int(part))).encode()
        digest.update((b"s" if isinstance(part, str) else b"i") + len(text).to_bytes(8, "little") + text)
    return digest.digest()
