# SPDX-License-Identifier: Apache-2.0
"""Several recordings as one: names stay unique, snapshots are those of their recording, draws follow the weights."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datasets.base import RecordingReader
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.mixed import MixedRecording, draw_scenario, open_recordings
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, RecordingError, Snapshot, Transform


class Numbered(RecordingReader):
    """Scenarios whose only agent has the number of the recording, and one missing file each."""

    def __init__(self, number: int, scenarios: tuple[str, ...]) -> None:
        self.number, self.scenarios = number, scenarios
        self.missing_summary = (f"{number}: a note",)
        self.missing_files = tuple(FileProblem(Path(f"{number}/{s}"), "missing", s, "absent") for s in scenarios)

    def length(self, scenario: str) -> int:
        return self.number + 1

    def eval_indices(self, scenario: str) -> range:
        return range(1, self.number + 1)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        cloud = PointCloud.of(torch.zeros(0, 3))
        return Snapshot(
            scenario, index, (AgentFrame.of(cloud, Transform.from_xyz_yaw(0, 0), agent_id=self.number, timestamp_ns=0),)
        )

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        return [FileProblem(Path(f"{self.number}/{scenario}.pcd"), "mismatched", scenario, "odd")]


def test_names_are_unique_and_lead_to_their_recording():
    mixed = MixedRecording([Numbered(1, ("a", "b")), Numbered(2, ("a", "c")), Numbered(3, ("a", "a~2"))])
    assert mixed.scenarios == ("a", "b", "a~2", "c", "a~3", "a~2~3")
    expected = dict(zip(mixed.scenarios, (1, 1, 2, 2, 3, 3)))
    for name, number in expected.items():
        snapshot = mixed.snapshot(name, 0)
        assert (snapshot.scenario, snapshot.frames[0].agent_id, mixed.agents(name)) == (name, number, (number,))
        assert mixed.length(name) == number + 1 and mixed.eval_indices(name) == range(1, number + 1)
    with pytest.raises(RecordingError, match="No scenario 'd' in this mixture; it holds a, b"):
        mixed.length("d")


def test_missing_files_are_those_of_all_recordings_under_the_new_names():
    mixed = MixedRecording([Numbered(1, ("a",)), Numbered(2, ("a",))])
    found = mixed.verify()
    assert found.count == 4 and {p.scenario for p in found.files if p.path.parts[0] == "2"} == {"a~2"}
    assert mixed.missing_summary == ("1: a note", "2: a note")
    assert mixed.verify(["a"]).count == 2


def test_draws_are_uniform_over_scenarios_or_by_the_weights_of_recordings():
    parts = [Numbered(1, ("a",)), Numbered(2, ("b", "c", "d"))]
    rng = np.random.default_rng(0)
    uniform, weighted = MixedRecording(parts), MixedRecording(parts, (3.0, 1.0))
    count = Counter(draw_scenario(uniform, rng) for _ in range(4000))
    assert all(abs(count[name] / 4000 - 0.25) < 0.03 for name in "abcd")
    count = Counter(draw_scenario(weighted, rng) for _ in range(4000))
    assert abs(count["a"] / 4000 - 0.75) < 0.03 and abs(count["c"] / 4000 - 1 / 12) < 0.03


def test_a_mixture_without_weights_draws_as_one_recording_of_its_scenarios():
    one, mixed = Numbered(1, ("a", "b", "c")), MixedRecording([Numbered(1, ("a", "b")), Numbered(2, ("c",))])
    draws = [[draw_scenario(r, np.random.default_rng(seed)) for seed in range(50)] for r in (one, mixed)]
    assert draws[0] == draws[1]


@pytest.mark.parametrize("weights", [(1.0,), (1.0, 2.0, 3.0), (1.0, 0.0), (1.0, float("inf"))])
def test_weights_that_do_not_fit_are_refused(weights):
    with pytest.raises(ConfigError, match="A mixture of 2 recordings needs 2 positive weights"):
        MixedRecording([Numbered(1, ("a",)), Numbered(2, ("b",))], weights)


def test_one_path_opens_its_reader_and_several_a_mixture(tmp_path):
    for name in ("one", "two"):
        writer = Opv2vWriter(tmp_path / name / "train" / "a")
        cloud = PointCloud.of(torch.ones(4, 3), torch.ones(4))
        frame = AgentFrame(1, 0, cloud, Transform.from_xyz_yaw(0, 0), torch.zeros(3, 3))
        writer.write(Snapshot("a", 0, (frame,)))
        writer.close({})
    one, both = (open_recordings([tmp_path / n for n in names], "train") for names in (["one"], ["one", "two"]))
    assert not isinstance(one, MixedRecording) and one.scenarios == ("a",) and both.scenarios == ("a", "a~2")
    with pytest.raises(ConfigError, match="at least one recording"):
        open_recordings([], "train")
    with pytest.raises(ConfigError, match="A mixture of 1 recordings needs 1 positive weights"):
        open_recordings([tmp_path / "one"], "train", weights=(1.0, 2.0))
