# SPDX-License-Identifier: Apache-2.0
"""Calibrated probability that a station exists, by its log-odds, the number of agents that detected it, and whether others saw it.

A station of a line exists if a true line of its kind lies within 0.5 m; a crossing, if it overlaps a true one with an intersection
over union of 0.5. Log-odds assume independent errors, but a line of one agent has the pose error of that agent; and a detection of
low score has the log-odds of a sure one that was missed once, but exists less often. The tables were measured on tuning places
alone (Town07 and the generated crossroads; 20, 60 and 200 observations; seeds that no study uses) and made monotone along rows and
columns by ``python benchmarks/existence_calibration.py``; a test compares them with its stored result.
"""

from __future__ import annotations

import numpy as np

Table = tuple[tuple[float, ...], ...]

LOG_ODDS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""Log-odds of the columns of the tables. Rows: one agent in one view, one agent, two agents, three or more."""
MIN_VIEWS = 1.5
"""Sum of visibilities below which a station was in one view."""
LINE_PROB: Table = (
    (0.05, 0.16, 0.58, 0.83, 0.83, 0.83, 0.83, 0.83),
    (0.54, 0.85, 0.86, 0.86, 0.95, 0.95, 0.95, 0.95),
    (0.54, 0.85, 0.91, 0.91, 0.95, 0.95, 0.98, 0.98),
    (0.89, 0.89, 0.91, 0.97, 0.99, 0.99, 0.99, 1.00),
)
CROSSING_PROB: Table = (
    (0.00, 0.75, 0.75, 0.86, 1.00, 1.00, 1.00, 1.00),
    (0.00, 0.75, 0.75, 0.86, 1.00, 1.00, 1.00, 1.00),
    (0.00, 0.75, 0.75, 0.86, 1.00, 1.00, 1.00, 1.00),
    (0.00, 0.75, 0.75, 0.86, 1.00, 1.00, 1.00, 1.00),
)


def find_log_odds(row: tuple[float, ...], min_prob: float) -> float:
    """Find the least log-odds at which a row of a table reaches a probability; infinity where it does not."""
    known = np.array(row)
    if min_prob > known[-1]:
        return float("inf")
    after = int(np.argmax(known >= min_prob))
    if after == 0:
        return LOG_ODDS[0]
    part = (min_prob - known[after - 1]) / (known[after] - known[after - 1])
    return float(LOG_ODDS[after - 1] + part * (LOG_ODDS[after] - LOG_ODDS[after - 1]))
