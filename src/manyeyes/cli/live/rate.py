# SPDX-License-Identifier: Apache-2.0
"""Rate of the clock of a team on one machine: real time where its processes fit on the cores, else slow motion with a margin."""

from __future__ import annotations

from collections.abc import Sequence

FRAME_S = 0.1
"""Time from one frame to the next."""
BUSY_FRACTION = 0.4
"""Fraction of the cores that are left by other programs, which the processes may need."""
MAX_FRAME_FRACTION = 0.5
"""Fraction of the time of a frame that one agent may need for its own, while the others compute too."""


def choose_rate(frame_cpu_s: Sequence[float], num_cores: int, other_load: float = 0.0) -> float:
    """Return the rate of the clock, at most 1.

    frame_cpu_s: CPU time of a frame, of each process. other_load: number of other programs that compute, as of the system's load
    average.
    """
    load = len(frame_cpu_s) + other_load
    slowdown = max(1.0, load / num_cores)
    own_cores = num_cores * min(1.0, len(frame_cpu_s) / load) if load > num_cores else num_cores - other_load
    by_cores = BUSY_FRACTION * own_cores * FRAME_S / sum(frame_cpu_s)
    by_frame = MAX_FRAME_FRACTION * FRAME_S / (max(frame_cpu_s) * slowdown)
    return min(1.0, by_cores, by_frame)
