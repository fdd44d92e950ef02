# SPDX-License-Identifier: Apache-2.0
"""What the columns of a report's tables mean, in the few words that stand below their headings."""

from __future__ import annotations

from manyeyes.viz.table import DATA_AGE, LOG2_BYTES

COLUMN_DESCRIPTIONS = {
    "AP@0.5": "average precision, a match at rotated IoU 0.5",
    "AP@0.7": "the same at IoU 0.7: tighter boxes",
    "bytes/message": "mean of an agent's message, all packets and headers",
    LOG2_BYTES: "base-2 logarithm of it",
    DATA_AGE: "mean from capture to fusion",
    "share [ms]": "mean compute of a sender's message",
    "perceive [ms]": "mean compute of the ego's boxes",
    "paired difference": "over the same scenarios",
    "ΔAP [95 % CI]": "with its confidence interval",
    "prior pose": "worst lasting state of the sent poses",
    "first frame": "of that state",
    "corrected": "messages with a replaced pose",
    "at prior pose": "messages used as sent",
    "excluded": "messages without a usable pose",
    "drift [m/s]": "of the sent poses",
    "boxes": "with a score of 0.05 and more",
    "expected calibration error": "mean distance from the diagonal",
    "sender": "with the most returns on the vehicle",
    "supplied": "vehicle and frame pairs missed alone, found with messages",
    "vehicles": "distinct ones among them",
    "sender's points": "median returns on the vehicle",
    "ego's points": "median returns on the vehicle",
    "map": "what is compared",
    "mAP": "average precision of lines at three distances, mean of crossings and dividers",
    "precision": "length of drawn dividers that lies on true ones",
    "F1": "harmonic mean of precision and recall of dividers",
    "duplication": "lines drawn for each true divider; 1 is right",
}
"""By heading."""
