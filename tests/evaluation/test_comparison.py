# SPDX-License-Identifier: Apache-2.0
"""Hand-made steps, counted, and differences of hand-made results."""

import io
import math
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from manyeyes.agents.agent import Perception
from manyeyes.agents.replay import ReplayStep, SentPackets
from manyeyes.datatypes import CLASSES, LABELS, AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.detection.accumulator import MethodResult, MetricAccumulator
from manyeyes.evaluation.detection.average_precision import PROTOCOLS
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import compare_methods
from manyeyes.evaluation.statistics.operating_point import OperatingThreshold
from manyeyes.viz.operating_table import (
    TITLE,
    OperatingRow,
    format_operating_lines,
    format_operating_note,
    make_operating_rows,
    make_operating_table,
)
from manyeyes.viz.table import HEADINGS, format_lines, make_row

PROTOCOL = PROTOCOLS["global-sort"]
SPOTS = ((10.0, 3.0), (20.0, -3.0), (30.0, 3.0), (40.0, -3.0))


def boxes(spots: tuple[tuple[float, float], ...]) -> Boxes:
    center = torch.tensor([[x, y, 0.8] for x, y in spots], dtype=torch.float64).reshape(-1, 3)
    size = torch.tensor([4.5, 1.9, 1.6], dtype=torch.float64).expand(len(spots), 3)
    score = torch.linspace(0.9, 0.6, max(1, len(spots)), dtype=torch.float64)[: len(spots)]
    return Boxes.of(center, size, torch.zeros(len(spots)).double(), score, id=torch.arange(len(spots)))


def step(method: str, scenario: str, index: int, found: int, sent_bytes: int, age_s: float = 0.1) -> ReplayStep:
    """Two agents at the origin, four cars, the first ``found`` of which are detected exactly."""
    cloud = PointCloud.of(torch.zeros(1, 3))
    frames = tuple(
        AgentFrame(100 + i, index, cloud, Transform.identity(), torch.zeros(3, 3, dtype=torch.float64))
        for i in range(2)
    )
    truth = GroundTruth(boxes(SPOTS), torch.ones(2, 4, dtype=torch.bool), Transform.identity(2))
    # The ego's own message is on the air too, and must not be counted as one that it receives.
    sent = tuple(
        SentPackets(a, (size,) if size else (), took)
        for a, size, took in ((100, 7 * sent_bytes, 0.01), (101, sent_bytes, 0.03))
    )
    ages = (age_s,) if sent_bytes else ()
    return ReplayStep(
        method, Snapshot(scenario, index, frames, truth), 0, Perception(boxes(SPOTS[:found]), ()), sent, ages, 0.05
    )


def accumulate(method: str, found: list[int], sent_bytes: int = 1000) -> MethodResult:
    """One scenario an entry of found, two frames each."""
    tally = MetricAccumulator(method, PROTOCOL)
    for number, hits in enumerate(found):
        for index in range(2):
            tally.add(step(method, f"s{number}", index, hits, sent_bytes))
    return tally.compute_results()[0]


def test_ap_bytes_age_and_times_are_those_of_the_steps() -> None:
    result = accumulate("late", [2, 4])
    assert result.ap[0].ap == pytest.approx(0.75) and result.ap[1].n_gt == 16
    assert result.intervals[0].value == pytest.approx(0.75) and result.intervals[0].num_scenarios == 2
    assert result.communication.bytes_per_message == 1000 and result.communication.num_messages == 4
    assert (result.age_ms, result.share_ms, result.perceive_ms) == pytest.approx((100, 20, 50))


def test_an_agent_that_sends_nothing_has_no_message_age_or_share_time() -> None:
    result = accumulate("no-fusion", [1], sent_bytes=0)
    assert result.communication.num_messages == 0 and result.communication.num_ego_frames == 2
    assert math.isnan(result.age_ms) and math.isnan(result.share_ms) and result.perceive_ms == pytest.approx(50)


def test_a_method_is_compared_with_every_other_at_both_thresholds() -> None:
    fused = [1, 1, 4, 1, 4]
    results = [accumulate("no-fusion", [2] * 5), accumulate("intermediate", fused)]
    half, seven = compare_methods(results, PROTOCOL)
    assert (half.description, half.metric, seven.metric) == ("intermediate - no-fusion", "AP@0.5", "AP@0.7")
    assert half.interval.value == pytest.approx(sum(fused) / 20 - 0.5) and half.interval.num_scenarios == 5
    assert half.interval.low < half.interval.value < half.interval.high


