# SPDX-License-Identifier: Apache-2.0
"""The air: airtime by hand, fairness, paired losses, and independence of the order of calls."""

import math
from dataclasses import replace
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.comms.channel import CHANNELS, Channel, ChannelPreset, SharedMedium, Transmission, channel_preset
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import ConfigError

MS = 1_000_000
SLOW = ChannelPreset("slow", 8e6, mtu=1000, busy_ratio_limit=0.5)
LOSSY = ChannelPreset("lossy", math.inf, loss_at_m=((0.0, 0.0), (100.0, 0.3)), mean_burst_packets=3)
HERE = (0.0, 0.0)


def packets(count: int, size: int = 1000, mark: int = 0) -> tuple[bytes, ...]:
    return tuple(bytes([mark, k % 256]) + bytes(size - 2) for k in range(count))


def arrivals(deliveries) -> list[tuple[int, int, float]]:
    return [(d.sender_id, d.packet[1], d.arrival_ns / MS) for d in deliveries]


def test_airtime_by_hand():
    """1000 B at 8 Mb/s are 1 ms on the air; half of the airtime may be used, so the next packet begins after 2 ms."""
    sends = [Transmission(1, HERE, packets(2), 0), Transmission(2, HERE, packets(2), 0)]
    got = Channel(SLOW).transmit(sends, 9, HERE)
    assert arrivals(got) == [(1, 0, 1), (2, 0, 3), (1, 1, 5), (2, 1, 7)]


def test_delay_follows_from_the_bytes_of_all_senders():
    alone = Channel(SLOW).transmit([Transmission(1, HERE, packets(4), 0)], 9, HERE)
    half = Channel(SLOW).transmit([Transmission(1, HERE, packets(4, 500), 0)], 9, HERE)
    crowd = Channel(SLOW).transmit([Transmission(i, HERE, packets(4), 0) for i in range(4)], 9, HERE)
    assert [alone[-1].arrival_ns, half[-1].arrival_ns, crowd[-1].arrival_ns] == [7 * MS, 3.5 * MS, 31 * MS]
    overhead = replace(SLOW, per_packet_overhead_bytes=1000)
    assert Channel(overhead).transmit([Transmission(1, HERE, packets(4), 0)], 9, HERE)[-1].arrival_ns == 14 * MS


def test_a_late_sender_takes_its_turn_at_once():
    sends = [Transmission(1, HERE, packets(4), 0), Transmission(2, HERE, packets(1), 3 * MS)]
    assert [d.sender_id for d in Channel(SLOW).transmit(sends, 9, HERE)] == [1, 1, 2, 1, 1]


def test_waiting_packets_are_replaced_by_newer_ones():
    bus = LocalBus(Channel(SLOW))
    bus.publish(1, HERE, packets(10), 0)
    bus.publish(1, HERE, packets(1, mark=7), 5 * MS)
    got = bus.deliver(9, HERE, 100 * MS)
    assert [(d.packet[0], d.arrival_ns / MS) for d in got] == [(0, 1), (0, 3), (0, 5), (7, 7)]
    assert bus.dropped_in_queue == 7


def test_all_agents_but_the_sender_receive():
    bus = LocalBus(Channel(channel_preset("ideal")))
    for agent in (1, 2, 3):
        bus.publish(agent, HERE, packets(2), 0)
    for agent in (1, 2, 3):
        assert sorted({d.sender_id for d in bus.deliver(agent, HERE, 0)}) == sorted({1, 2, 3} - {agent})
        assert bus.deliver(agent, HERE, 10**9) == []


def test_ideal_has_no_delay_and_no_loss_at_any_distance():
    bus = LocalBus(Channel(channel_preset("ideal"), seed=5))
    bus.publish(1, HERE, packets(500), 123)
    got = bus.deliver(2, (1e6, 1e6), 123)
    assert [d.packet for d in got] == list(packets(500))
    assert {d.arrival_ns for d in got} == {123}


