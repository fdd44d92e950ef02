# SPDX-License-Identifier: Apache-2.0
"""The page on message validation lists every reason, and the bounds that the code has."""

from dataclasses import fields
from pathlib import Path
from typing import get_args

from manyeyes.agents.isolation import FIRST_QUARANTINE_NS, MAX_QUARANTINE_NS
from manyeyes.agents.own_detections import DISPLACED_SCORE_FACTOR, MIN_RESTORED_SCORE, SAME_OBJECT_DISTANCE_M
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.inbox import RejectionReason
from manyeyes.comms.token_format import MAX_TOKEN_VALUE

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "concepts" / "messages.md").read_text(encoding="utf-8")


def test_every_reason_is_in_the_table() -> None:
    assert [f.name for f in fields(DropCounts) if f"`{f.name}`" not in TEXT] == []


def test_every_reason_of_a_rejected_sender_is_in_the_table() -> None:
    reasons = [reason for part in get_args(RejectionReason) for reason in (get_args(part) or (part,))]
    assert len(reasons) == 12 and [reason for reason in reasons if f"`{reason}`" not in TEXT] == []


def test_the_bounds_are_those_of_the_code() -> None:
    assert f"at most ±{MAX_TOKEN_VALUE:g}" in TEXT
    assert f"best {LateFusion().max_boxes} of a message" in TEXT and f"within {SAME_OBJECT_DISTANCE_M:g} m" in TEXT
    assert DISPLACED_SCORE_FACTOR == 0.5 and "half its score" in TEXT
    assert f"each box of score {MIN_RESTORED_SCORE:g} or more" in TEXT
    assert f"for {FIRST_QUARANTINE_NS / 1e9:g} s" in TEXT and f"up to {MAX_QUARANTINE_NS / 1e9:g} s" in TEXT
