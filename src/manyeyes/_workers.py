# SPDX-License-Identifier: Apache-2.0
"""What a worker process does first: one thread of computation, and an end with the process that started it."""

from __future__ import annotations

import multiprocessing
import os
from threading import Thread

import torch


def start_worker() -> None:
    """Compute with one thread, and end when the parent process does, however that ends."""
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the one that started it was killed: it must not write to a folder that another run may continue."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