@pytest.mark.parametrize("preset", CHANNELS, ids=lambda p: p.name)
def test_presets_in_the_order_of_nature(preset):
    assert channel_preset(preset.name) is preset
    losses = [preset.loss(d) for d in range(0, 1000, 10)]
    assert all(a <= b for a, b in pairwise(losses))
    sends = [Transmission(1, HERE, packets(20), k * 1000 * MS) for k in range(50)]
    near = Channel(preset).transmit(sends, 2, (30.0, 0.0))
    assert 950 <= len(near) <= 1000
    fastest = preset.base_latency_s * 1e9 + preset.airtime_ns(1000)
    assert all(d.arrival_ns - d.sent_ns >= fastest for d in near)


def test_a_budgeted_message_fits_a_frame_of_its_g5_and_a_dense_one_does_not():
    """26.8 kB are 36 ms of payload at 6 Mb/s; 125.7 kB are 168 ms: more than a frame of 100 ms."""
    channel = Channel(replace(channel_preset("its-g5"), per_packet_overhead_bytes=0, busy_ratio_limit=1.0))
    fits = channel.transmit([Transmission(1, HERE, packets(20, 1340), 0)], 2, HERE)
    assert 36 * MS <= max(d.arrival_ns for d in fits) <= 42 * MS
    dense = channel.transmit([Transmission(1, HERE, packets(90, 1397), 0)], 2, HERE)
    assert max(d.arrival_ns for d in dense) > 160 * MS


@given(st.integers(0, 10**6), st.integers(1, 300), st.floats(0, 0.95), st.floats(0, 0.95), st.floats(1, 8))
def test_losses_are_paired_across_levels(seed, count, one, other, burst):
    low, high = sorted((one, other))
    got = []
    for level in (low, high):
        preset = replace(LOSSY, mean_burst_packets=burst).with_loss(level)
        got.append(
            {d.packet for d in Channel(preset, seed).transmit([Transmission(1, HERE, packets(count), 0)], 2, HERE)}
        )
    assert got[1] <= got[0]


@pytest.mark.parametrize(("loss", "burst"), [(0.1, 3.0), (0.3, 3.0), (0.2, 1.0), (0.6, 5.0)])
def test_long_run_loss_and_burst_length(loss, burst):
    channel = Channel(replace(LOSSY, mean_burst_packets=burst).with_loss(loss), seed=3)
    lost = np.concatenate([channel._draw_losses(1, 2, t, 200, loss) for t in range(200)])
    assert lost.mean() == pytest.approx(loss, abs=0.02)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], lost.astype(int), [0])))))[::2]
    assert runs.mean() == pytest.approx(max(burst, 1 / (1 - loss)), rel=0.1)


def test_far_receivers_lose_more_and_certain_loss_is_total():
    send = [Transmission(1, HERE, packets(2000), 0)]
    near, far = (len(Channel(LOSSY, 1).transmit(send, 2, (d, 0.0))) for d in (30.0, 100.0))
    assert 2000 > near > far > 0
    assert Channel(LOSSY.with_loss(1.0)).transmit(send, 2, HERE) == ()


def test_draws_depend_on_sender_receiver_and_time_only():
    preset = replace(LOSSY.with_loss(0.4), jitter_s=0.01)
    send = Transmission(1, HERE, packets(100), 0)
    base = Channel(preset, 1).transmit([send], 2, HERE)
    crowd = Channel(preset, 1).transmit(
        [Transmission(5, HERE, packets(50), 0), send, Transmission(0, HERE, packets(3), 0)], 2, HERE
    )
    assert [d for d in crowd if d.sender_id == 1] == list(base)
    longer = Channel(preset, 1).transmit([replace(send, packets=packets(150))], 2, HERE)
    assert [d for d in longer if d.packet in send.packets] == list(base)

    def kept(seed=1, sender=1, receiver=2, sent_ns=0):
        sends = [replace(send, agent_id=sender, sent_ns=sent_ns)]
        return {d.packet for d in Channel(preset, seed).transmit(sends, receiver, HERE)}

    others = [kept(seed=2), kept(sender=4), kept(receiver=3), kept(sent_ns=1)]
    assert all(kept() != other for other in others)


def test_jitter_reorders_within_its_bounds():
    preset = ChannelPreset("jittery", math.inf, base_latency_s=0.02, jitter_s=0.08)
    got = Channel(preset, 1).transmit([Transmission(1, HERE, packets(100), 0)], 2, HERE)
    times = [d.arrival_ns for d in got]
    assert times == sorted(times)
    assert [d.packet for d in got] != list(packets(100))
    assert min(times) >= 20 * MS and max(times) <= 100 * MS


