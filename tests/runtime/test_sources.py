# SPDX-License-Identifier: Apache-2.0
"""Clock, sources of frames, and the overload ladder."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import replace

import pytest

from manyeyes.datatypes import ConfigError, RecordingError, Snapshot
from manyeyes.runtime.clock import LiveClock, read_tai_ns
from manyeyes.runtime.overload import MAX_LEVEL, TIMELY_DOWN, OverloadLadder
from manyeyes.runtime.sources import DeferredClock, NewestFrame, load_source, play_recording

START_NS = 1_800_000_000 * 10**9


class DriveRecording:
    """The drive of the tests as a recording; agent 1 is not there at index 1."""

    scenarios = ("drive",)

    def __init__(self, drive) -> None:
        self._drive = drive(2)

    def length(self, scenario: str) -> int:
        return 4

    def eval_indices(self, scenario: str) -> range:
        return range(4)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return 0, 1

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        frames = [self._drive.frame(agent, index) for agent in range(2) if (agent, index) != (1, 1)]
        return Snapshot(scenario, index, tuple(frames))


def test_a_recording_is_played_from_the_start_of_the_clock(drive) -> None:
    recording = DriveRecording(drive)
    played = [
        [(f.agent_id, f.timestamp_ns - START_NS) for f in play_recording(recording, "drive", agent, START_NS, 3)]
        for agent in (0, 1)
    ]
    assert played == [[(0, 0), (0, 10**8), (0, 2 * 10**8)], [(1, 0), (1, 2 * 10**8)]]
    with pytest.raises(RecordingError, match="no agent 7; it has 0, 1"):
        next(play_recording(recording, "drive", 7, START_NS))


def stamped(drive, stamps_ns):
    frame = drive(1).frame(0, 0)
    return [replace(frame, timestamp_ns=stamp) for stamp in stamps_ns]


def test_the_newest_frame_is_given_and_older_ones_are_skipped(drive) -> None:
    clock = LiveClock()
    frames = stamped(drive, [clock.start_ns + k for k in range(5)])
    source = NewestFrame(frames, clock)
    got = []
    for frame in source:
        got.append(frame.timestamp_ns - clock.start_ns)
        time.sleep(0.2)
    assert got[-1] == 4 and len(got) + source.num_skipped == 5 and got == sorted(got)


def test_frames_come_at_their_time_and_a_stop_ends_the_iteration(drive) -> None:
    clock = LiveClock()
    source = NewestFrame(stamped(drive, [clock.start_ns + 50_000_000, clock.start_ns + 10**13]), clock)
    began = threading.Event()
    threading.Timer(0.5, source.stop).start()
    for frame in source:
        began.set()
        assert clock.now_ns() >= frame.timestamp_ns
    assert began.is_set()


def test_an_error_of_the_source_is_raised(drive) -> None:
    def broken():
        yield from stamped(drive, [0])
        raise RecordingError("the disk is gone")

    source = NewestFrame(broken(), LiveClock())
    with pytest.raises(RecordingError, match="the disk is gone"):
        list(source)


def test_a_clock_advances_at_its_rate_from_its_start() -> None:
    now = read_tai_ns()
    slow, later = LiveClock(now, 0.01), LiveClock(now + 10**12)
    time.sleep(0.05)
    assert 0 <= slow.now_ns() - now < 50_000_000 and later.now_ns() < later.start_ns
    assert abs(later.now_ns() - read_tai_ns()) < 10**9


def test_the_ladder_rises_after_three_misses_of_ten_and_falls_after_thirty_timely_frames() -> None:
    ladder = OverloadLadder()
    assert [ladder.update(missed) for missed in (True, False, True, False, False, True)] == [0, 0, 0, 0, 0, 1]
    assert [ladder.update(True) for _ in range(12)][2::3] == [2, 3, 4, 4] and ladder.level == MAX_LEVEL
    assert [ladder.update(False) for _ in range(TIMELY_DOWN)][-2:] == [4, 3]
    rare = OverloadLadder()
    assert [rare.update(k % 5 == 0) for k in range(40)] == [0] * 40


def test_a_source_is_a_function_by_name_that_is_found_in_the_working_directory(tmp_path, monkeypatch) -> None:
    (tmp_path / "my_sensor_source.py").write_text("def frames(agent_id, now_ns):\n    yield agent_id, now_ns()\n")
    monkeypatch.chdir(tmp_path)
    deferred = DeferredClock(lambda: 5)
    opened = iter(load_source("my_sensor_source:frames")(3, deferred))
    deferred.now_ns = lambda: 7
    assert next(opened) == (3, 7)  # pyright: ignore[reportComparisonOverlap]
    assert "" not in sys.path[:1]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nothing", "module:function; got 'nothing'"),
        (":frames", "module:function; got ':frames'"),
        ("no_such_module_here:frames", "module no_such_module_here cannot be imported"),
        ("math:no_such_function", "module math has no function no_such_function"),
        ("math:pi", "module math has no function pi"),
    ],
)
def test_a_source_that_is_not_there_is_refused(name: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        load_source(name)
