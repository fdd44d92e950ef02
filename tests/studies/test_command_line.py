# SPDX-License-Identifier: Apache-2.0
"""A command that is written for options parses to the same options."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from manyeyes.cli.arguments import parse_options
from manyeyes.studies.catalog import STUDIES, load_options
from manyeyes.studies.command_line import format_command
from manyeyes.studies.options import MainTableOptions
from manyeyes.studies.pose_error_options import PoseErrorOptions
from manyeyes.studies.replay_options import FileChecks, ReplayOptions

CHANGED = MainTableOptions(
    data=Path("my data"),
    split="val",
    frame_stride=2,
    checks=FileChecks(allow_missing=True),
    replay_options=ReplayOptions(methods=("late", "early"), budget_bytes=1398, request_maps=True, sight=True),
    pose_errors=PoseErrorOptions(noise_in_time="constant", odometry_drift=False),
    channels=("ideal",),
    perturbations=("clean", "30 % loss"),
    rows=("late",),
)


def parse(command: str) -> MainTableOptions:
    words = shlex.split(command)
    assert words[:3] == ["manyeyes", "study", "main-table"]
    return parse_options(MainTableOptions, "test", None, words[3:])


@pytest.mark.parametrize("options", [CHANGED, MainTableOptions(data=Path("d"))], ids=["changed", "defaults"])
def test_the_written_command_parses_to_the_options(options: MainTableOptions) -> None:
    assert parse(format_command("study main-table", options)) == options


def test_defaults_and_what_no_result_depends_on_are_left_out() -> None:
    options = MainTableOptions(data=Path("d"), out=Path("elsewhere"), workers=7)
    assert format_command("study main-table", options) == "manyeyes study main-table --data d"


def test_every_study_option_is_written() -> None:
    """Tuples of pairs or other types would be written wrongly; there are none."""
    for name in STUDIES:
        options = load_options(name)
        required = {"data": Path("d")} if "data" in options.__dataclass_fields__ else {}
        assert format_command(f"study {name}", options(**required)).startswith(f"manyeyes study {name}")