def test_the_order_of_publishing_at_one_instant_does_not_matter():
    preset = replace(SLOW, jitter_s=0.002).with_loss(0.2)
    results = []
    for order in permutations((1, 2, 3)):
        bus = LocalBus(Channel(preset, 7))
        got = []
        for frame in range(3):
            for agent in order:
                bus.publish(agent, HERE, packets(5, mark=frame), frame * 20 * MS)
            for agent in order:
                got += [(agent, d) for d in bus.deliver(agent, HERE, (frame + 1) * 20 * MS)]
        results.append(sorted(got, key=lambda row: (row[0], row[1].arrival_ns, row[1].packet)))
    assert all(result == results[0] for result in results)
    assert len(results[0]) > 10


def test_asking_at_the_instant_of_sending_settles_nothing():
    early, late = LocalBus(Channel(SLOW)), LocalBus(Channel(SLOW))
    early.publish(2, HERE, packets(2), 0)
    assert early.deliver(9, HERE, 0) == []
    early.publish(1, HERE, packets(2), 0)
    for agent in (1, 2):
        late.publish(agent, HERE, packets(2), 0)
    assert early.deliver(9, HERE, 50 * MS) == late.deliver(9, HERE, 50 * MS)


@given(st.lists(st.integers(0, 60), min_size=1, max_size=12), st.integers(0, 1000))
def test_how_often_one_asks_makes_no_difference(instants, seed):
    preset = replace(SLOW, jitter_s=0.005).with_loss(0.3)

    def collected(stops):
        bus = LocalBus(Channel(preset, seed))
        sends = [(0, 1, 6), (0, 2, 4), (15, 1, 3), (30, 3, 2)]
        got = []
        for stop in sorted({*stops, 200}):
            for at, agent, count in [s for s in sends if s[0] <= stop]:
                bus.publish(agent, HERE, packets(count), at * MS)
                sends.remove((at, agent, count))
            got += bus.deliver(9, HERE, stop * MS)
        return got

    # Publishing before each stop needs every send to be known by then: stops at the times of sending keep the order.
    assert collected([0, 15, 30]) == collected([0, 15, 30, *instants])


def test_uncollected_packets_are_dropped():
    bus = LocalBus(Channel(channel_preset("ideal")), keep_s=1.0)
    for k in range(50):
        bus.publish(1, HERE, packets(1, mark=k), k * 100 * MS)
        bus.deliver(2, HERE, k * 100 * MS)
    assert len(bus._on_air) <= 11
    assert [d.packet[0] for d in bus.deliver(3, HERE, 4900 * MS)] == list(range(39, 50))


def test_misuse_is_named():
    bus = LocalBus(Channel(SLOW))
    with pytest.raises(ConfigError, match="mtu=1000"):
        bus.publish(1, HERE, [bytes(1001)], 0)
    bus.deliver(1, HERE, 10)
    bus.publish(1, HERE, [bytes(10)], 10)
    with pytest.raises(ConfigError, match="in order of time"):
        bus.publish(1, HERE, [bytes(10)], 9)
    with pytest.raises(ConfigError, match="known are ideal, its-g5-6, its-g5-27mbps, lte-v2x, nr-sidelink, cellular"):
        channel_preset("pigeon")


@pytest.mark.parametrize(
    "change",
    [
        {"rate_bps": 0.0},
        {"busy_ratio_limit": 1.5},
        {"loss_at_m": ()},
        {"loss_at_m": ((10.0, 0.1), (0.0, 0.2))},
        {"loss_at_m": ((0.0, 1.2),)},
        {"jitter_s": -1.0},
    ],
)
def test_impossible_presets_are_refused(change):
    with pytest.raises(ConfigError, match="ChannelPreset"):
        replace(SLOW, **change)


def test_agents_that_left_are_forgotten():
    medium = SharedMedium(channel_preset("ideal"))
    for number in range(100):
        medium.offer(Transmission(number, HERE, packets(1), number * MS))
        assert len(medium.run((number + 0.5) * MS)) == 1
    assert len(medium._numbered) <= 1


def test_a_former_name_of_a_preset_is_read() -> None:
    assert channel_preset("its-g5") is channel_preset("its-g5-6") and channel_preset("its-g5-6").rate_bps == 6e6
