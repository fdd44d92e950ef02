# SPDX-License-Identifier: Apache-2.0
"""Metrics, health and log of a live agent show its ticks, and change nothing of them."""

from __future__ import annotations

import io
import json
import urllib.error
import urllib.request

import pytest
from tests.runtime.fault_team import MS, FaultTeam

from manyeyes.datatypes import ConfigError
from manyeyes.runtime.event_log import MAX_LINES_PER_S, EventLog
from manyeyes.runtime.metrics import LiveMetrics
from manyeyes.runtime.status_server import StatusServer

pytest.importorskip("prometheus_client", reason="the extra metrics is not installed")


class Seconds:
    """A monotonic clock that the test moves."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def value(text: str, name: str) -> float:
    (line,) = [line for line in text.splitlines() if line.startswith(f"{name} ")]
    return float(line.split()[-1])


def get(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


@pytest.mark.slow
def test_metrics_are_those_of_the_ticks_and_name_no_sender(federation, tmp_path) -> None:
    team, metrics = FaultTeam(federation, tmp_path, mode="require"), LiveMetrics()
    for _ in range(3):
        tick = team.step()[1]
        metrics.add(tick, 4)
    text = metrics.text().decode()
    assert value(text, "manyeyes_frames_total") == 3 and value(text, "manyeyes_sent_packets_total") == 3
    assert value(text, "manyeyes_sent_bytes_total") > 3 * 76 and value(text, "manyeyes_neighbours") == 4
    assert value(text, "manyeyes_received_packets_total") == tick.received_packets == 12
    assert value(text, 'manyeyes_refused_packets_total{reason="forged"}') == 0
    assert value(text, "manyeyes_age_seconds_count") == 12 and value(text, "manyeyes_fused_messages") == 4
    assert value(text, 'manyeyes_stage_seconds_count{stage="perceive"}') == 3
    assert value(text, "manyeyes_resident_bytes") > 1e7 and "agent" not in text


@pytest.mark.slow
def test_health_is_a_recent_tick_of_a_clock_that_did_not_step(federation, tmp_path) -> None:
    team, seconds = FaultTeam(federation, tmp_path, num=2), Seconds()
    metrics = LiveMetrics(monotonic=seconds)
    server = StatusServer("127.0.0.1:0", metrics)
    try:
        assert get(server.port, "/healthz") == (503, "no frame yet\n")
        metrics.add(team.step()[1], 1)
        assert get(server.port, "/healthz") == (200, "healthy\n")
        seconds.now += 0.6
        assert get(server.port, "/healthz") == (503, "the last frame is 0.6 s old\n")
        team.members[1].clock.step(300 * MS)
        metrics.add(team.step()[1], 1)
        status, text = get(server.port, "/healthz")
        assert status == 503 and "clock stepped" in text
        assert get(server.port, "/metrics")[0] == 200 and get(server.port, "/other")[0] == 404
        assert value(get(server.port, "/metrics")[1], "manyeyes_clock_steps_total") == 1
        with pytest.raises(ConfigError, match=r"127\.0\.0\.1"):
            StatusServer(f"127.0.0.1:{server.port}", metrics)
    finally:
        server.close()
    with pytest.raises(ConfigError, match="HOST:PORT"):
        StatusServer("9464", metrics)


@pytest.mark.slow
def test_events_are_json_lines_with_fixed_names(federation, tmp_path) -> None:
    team, stream = FaultTeam(federation, tmp_path, num=2), io.StringIO()
    member = team.members[1]
    log = EventLog(stream, 1, member.clock.now_ns)
    member.clock.step(300 * MS)
    log.add(team.step()[1], frozenset({"2"}))
    member.delay_ns = 200 * MS
    for _ in range(4):
        log.add(team.step()[1], frozenset())
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["event"] for line in lines] == [
        "clock_step", "neighbours", "missed", "neighbours", "missed", "missed", "missed", "level",
    ]  # fmt: skip
    assert all(line["agent"] == 1 and line["tai_ns"] > 0 and line["monotonic_ns"] > 0 for line in lines)
    assert lines[1]["new"] == ["2"] and lines[3]["gone"] == ["2"] and lines[-1]["level"] == 1


def test_at_most_ten_lines_a_second_of_an_event_and_then_their_number() -> None:
    stream, now = io.StringIO(), [0]
    log = EventLog(stream, 1, lambda: 5, lambda: now[0])
    for _ in range(30):
        log.write("missed")
    log.write("stop")
    now[0] = 10**9
    log.write("missed")
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert len(lines) == MAX_LINES_PER_S + 2 and lines[-1]["left_out"] == 20 and "left_out" not in lines[-2]
