# SPDX-License-Identifier: Apache-2.0
"""How a training run computes: its device by name, and the process group of several processes on such devices."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist

from manyeyes.datatypes import ConfigError

_FORMS = "auto, cpu, cuda or cuda:N"


@dataclass(frozen=True)
class Execution:
    """How a run computes and what it writes beside its log; its samples and their order do not depend on it.

    workers: processes that draw samples ahead. tensorboard: whether scalars and pictures for TensorBoard are written.
    """

    device: torch.device = torch.device("cpu")
    workers: int = 0
    tensorboard: bool = False


def resolve_device(name: str = "auto", local_rank: int | None = None) -> torch.device:
    """Return the device of a name: auto, cpu, cuda or cuda:N; auto is a GPU where torch finds one, and the CPU elsewhere.

    Args:
        name: of the device.
        local_rank: number of this process on its machine, which is its GPU where the name has no number; None for one process.

    Raises:
        ConfigError: the name is unknown, or torch does not find the GPU.
    """
    kind, colon, number = name.partition(":")
    is_known = name in ("auto", "cpu", "cuda") or (kind == "cuda" and number.isdecimal())
    if not is_known:
        raise ConfigError(f"--device is {_FORMS}; got {name!r}.")
    if kind == "cpu" or (kind == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        built = "for the CPU only" if torch.version.cuda is None else f"for CUDA {torch.version.cuda}"
        raise ConfigError(
            f"--device {name}: torch {torch.__version__}, built {built}, finds no GPU; install a CUDA build of torch "
            "(https://pytorch.org) and a driver, or give --device cpu."
        )
    if colon and local_rank is not None:
        raise ConfigError(f"--device {name}: each of several processes has a GPU of its own; give --device cuda.")
    index, found = int(number) if colon else (local_rank or 0), torch.cuda.device_count()
    if index >= found:
        raise ConfigError(
            f"--device {name}: torch finds {found} GPUs, and none is number {index}; start fewer processes, or give "
            "another device."
        )
    return torch.device("cuda", index)


@contextmanager
def open_device(name: str = "auto") -> Iterator[torch.device]:
    """Yield the device of this process, with the process group where torchrun started several: nccl on GPUs, gloo on the CPU."""
    is_distributed = int(os.environ.get("WORLD_SIZE", "1")) > 1
    device = resolve_device(name, int(os.environ.get("LOCAL_RANK", "0")) if is_distributed else None)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if is_distributed:
        # Between stages of a plan the others wait for the first, which fits the codebook and calibrates.
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=timedelta(hours=12))
    try:
        yield device
    finally:
        if is_distributed:
            dist.destroy_process_group()
