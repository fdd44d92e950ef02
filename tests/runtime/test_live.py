# SPDX-License-Identifier: Apache-2.0
"""The loop of a live agent on a clock that the test moves: deadlines, overload, keys that change, and a replay bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("mcap", reason="the extra live is not installed")

from tests.runtime.conftest import START_S, Federation

from manyeyes import Agent, AgentFrame
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.channel import Channel, channel_preset
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import ConfigError, RecordingError
from manyeyes.runtime.live import LiveConfig, LiveRun
from manyeyes.runtime.pseudonyms import PseudonymPool
from manyeyes.runtime.recorder import Recorder, RunConfig, read_events
from manyeyes.runtime.replay import read_config, replay_run
from manyeyes.runtime.security import Security
from manyeyes.runtime.summary import RunStatistics
from manyeyes.runtime.transports.local import LocalNetwork
from manyeyes.runtime.trust_file import Revocations
from manyeyes.runtime.what_if import parse_changes

START_NS, MS, TENTH_NS = START_S * 10**9, 10**6, 10**8
CONFIG = RunConfig("tiny", "", "intermediate", 4_096, None, "require", {}, 1)


class ManualClock:
    """A clock that sleeps move."""

    start_ns, rate = START_NS, 1.0

    def __init__(self) -> None:
        self.ns = START_NS

    def now_ns(self) -> int:
        return self.ns

    def sleep(self, duration_ns: int) -> None:
        self.ns += max(duration_ns, 1)

    def discipline(self) -> int:
        return 0


class Team:
    """Two live agents of the drive, in turn, on one channel and one clock. delay_ns: that a perception takes."""

    def __init__(self, detector, drive, federation: Federation, tmp_path: Path, mode: str = "require") -> None:
        self.clock, self.bus, self.drive = ManualClock(), LocalBus(Channel(channel_preset("ideal"))), drive(2)
        self.detector, self.tmp_path, self.delay_ns = detector, tmp_path, 0
        self.trust_file = tmp_path / "trust.toml"
        federation.trust.save(self.trust_file)
        self.identities = [federation.identity(k + 1) for k in range(2)]
        self.runs = [self.make_run(k, mode) for k in range(2)]

    def make_run(self, k: int, mode: str) -> LiveRun:
        network = LocalNetwork(self.bus, k + 1, self.clock.now_ns)
        network.join((1234.5, -678.9))
        security = Security()
        if mode != "off":
            security = Security(mode, PseudonymPool([self.identities[k]]), self.trust_file)
        recorder = Recorder(self.tmp_path / f"{k}.mcap", replace(CONFIG, security=mode))
        run = LiveRun([], self.agent(), network, self.clock, LiveConfig(), security, recorder)
        perceive = run._loop.engine.perceive

        def slow(frame: AgentFrame, now_ns: int):
            self.clock.ns += self.delay_ns
            return perceive(frame, now_ns)

        run._loop.engine.perceive = slow
        return run

    def agent(self) -> Agent:
        return Agent(self.detector, get_strategy("intermediate"), budget_bytes=4_096)

    def step(self, index: int, k: int):
        frame = self.drive.frame(k, index)
        stamp = START_NS + index * TENTH_NS + k * TENTH_NS // 2
        self.clock.ns = max(self.clock.ns, stamp)
        return self.runs[k].step(replace(frame, agent_id=k + 1, timestamp_ns=stamp))

    def close(self) -> list[Path]:
        assert [run.recorder.close() for run in self.runs] == ["", ""]
        return [run.recorder.path for run in self.runs]


@pytest.fixture
def team(detector, drive, federation: Federation, tmp_path: Path) -> Team:
    return Team(detector, drive, federation, tmp_path)


def boxes_of(perception) -> torch.Tensor:
    return torch.cat((perception.boxes.bev(), perception.boxes.score[:, None]), 1)


@pytest.mark.slow
def test_a_recorded_run_is_computed_again_bit_for_bit(team: Team) -> None:
    """Signed packets of two agents, in mode require, with overload from the third frame on."""
    ticks = []
    for index in range(6):
        team.delay_ns = 90 * MS if index in (1, 2, 3) else 10 * MS
        ticks.append([team.step(index, k) for k in range(2)])
    assert all(tick.perception.received for pair in ticks[1:] for tick in pair)
    levels = [pair[0].level for pair in ticks]
    assert levels[0] == 0 and levels[-1] >= 1
    for k, path in enumerate(team.close()):
        replayed = list(replay_run(path, lambda config: team.agent()))
        assert [(tick.same_packets, tick.same_result) for tick in replayed] == [(True, True)] * 6
        for pair, again in zip(ticks, replayed):
            assert torch.equal(boxes_of(pair[k].perception), boxes_of(again.perception))
    # Without the check of signatures signed packets are not read: another result, and it is noticed.
    without = list(replay_run(path, lambda config: team.agent(), parse_changes(["security=off"])))
    assert not any(tick.perception.received for tick in without) and not all(tick.same_result for tick in without)


@pytest.mark.slow
def test_a_perception_waits_for_its_deadline_or_for_the_senders_of_the_last_frame(team: Team) -> None:
    first = team.step(0, 0)
    assert first.wait_ns >= 70 * MS and not first.missed and first.sent_packets > 0
    team.step(0, 1)
    second = team.step(1, 0)
    assert [m.message.agent_id for m in second.perception.received] == [2]
    assert second.ages_ns[0] >= 50 * MS and second.latency_ns >= 70 * MS
    statistics = RunStatistics(1, 1.0)
    for tick in (first, second):
        statistics.add(tick)
    summary = statistics.summary()
    assert (summary.frames, summary.fused, summary.missed) == (2, 1, 0)
    assert summary.sent_bytes == first.sent_bytes + second.sent_bytes and summary.age.p50_ms >= 50


@pytest.mark.slow
def test_missed_deadlines_reduce_the_work_to_no_fusion(team: Team) -> None:
    team.delay_ns = 200 * MS
    ticks = [team.step(2 * index, 0) for index in range(13)]
    assert all(tick.missed for tick in ticks) and [tick.level for tick in ticks][::3] == [0, 1, 2, 3, 4]
    assert ticks[-1].sent_packets == 0 and ticks[6].sent_bytes <= 2_048


@pytest.mark.slow
def test_a_trust_file_that_changes_takes_effect_without_a_restart(team: Team, federation: Federation) -> None:
    team.step(0, 1)
    assert team.step(1, 0).perception.received
    revoked = Revocations(frozenset({team.identities[1].certificate.identifier}))
    team.trust_file.write_text("[[anchor")
    team.step(6, 1)
    broken = team.step(7, 0)
    assert "the last one stays" in broken.note and broken.perception.received
    replace(federation.trust, revoked=revoked).save(team.trust_file)
    team.step(12, 1)
    after = team.step(13, 0)
    assert not after.perception.received and after.dropped.revoked > 0 and "read again" in after.note


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_nothing_else(team: Team, monkeypatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    team.step(0, 0)
    monkeypatch.setattr(team.runs[0].recorder._writer, "add_message", fail)
    tick = team.step(1, 0)
    assert "recording stopped" in tick.note and len(tick.perception.boxes.score)
    assert team.step(2, 0).note == "" and team.runs[0].recorder.close() == ""
    assert not list(team.tmp_path.glob("*0.mcap*"))


@pytest.mark.slow
def test_a_run_is_read_event_by_event_and_holds_no_key(team: Team) -> None:
    team.step(0, 0)
    path, _ = team.close()
    kinds = [type(event).__name__ for event in read_events(path)]
    assert kinds == ["RunConfig", "Trust", "FrameEvent", "TickEvent"]
    assert read_config(path) == replace(CONFIG, security="require")
    for identity in team.identities:
        assert identity.key.private_bytes_raw() not in path.read_bytes()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(RecordingError, match="record it again"):
        list(read_events(path))


@pytest.mark.slow
def test_mode_off_sends_what_share_returns(detector, drive, federation, tmp_path) -> None:
    team = Team(detector, drive, federation, tmp_path, "off")
    tick = team.step(0, 0)
    plain = Agent(detector, get_strategy("intermediate"), budget_bytes=4_096).share(tick.frame)
    assert (tick.sent_packets, tick.sent_bytes) == (len(plain), sum(map(len, plain)))


def test_settings_that_cannot_work_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="perceive_after_ns < deadline_ns"):
        LiveConfig(perceive_after_ns=10**9)
    with pytest.raises(ConfigError, match="needs a trust file"):
        Security("require")
