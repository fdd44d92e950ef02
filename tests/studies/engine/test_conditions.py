# SPDX-License-Identifier: Apache-2.0
"""Names of cells hold all that their numbers depend on; differences of cells are paired."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.replay import ReplayConfig
from manyeyes.comms.channel import channel_preset
from manyeyes.datasets.odometry_drift import OdometryDrift
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.average_precision import PROTOCOLS, FrameMatch
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.detection.communication import summarize_messages
from manyeyes.evaluation.statistics.bootstrap import bootstrap
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.registry import POSE_CORRECTORS
from manyeyes.studies.engine.cells import CellStore, hash_recording
from manyeyes.studies.engine.conditions import BusVolume, MethodMatches, ResultGrid, make_cell


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    with torch.random.fork_rng():
        for seed in (0, 1):
            torch.manual_seed(seed)
            checkpoint.save(Detector(COSTR_TINY), folder / f"{seed}.safetensors", {})
    return folder


def test_a_result_file_is_named_by_all_that_its_numbers_depend_on(weights, tmp_path) -> None:
    def path(config: BenchmarkConfig, method: str, recording_hash: str) -> Path:
        return CellStore(tmp_path).path(make_cell(config, method, recording_hash))

    base = BenchmarkConfig(str(weights / "0.safetensors"), ("no-fusion", "late"))
    late = replace(channel_preset("ideal"), base_latency_s=0.1)
    others = [
        replace(base, weights=str(weights / "1.safetensors")),
        replace(base, protocol="opencood"),
        replace(base, frame_stride=2),
        replace(base, num_agents=2),
        replace(base, pose_noise=PoseNoise(sigma_xy_m=0.2)),
        replace(base, pose_noise=PoseNoise(sigma_xy_m=0.2, seed=1)),
        replace(base, pose_noise=PoseNoise(sigma_xy_m=0.2, claim="true")),
        replace(base, pose_noise=PoseNoise(sigma_xy_m=0.2, in_time="constant")),
        replace(base, odometry_drift=OdometryDrift()),
        *(replace(base, replay=ReplayConfig(**changed)) for changed in (
            {"channel": late}, {"channel": late.with_loss(0.1)}, {"token_encoding": "int8"}, {"budget_bytes": 99},
            {"channel_budget_bytes": 999},
            {"seed": 1}, {"all_egos": True}, {"warmup_frames": 3}, {"latency_budget_s": 0.1},
        )),
    ]  # fmt: skip
    paths = [path(config, "late", "data") for config in (base, *others)]
    paths += [path(base, "no-fusion", "data"), path(base, "late", "other data")]
    assert len(set(paths)) == len(paths) == 21
    # Neither the company of other methods nor where the same weights lie makes a difference.
    (tmp_path / "copy.safetensors").write_bytes((weights / "0.safetensors").read_bytes())
    moved = replace(base, weights=str(tmp_path / "copy.safetensors"), methods=("late", "early"))
    assert path(moved, "late", "data") == paths[0]


CORRECTOR = """
from manyeyes.pose.registry import load_corrector, register_pose_corrector

@register_pose_corrector("their-corrector")
def correct(ego, other, prior):
    return load_corrector("identity")(ego, other, prior)
