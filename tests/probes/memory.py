# SPDX-License-Identifier: Apache-2.0
"""Memory of this process (Linux, glibc 2.33 or later)."""

from __future__ import annotations

import ctypes
import gc
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Sample:
    """Memory after a frame: resident, and in use by the C allocator (kB); tensors, and blocks that Python counts."""

    frame: int
    resident_kb: int
    in_use_kb: int
    tensors: int
    blocks: int


class _Mallinfo2(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in [
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        ]
    ]


def resident_kb(line: str = "VmRSS") -> int:
    """Return a line of the kernel's status of this process: VmRSS now, VmHWM at its peak."""
    found = re.search(rf"^{line}:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


def release_memory() -> None:
    """Collect garbage, and return free memory to the system."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


def sample_memory(frame: int) -> Sample:
    """Return the memory of this process now, after release_memory."""
    release_memory()
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = _Mallinfo2
    info = libc.mallinfo2()
    tensors = sum(type(item) is torch.Tensor for item in gc.get_objects())
    return Sample(frame, resident_kb(), (info.uordblks + info.hblkhd) // 1024, tensors, sys.getallocatedblocks())
