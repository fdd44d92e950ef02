# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.communication import MessageRecord, compute_paper_bytes, summarize_messages


def test_the_papers_formula():
    assert compute_paper_bytes(242, 128) == 125_840
    assert math.log2(compute_paper_bytes(242, 128)) == pytest.approx(16.941, abs=5e-4)
    assert math.log2(compute_paper_bytes(48 * 176, 256)) == pytest.approx(23.0556, abs=5e-5)
    assert math.log2(compute_paper_bytes(64 * 64, 256)) == pytest.approx(22.0112, abs=5e-5)


def test_the_two_logarithms_differ_and_zero_bytes_count():
    records = [MessageRecord("a", 0, 1, 1024), MessageRecord("a", 0, 2, 0), MessageRecord("a", 1, 1, 4096)]
    got = summarize_messages(records)
    assert (got.num_messages, got.num_empty_messages, got.num_ego_frames) == (3, 1, 2)
    assert got.bytes_per_message == pytest.approx(5120 / 3)
    assert got.bytes_per_ego_frame == 2560
    assert got.megabits_per_s == pytest.approx(2560 * 8 * 10 / 1e6)
    assert got.log2_mean_bytes == pytest.approx(math.log2(5120 / 3))
    assert got.mean_log2_bytes == pytest.approx(11.0)
    without_empty = summarize_messages([records[0], records[2]])
    assert without_empty.mean_log2_bytes < without_empty.log2_mean_bytes


def test_five_messages_of_the_paper_fill_the_channel():
    records = [
        MessageRecord("a", f, s, 125_840, num_tokens=242, num_channels=128) for f in range(3) for s in range(1, 5)
    ]
    got = summarize_messages(records)
    assert got.log2_paper_bytes == pytest.approx(16.941, abs=5e-4) and got.tokens_per_message == 242
    assert got.megabits_per_s == pytest.approx(40.27, abs=0.01)


def test_two_egos_of_one_frame_are_two_ego_frames():
    records = [MessageRecord("a", 0, 1, 100, ego=0), MessageRecord("a", 0, 0, 300, ego=1)]
    assert summarize_messages(records).bytes_per_ego_frame == 200


def test_frames_without_messages():
    got = summarize_messages([MessageRecord("a", 0, 1, 100)], num_ego_frames=4)
    assert got.bytes_per_ego_frame == 25 and got.bytes_per_message == 100
    assert got.mean_log2_bytes == pytest.approx(math.log2(100)) and got.num_empty_messages == 0
    nothing = summarize_messages([], num_ego_frames=4)
    assert nothing.bytes_per_ego_frame == 0 and nothing.megabits_per_s == 0
    assert math.isnan(nothing.bytes_per_message) and math.isnan(nothing.log2_mean_bytes)
    silent = summarize_messages([MessageRecord("a", 0, 1, 0)])
    assert silent.bytes_per_message == 0 and math.isnan(silent.log2_mean_bytes) and math.isnan(silent.mean_log2_bytes)


def test_impossible_counts_are_refused():
    with pytest.raises(ConfigError, match="below 0"):
        MessageRecord("a", 0, 1, -1)
    with pytest.raises(ConfigError, match="alone name 1"):
        summarize_messages([MessageRecord("a", 0, 1, 5)], num_ego_frames=0)