"""


def test_the_source_of_a_third_party_corrector_counts(weights, tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(POSE_CORRECTORS, "_items", POSE_CORRECTORS.load_all())
    (tmp_path / "their_corrector.py").write_text(CORRECTOR)
    importlib.import_module("their_corrector")
    replay = ReplayConfig(pose_correction=PoseCorrection("their-corrector"))
    config = BenchmarkConfig(str(weights / "0.safetensors"), ("late",), replay=replay)
    before = make_cell(config, "late", "data")
    assert make_cell(config, "late", "data") == before
    (tmp_path / "their_corrector.py").write_text(CORRECTOR + "LATER = True\n")
    assert make_cell(config, "late", "data").key != before.key
    sys.modules.pop("their_corrector")


class OneFrame:
    """A recording of one snapshot."""

    def __init__(self, x: float = 0.0, names: tuple[str, ...] = ("a",)) -> None:
        self.x, self.scenarios = x, names

    def length(self, scenario: str) -> int:
        return 1

    def eval_indices(self, scenario: str) -> range:
        return range(1)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (5,)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        cloud = PointCloud.of(torch.ones(1, 3))
        return Snapshot(scenario, index, (AgentFrame.of(cloud, Transform.from_xyz_yaw(self.x, 0.0)),))


def test_another_recording_has_another_digest() -> None:
    assert hash_recording(OneFrame()) == hash_recording(OneFrame())
    digests = [hash_recording(r) for r in (OneFrame(), OneFrame(0.1), OneFrame(0.0, ("b",)), OneFrame(0, ("a", "b")))]
    assert len(set(digests)) == 4


def make_result(method: str, hits: tuple[int, ...]) -> MethodMatches:
    """Four true boxes in a frame of each scenario, so many of them found, and one false alarm behind."""
    frames = []
    for number, found in enumerate(hits):
        rows = torch.tensor([*range(found), -1])
        frames.append(FrameMatch(f"s{number}", 0, torch.linspace(0.9, 0.5, found + 1).double(), rows, 4))
    speeds = tuple(torch.tensor([0.0, 0.0, 9.0, 9.0]) for _ in hits)
    return MethodMatches(
        method,
        (tuple(frames), tuple(frames)),
        speeds,
        summarize_messages([], len(hits)),
        BusVolume(0, 0.0, 0),
        0.0,
        len(hits),
    )


def test_differences_are_paired_and_may_be_over_some_scenarios_alone() -> None:
    protocol = PROTOCOLS["global-sort"]
    results = {("x", "a"): make_result("a", (4, 3, 2, 4)), ("x", "b"): make_result("b", (2, 2, 1, 2))}
    grid = ResultGrid(results, protocol)
    a, b = (results[key].matches[0] for key in results)
    difference = bootstrap(a, protocol=protocol).paired_difference(bootstrap(b, protocol=protocol))
    assert grid.paired_difference(("x", "a"), ("x", "b"), 0) == difference
    assert grid.difference_pair(("x", "a"), ("x", "b")) == (difference, difference)
    assert grid.difference_pair(("x", "a"), ("y", "b")) is grid.difference_pair(("y", "b"), ("x", "a")) is None
    comparison = grid.compare("a - b", ("x", "a"), ("x", "b"), 1)
    assert (comparison.metric, comparison.interval) == ("AP@0.7", difference)
    assert grid.bootstrap_ap(("x", "a"), 0, (5.0, 99.0)).value < grid.bootstrap_ap(("x", "a"), 0, (0.0, 0.1)).value
    some = {"s0", "s3"}
    kept = [match for match in a if match.scenario in some]
    assert grid.bootstrap_ap(("x", "a"), 1, scenarios=some) == bootstrap(kept, protocol=protocol).interval()
    assert grid.scenarios_of(("x", "a")) == {"s0", "s1", "s2", "s3"}


def test_answers_of_methods_are_compared_though_their_truth_differs() -> None:
    """Methods answer at times of their own: in b's answers a vehicle has left the range."""
    a, b = make_result("a", (4, 3, 2, 4)), make_result("b", (2, 2, 1, 2))
    fewer = tuple(replace(frame, n_gt=3) for frame in b.matches[0])
    results = {
        ("x", "a"): replace(a, answer_matches=a.matches, answer_ms=120.0),
        ("x", "b"): replace(b, answer_matches=(fewer, fewer)),
    }
    grid = ResultGrid(results, PROTOCOLS["global-sort"])
    assert grid.answer_ap_pair(("x", "a"))[0] == grid.ap_pair(("x", "a"))[0]
    compared = grid.compare_answers("a - b", ("x", "a"), ("x", "b"), 1)
    values = [grid.answer_ap_pair(key)[1].value for key in results]
    assert compared.metric == "AP@0.7 at the answer" and compared.interval.value == pytest.approx(values[0] - values[1])
    assert values[1] > grid.ap_pair(("x", "b"))[1].value
