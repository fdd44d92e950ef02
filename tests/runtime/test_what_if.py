# SPDX-License-Identifier: Apache-2.0
"""Changes of a recorded run are read by name, and unknown ones list the known."""

from dataclasses import replace

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.runtime.recorder import RunConfig
from manyeyes.runtime.what_if import parse_changes

RUN = RunConfig("tiny", "", "intermediate", 4_096, "coalign", "require", {}, 1)


def test_settings_are_changed_and_others_stay() -> None:
    changes = [
        "security=off",
        "strategy=late",
        "budget-bytes=none",
        "pose-correction=none",
        "misbehaviour=ray-evidence",
    ]
    changed = replace(
        RUN, security="off", strategy="late", budget_bytes=None, pose_correction=None, misbehaviour="ray-evidence"
    )
    assert parse_changes(changes)(RUN) == changed and parse_changes([])(RUN) == RUN
    assert parse_changes(["budget_bytes=2000"])(RUN) == replace(RUN, budget_bytes=2_000)


@pytest.mark.parametrize(
    "change", ["security", "security=", "weights=other", "security=on", "budget-bytes=-5", "budget-bytes=x"]
)
def test_what_cannot_be_changed_is_refused_with_what_can(change: str) -> None:
    with pytest.raises(ConfigError, match=r"off\|warn\|require|BYTES"):
        parse_changes([change])
