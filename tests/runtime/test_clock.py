# SPDX-License-Identifier: Apache-2.0
"""The clock of a live run follows a system clock that drifts and steps; in slow motion it does not."""

from __future__ import annotations

import time

import pytest

from manyeyes.runtime.clock import MAX_SLEW, MIN_STEP_NS, TAI_UTC_NS, LiveClock, read_tai_ns, tai_from_utc_ns

S, MS = 10**9, 10**6


class Machine:
    """A machine's monotonic clock, and its system clock, which drifts (fraction) and steps."""

    def __init__(self, drift: float = 0.0) -> None:
        self.elapsed_ns, self.drift, self.step_ns, self.reading_ns = 0, drift, 0, 0

    def monotonic(self) -> int:
        self.elapsed_ns += self.reading_ns
        return 7 * S + self.elapsed_ns

    def system(self) -> int:
        return 1_800_000_000 * S + self.elapsed_ns + round(self.elapsed_ns * self.drift) + self.step_ns

    def clock(self, rate: float = 1.0, start_ns: int | None = None) -> LiveClock:
        return LiveClock(start_ns, rate, self.system, self.monotonic)

    def run(self, clock: LiveClock, seconds: float) -> list[int]:
        """Discipline ten times a second; return the steps."""
        steps = []
        for _ in range(round(10 * seconds)):
            before = clock.now_ns()
            self.elapsed_ns += S // 10
            assert clock.now_ns() > before
            steps.append(clock.discipline())
        return [step for step in steps if step]


@pytest.mark.parametrize("drift", [-100e-6, 40e-6, 300e-6])
def test_time_follows_a_clock_that_drifts_without_a_step(drift: float) -> None:
    machine = Machine(drift)
    clock = machine.clock()
    assert machine.run(clock, 60.0) == []
    assert abs(clock.now_ns() - machine.system()) < 1 * MS


def test_time_is_slewed_by_at_most_500_ppm() -> None:
    machine = Machine()
    clock = machine.clock()
    machine.step_ns = MIN_STEP_NS - MS
    clock.discipline()
    begin = clock.now_ns()
    machine.elapsed_ns += S
    assert clock.now_ns() - begin == S + round(MAX_SLEW * S)
    assert machine.run(clock, 60.0) == [] and abs(clock.now_ns() - machine.system()) < MS


@pytest.mark.parametrize("step_ns", [300 * MS, -300 * MS, 37 * S])
def test_a_step_of_the_system_clock_is_reported_once_and_followed_at_once(step_ns: int) -> None:
    machine = Machine()
    clock = machine.clock()
    machine.run(clock, 1.0)
    machine.step_ns = step_ns
    assert abs(clock.now_ns() - machine.system()) == abs(step_ns)
    assert abs(clock.discipline() - step_ns) < MS and clock.discipline() == 0
    assert abs(clock.now_ns() - machine.system()) < MS


def test_a_reading_that_was_interrupted_is_no_step() -> None:
    machine = Machine()
    clock = machine.clock()
    machine.reading_ns = 50 * MS
    assert clock.discipline() == 0
    machine.reading_ns = 0
    assert clock.discipline() == 0 and clock.now_ns() == machine.system()


def test_slow_motion_does_not_follow_the_system_clock() -> None:
    machine = Machine()
    clock = machine.clock(0.25, start_ns=1_800_000_001 * S)
    assert clock.now_ns() < clock.start_ns
    machine.elapsed_ns += S
    assert clock.now_ns() == clock.start_ns
    machine.elapsed_ns, machine.step_ns = 3 * S, 5 * S
    assert clock.discipline() == 0 and clock.now_ns() == clock.start_ns + S // 2


def test_stamps_are_tai() -> None:
    """TAI is ahead of UTC by 37 s since 2017 (IERS Bulletin C)."""
    assert abs(read_tai_ns() - time.time_ns() - TAI_UTC_NS) < 5 * S
    assert tai_from_utc_ns(5) == 5 + 37 * S
