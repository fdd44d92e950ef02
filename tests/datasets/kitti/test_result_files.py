# SPDX-License-Identifier: Apache-2.0
"""KITTI's result files: columns by hand, a round trip, and the camera of recordings that have none."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from manyeyes.datasets.kitti.result_files import (
    KittiCalibration,
    format_results,
    read_calibration,
    read_results,
    write_results,
)
from manyeyes.datatypes import LABELS, Boxes, RecordingError, Transform

AHEAD = KittiCalibration.of_lidar()
HEIGHT_M = 1.9


def boxes() -> Boxes:
    """All labels around the agent, with no symmetry."""
    n = len(LABELS)
    generator = torch.Generator().manual_seed(3)
    center = torch.randn(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([30.0, 12.0, 0.5])
    size = 0.5 + 4 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    yaw = 6 * torch.rand(n, generator=generator, dtype=torch.float64) - 3
    return Boxes.of(center, size, yaw, torch.linspace(0.9, 0.1, n, dtype=torch.float64), torch.arange(n))


def test_a_car_straight_ahead_by_hand() -> None:
    """Length 4, width 2, height 1.6, on the road 10 m ahead and 1 m to the left, heading ahead; the LiDAR is 1.9 m up.

    x = -1 (left), y = 1.9 (down to the road), z = 10; rotation_y of what heads along z is -pi/2; alpha adds atan(1 / 10).
    Its nearest corners are 8 m ahead and at y 1.9 and 0.3: 721.5377 * 1.9 / 8 + 172.854 = 344.22, ... * 0.3 / 8 ...
    """
    car = Boxes.of([[10.0, 1.0, 0.8]], [[4.0, 2.0, 1.6]], [0.0], [0.75]).to(torch.float64)
    (line,) = format_results(car, AHEAD, HEIGHT_M)
    words = line.split()
    assert words[:3] == ["Car", "-1", "-1"] and len(words) == 16
    alpha, left, top, right, bottom, *rest = map(float, words[3:])
    assert rest == pytest.approx([1.6, 2.0, 4.0, -1.0, 1.9, 10.0, -math.pi / 2, 0.75], abs=1e-5)
    assert alpha == pytest.approx(-math.pi / 2 + math.atan2(1, 10), abs=1e-5)
    assert left == pytest.approx(721.5377 * -2 / 8 + 609.5593, abs=0.01)
    assert right == pytest.approx(609.5593, abs=0.01)
    assert bottom == pytest.approx(721.5377 * 1.9 / 8 + 172.854, abs=0.01)
    assert top == pytest.approx(721.5377 * 0.3 / 12 + 172.854, abs=0.01)


def test_boxes_beside_and_behind_have_no_image_box_and_one_at_the_edge_is_clipped() -> None:
    some = Boxes.of(
        [[-10.0, 0, 0.8], [0.0, 30.0, 0.8], [3.0, 0.0, 0.8]], [[4.0, 2.0, 1.6]] * 3, [0.0] * 3, [0.5] * 3
    ).to(torch.float64)
    behind, beside, near = ([float(w) for w in line.split()[4:8]] for line in format_results(some, AHEAD, HEIGHT_M))
    assert behind == beside == [-1, -1, -1, -1]
    assert near == pytest.approx([0, 172.854 + 721.5377 * 0.3 / 5, 1241, 374], abs=0.01)


@pytest.mark.parametrize("turn", [0.0, 0.01])
def test_what_is_written_reads_back(tmp_path: Path, turn: float) -> None:
    lidar = KittiCalibration.of_lidar()
    calibration = KittiCalibration(
        lidar.camera_from_lidar @ Transform.from_xyz_yaw(-0.27, 0.02, 0.08, turn), lidar.projection
    )
    (tmp_path / "calib.txt").write_text(calibration.to_text())
    again = read_calibration(tmp_path / "calib.txt")
    write_results(tmp_path / "a.txt", boxes(), again, HEIGHT_M)
    found, true = read_results(tmp_path / "a.txt", calibration, HEIGHT_M), boxes()
    assert torch.allclose(found.center, true.center, atol=2e-4)
    assert torch.allclose(found.size, true.size, atol=1e-4)
    assert torch.allclose(found.score, true.score, atol=1e-6)
    assert torch.allclose((found.yaw - true.yaw).cos(), torch.ones(len(true), dtype=torch.float64), atol=1e-9)
    # KITTI has no buses and no motorcyclists.
    assert [LABELS[i] for i in found.label] == ["car", "van", "truck", "truck", "pedestrian", "cyclist", "cyclist"]


def test_a_frame_without_boxes_is_an_empty_file_and_the_best_come_first(tmp_path: Path) -> None:
    write_results(tmp_path / "none.txt", Boxes.empty(), AHEAD, HEIGHT_M)
    assert (tmp_path / "none.txt").read_text() == "" and len(read_results(tmp_path / "none.txt", AHEAD, HEIGHT_M)) == 0
    write_results(tmp_path / "all.txt", boxes()[torch.tensor([4, 1, 6])], AHEAD, HEIGHT_M)
    scores = [float(line.split()[15]) for line in (tmp_path / "all.txt").read_text().splitlines()]
    assert scores == sorted(scores, reverse=True)


def test_a_line_without_a_score_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("Car -1 -1 0 0 0 1 1 1.5 2 4 1 1.9 10 0\n")
    with pytest.raises(RecordingError, match="column 16 of line 1"):
        read_results(tmp_path / "a.txt", AHEAD, HEIGHT_M)
