# SPDX-License-Identifier: Apache-2.0
"""Claims against a real sweep (Argoverse 2): false cars on road that it sees, and the annotated vehicles; rays alone decide."""

from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.agents.level_frame import LevelledFrame
from manyeyes.agents.trust.claim_evidence import ClaimCheckConfig, check_claims
from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.interface import Evidence
from manyeyes.datasets.argoverse2 import Argoverse2Recording
from manyeyes.datatypes import Boxes
from manyeyes.evaluation.attacks.sight import MIN_CHECKING_RAYS, count_rays

LOG = Path(__file__).resolve().parents[4] / "shared" / "data" / "av2" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
pytestmark = pytest.mark.skipif(not LOG.is_dir(), reason=f"{LOG} is absent: the real sweeps are not in this project")
CAR = (4.5, 1.9, 1.6)


@pytest.fixture(scope="module")
def view():
    """The levelled frame of a sweep, and the annotated vehicles in it with 20 points or more within 60 m."""
    recording = Argoverse2Recording(LOG, gap=1)
    scenario = recording.scenarios[0]
    annotations = recording.annotations(scenario, recording.sweeps(scenario)[0])
    found = LevelledFrame.of(recording.snapshot(scenario, 0).frames[0])
    boxes = (
        annotations.boxes
        if found.levelled_from_agent is None
        else annotations.boxes.transform(found.levelled_from_agent)
    )
    seen = annotations.is_vehicle & (annotations.interior_points >= 20)
    return found.levelled, boxes[seen], boxes


def classify(frame, boxes: Boxes, sigma_m: float) -> list[int]:
    claims = Claims.of(7, boxes, np.full(len(boxes), sigma_m))
    (checked,), _ = check_claims(frame, np.zeros((0, 2)), (claims,), {}, ClaimCheckConfig(), np.zeros((0, 7)))
    return np.bincount(checked.kinds, minlength=5).tolist()


@pytest.mark.parametrize("height_m", [0.0, -2.6, -0.7, 0.7, 2.0])
def test_false_cars_on_real_road_are_refuted_at_whatever_height_they_are_stated(view, height_m):
    frame, _, known = view
    side = torch.arange(-38.0, 39.0, 2.0).double()
    xy = torch.cartesian_prod(side, side)
    xy = xy[(xy.norm(dim=1) > 8) & (xy.norm(dim=1) < 40)]
    xy = xy[torch.cdist(xy, known.center[:, :2].double()).amin(1) > 4.5]
    cars = Boxes.of(
        torch.cat((xy, torch.full((len(xy), 1), 0.8)), 1), torch.tensor(CAR).repeat(len(xy), 1), torch.zeros(len(xy))
    )
    counts, flat = count_rays(frame, cars), frame.points.xyz.double()
    flat = flat[flat[:, 2].abs() <= 0.3][:, :2]
    on_road = torch.cdist(xy, flat).amin(1).numpy() <= 2.5
    chosen = np.flatnonzero(on_road & (counts.num_crossing >= 2 * MIN_CHECKING_RAYS) & (counts.num_inside == 0))
    assert len(chosen) > 100
    raised = cars[torch.from_numpy(chosen)]
    raised = Boxes(**{**vars(raised), "center": raised.center + torch.tensor([0.0, 0.0, height_m])})
    assert classify(frame, raised, 0.1)[Evidence.REFUTED] >= 0.95 * len(chosen)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4), (0.3, 0.3)])
def test_no_annotated_vehicle_is_refuted_where_it_is_stated_up_to_four_tenths_of_a_metre_off(view, offset):
    frame, vehicles, _ = view
    stated = Boxes(**{**vars(vehicles), "center": vehicles.center + torch.tensor([*offset, 0.0])})
    found = classify(frame, stated, 0.2)
    assert len(vehicles) > 10 and found[Evidence.REFUTED] == 0 and found[Evidence.SUPPORTED] >= 0.5 * len(vehicles)