def test_without_the_method_there_is_nothing_to_compare() -> None:
    assert compare_methods([accumulate("no-fusion", [1]), accumulate("late", [2])], PROTOCOL) == ()
    assert compare_methods([accumulate("intermediate", [1])], PROTOCOL) == ()


def test_classes_are_results_of_their_own_and_compared_within_themselves() -> None:
    """The first two of four objects are pedestrians; "late" finds one object, "intermediate" three."""
    protocol = PROTOCOL.with_classes(CLASSES[:2])
    results = []
    for method, found in (("late", 1), ("intermediate", 3)):
        tally = MetricAccumulator(method, protocol)
        for index in range(2):
            tally.add(with_pedestrians(step(method, "s0", index, found, 1000)))
        results += tally.compute_results({"pedestrian": OperatingThreshold(0.85, "weights")})
    assert [(r.method, r.class_name, r.ap[0].n_gt, r.ap[0].ap) for r in results] == [
        ("late", "vehicle", 4, 0.0),
        ("late", "pedestrian", 4, 0.5),
        ("intermediate", "vehicle", 4, 0.5),
        ("intermediate", "pedestrian", 4, 1.0),
    ]
    assert {r.communication.num_ego_frames for r in results} == {2}
    points = [r.operating_point for r in results]
    assert [p.threshold.source for p in points if p] == ["default", "weights"] * 2
    assert [p.recall.value for p in points if p] == [0.0, 0.5, 0.5, 0.5]
    differences = compare_methods(results, protocol)
    assert [(d.description, d.metric, d.interval.value) for d in differences if d.metric == "AP@0.5"] == [
        ("intermediate - late, vehicle", "AP@0.5", 0.5),
        ("intermediate - late, pedestrian", "AP@0.5", 0.5),
    ]
    names, *lines = format_lines([make_row(r) for r in results])
    assert names[:2] == ("method", "class") and [line[1] for line in lines] == [r.class_name for r in results]
    assert format_operating_lines(make_operating_rows(results))[0][:3] == ("method", "class", "threshold")


def with_pedestrians(step: ReplayStep) -> ReplayStep:
    """The same step, its first two objects and boxes pedestrians."""
    truth = step.snapshot.truth
    assert truth is not None

    def relabel(boxes: Boxes) -> Boxes:
        return replace(boxes, label=torch.where(torch.arange(len(boxes)) < 2, LABELS.index("pedestrian"), 0))

    snapshot = replace(step.snapshot, truth=replace(truth, boxes=relabel(truth.boxes)))
    return replace(step, snapshot=snapshot, perception=Perception(relabel(step.boxes), ()))


def test_one_class_has_no_column() -> None:
    results = [accumulate("late", [2, 4])]
    assert format_lines([make_row(results[0])])[0] == HEADINGS
    rows = make_operating_rows(results)
    assert format_operating_lines(rows)[0][:2] == ("method", "threshold")
    assert format_operating_lines(rows)[1][:4] == ("late", "0.400", "1.000 [1.000, 1.000]", "0.750 [0.500, 1.000]")
    assert "chosen for no method" in format_operating_note(rows, 0.05) and "above 0.05" in format_operating_note(
        rows, 0.05
    )


def test_the_operating_table_of_one_drive_fits_80_columns_without_cut_words() -> None:
    """Intervals of one scenario are left out; the longest method is late-weighted-temporal."""
    exact = Interval(0.5, math.nan, math.nan, 0.95, 1)
    (row,) = make_operating_rows([accumulate("late", [2, 4])])
    point = replace(
        row.point,
        precision=exact,
        recall=exact,
        f_score=exact,
        false_alarms_per_frame=exact,
        duplicates_per_object=exact,
    )
    row = OperatingRow("late-weighted-temporal", "vehicle", point, (exact, exact))
    console = Console(width=80, file=io.StringIO())
    console.print(make_operating_table([row]))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    parts = (
        "method thresh- old preci- sion recall F false alarms /frame dupli- cates /object legacy AP@0.5 legacy AP@0.7"
    )
    heading = text[: text.index("─")].removeprefix(f"{TITLE}").split()
    assert sorted(heading) == sorted(parts.split())
    assert text.count("late-weighted-temporal") == 1 and max(map(len, text.splitlines())) <= 80
