# SPDX-License-Identifier: Apache-2.0
"""The time at which agents that are started apart begin together."""

from datetime import UTC, datetime, timedelta

import pytest

from manyeyes.cli.live.start import announce_ready, parse_start
from manyeyes.datatypes import ConfigError
from manyeyes.runtime.clock import TAI_UTC_NS, LiveClock, read_tai_ns


def test_a_start_is_a_date_and_time_or_a_time_of_today() -> None:
    stated = datetime(2026, 11, 27, 18, 5, tzinfo=UTC)
    expected = int(stated.timestamp()) * 10**9 + TAI_UTC_NS
    assert parse_start("2026-11-27T18:05:00Z") == expected
    assert parse_start("2026-11-27 19:05:00.25+01:00") == expected + 250_000_000
    local = datetime.now().replace(hour=18, minute=5, second=7, microsecond=0)
    assert parse_start("18:05:07") == int(local.timestamp()) * 10**9 + TAI_UTC_NS


@pytest.mark.parametrize("text", ["soon", "25:00:00", "2026-13-01T00:00:00", ""])
def test_another_text_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="18:05:00"):
        parse_start(text)


@pytest.mark.parametrize("rate", [1.0, 0.1])
def test_clocks_with_one_start_agree_whenever_they_are_made(rate: float) -> None:
    """Agents warm up for different times before their clocks are made, also after the start."""
    elapsed_ns = [0]

    def make(waited_s: float) -> LiveClock:
        elapsed_ns[0] = round(waited_s * 1e9)
        return LiveClock(
            5_000_000_000, rate, reference=lambda: 2_000_000_000 + elapsed_ns[0], monotonic=lambda: 77 + elapsed_ns[0]
        )

    clocks = [make(waited_s) for waited_s in (0.0, 1.0, 4.0)]
    elapsed_ns[0] = 13_000_000_000
    assert [clock.now_ns() for clock in clocks] == [5_000_000_000 + round(10e9 * rate)] * 3


def test_the_start_is_that_of_the_option() -> None:
    start_ns = parse_start((datetime.now(UTC) + timedelta(seconds=3)).isoformat())
    clock = announce_ready(False, start_ns=start_ns)
    assert clock.start_ns == start_ns and -3.1e9 < clock.now_ns() - start_ns < 0
    assert abs(announce_ready(False).start_ns - read_tai_ns()) < 1e9
