# SPDX-License-Identifier: Apache-2.0
"""Words of messages."""

from __future__ import annotations


def count_noun(count: int, noun: str) -> str:
    """Return a count with its noun, which takes an s unless the count is one: "1 scenario", "1,200 scenarios"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
