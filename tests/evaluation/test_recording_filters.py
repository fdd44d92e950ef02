# SPDX-License-Identifier: Apache-2.0
"""Views of a hand-made recording: which frames and agents are left, and that the truth is the whole recording's."""

import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.average_precision import PROTOCOLS, select_ego_truth
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.detection.recording_filters import FrameStride, NearestAgents, ScenarioStride

#      ego 7      12 m away      40 m away     5 m away
PLACES = {7: (0.0, 0.0), 3: (12.0, 0.0), 9: (40.0, 0.0), 4: (0.0, 5.0)}


class Street:
    """Scenario 'many' has four agents, 'few' the first two; agent k alone lists car k, 10 m ahead of it."""

    scenarios = ("few", "many")

    def length(self, scenario: str) -> int:
        return 16

    def eval_indices(self, scenario: str) -> range:
        return range(6, 16)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return tuple(PLACES)[: 4 if scenario == "many" else 2]

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        ids = self.agents(scenario)
        poses = [Transform.from_xyz_yaw(*PLACES[i]) for i in ids]
        cloud = PointCloud.of(torch.zeros(1, 3))
        frames = tuple(AgentFrame(i, index, cloud, p, torch.zeros(3, 3)) for i, p in zip(ids, poses))
        center = torch.tensor([[PLACES[i][0] + 10.0, PLACES[i][1], 0.8] for i in ids], dtype=torch.float64)
        size = torch.tensor([4.5, 1.9, 1.6]).double().expand(len(ids), 3)
        boxes = Boxes.of(center, size, torch.zeros(len(ids)).double(), id=100 + torch.tensor(ids))
        return Snapshot(scenario, index, frames, GroundTruth(boxes, torch.eye(len(ids)).bool(), Transform.stack(poses)))


@pytest.mark.parametrize(
    ("every", "left"), [(1, [*range(6, 16)]), (3, [6, 9, 12, 15]), (5, [6, 11]), (10, [6]), (99, [6])]
)
def test_every_kth_frame_is_evaluated_and_none_after_the_last(every, left) -> None:
    evaluated = FrameStride(Street(), every).eval_indices("many")
    assert list(evaluated) == left and evaluated.stop == left[-1] + 1


@pytest.mark.parametrize("view", [FrameStride, ScenarioStride])
def test_every_zeroth_is_refused(view) -> None:
    with pytest.raises(ConfigError, match="at least 1; got 0"):
        view(Street(), 0)


@pytest.mark.parametrize(("every", "left"), [(1, ("few", "many")), (2, ("few",)), (9, ("few",))])
def test_every_kth_scenario_is_evaluated(every, left) -> None:
    assert BenchmarkConfig(scenario_stride=every).filter_recording(Street()).scenarios == left


def test_scenarios_are_chosen_before_those_of_too_few_agents_are_left_out() -> None:
    assert BenchmarkConfig(scenario_stride=2, num_agents=3).filter_recording(Street()).scenarios == ()


@pytest.mark.parametrize(("count", "left"), [(1, [7]), (2, [7, 4]), (3, [7, 3, 4]), (4, [7, 3, 9, 4])])
def test_the_nearest_are_left_in_their_order(count, left) -> None:
    view = NearestAgents(Street(), count)
    assert [frame.agent_id for frame in view.snapshot("many", 9).frames] == left == list(view.agents("many"))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_truth_does_not_shrink_with_the_number_of_agents(count) -> None:
    whole = select_ego_truth(Street().snapshot("many", 9), 0, PROTOCOLS["global-sort"])
    less = NearestAgents(Street(), count).snapshot("many", 9)
    got = select_ego_truth(less, 0, PROTOCOLS["global-sort"])
    assert got.id.tolist() == whole.id.tolist() == [107, 103, 109, 104] and torch.equal(got.center, whole.center)
    for frame, pose in zip(less.frames, less.truth.world_from_agent.translation):
        assert pose[:2].tolist() == list(PLACES[frame.agent_id])


def test_scenarios_without_agents_enough_are_left_out() -> None:
    assert NearestAgents(Street(), 2).scenarios == ("few", "many")
    assert NearestAgents(Street(), 3).scenarios == ("many",)
    with pytest.raises(ConfigError, match="got 0"):
        NearestAgents(Street(), 0)
