# SPDX-License-Identifier: Apache-2.0
"""Figures of stored results for documents, by name: what each draws, from which results, and the command that writes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.viz.figure_svg import Panel, Theme, draw_level, draw_line, draw_point, draw_svg, split_form, spread_points
from manyeyes.viz.stored_tables import StoredResult

_STACK_ALPHAS = (1.0, 0.74, 0.54, 0.38, 0.25)
"""Opacity of the stages of a stack, one after the other; the last is that of all shorter stages together."""
_POINT_DISTANCE_LOG2 = 0.16
"""Between the centres of points of equal bytes, which stand side by side."""
_ATTACK_IN = 0.26
"""Height of the line of an attack, inches."""
_IOUS = ("AP@0.5", "AP@0.7")


@dataclass(frozen=True)
class StoredFigure:
    """A figure. text: what it shows. command: writes a result that it can be drawn from. height_in: of its axes, inches."""

    text: str
    command: str
    make: Callable[[Sequence[StoredResult]], list[Panel]]
    height_in: float = 3.1


def draw_figure(name: str, results: Sequence[StoredResult], theme: Theme) -> str:
    """Return the SVG text of a figure of stored results.

    Raises:
        ConfigError: a result does not hold what the figure shows.
    """
    figure = FIGURES[name]
    try:
        return draw_svg(figure.make(results), theme, figure.height_in)
    except (KeyError, TypeError, IndexError, ValueError) as error:
        files = ", ".join(str(stored.path) for stored in results)
        raise ConfigError(
            f"{files}: no result of the figure {name} ({error!r}); it needs one of: {figure.command}."
        ) from error


def _make_ap_bytes(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]
    names = list(dict.fromkeys(split_form(row["method"])[0] for row in rows))
    has_two_forms = len({split_form(row["method"])[1] for row in rows}) > 1
    has_level_with_memory = any(split_form(row["method"])[1] for row in rows if not row["bytes_per_message"])

    def label_of(method: str) -> str:
        name, has_memory = split_form(method)
        return f"{name} + memory" if has_two_forms and has_memory else name

    sent = [row for row in rows if row["bytes_per_message"]]
    exact = [math.log2(row["bytes_per_message"]) for row in sent]
    drawn = spread_points(exact, _POINT_DISTANCE_LOG2)
    xlabel = "log2(bytes per message)" + (", equal bytes side by side" if drawn != exact else "")

    def make_panel(field: str, title: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for row in (row for row in rows if not row["bytes_per_message"]):
                name, has_memory = split_form(row["method"])
                if has_memory or not has_level_with_memory:
                    draw_level(axes, row[field], theme.series_colour(names.index(name)), label_of(row["method"]))
            for row, x in zip(sent, drawn):
                name, has_memory = split_form(row["method"])
                colour, hollow = theme.series_colour(names.index(name)), has_two_forms and not has_memory
                draw_point(axes, x, row[field], colour, label_of(row["method"]), hollow=hollow)

        return Panel(title, xlabel, title, draw)

    return [make_panel("ap50", _IOUS[0]), make_panel("ap70", _IOUS[1])]


def _make_differences(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["differences"]]
    names = list(dict.fromkeys(row["description"] for row in rows))[::-1]

    def draw(axes: Any, theme: Theme) -> None:
        axes.axvline(0.0, color=theme.text, lw=1.0)
        for place, metric in enumerate(_IOUS):
            chosen = [row for row in rows if row["metric"] == metric]
            x = [row["interval"]["value"] for row in chosen]
            errors = [
                [max(0.0, row["interval"]["value"] - row["interval"]["low"]) for row in chosen],
                [max(0.0, row["interval"]["high"] - row["interval"]["value"]) for row in chosen],
            ]
            y = [names.index(row["description"]) + (0.15 if place == 0 else -0.15) for row in chosen]
            axes.errorbar(
                x,
                y,
                xerr=errors,
                color=theme.series_colour(place),
                marker="o",
                ms=5,
                capsize=2.5,
                ls="none",
                label=metric,
            )
        axes.set_yticks(range(len(names)), names)

    return [Panel("", "paired difference of AP, 95 % interval over scenarios", "", draw)]


def _make_robustness(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]
    fields = {
        "delay_s": "delay [s]",
        "heading_sigma_deg": "heading error [°]",
        "position_sigma_m": "position error [m]",
    }
    methods = list(dict.fromkeys(row["method"] for row in rows))

    def make_panel(field: str, label: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, method in enumerate(methods):
                mine = [row for row in rows if row["method"] == method and _is_along(row["perturbation"], field)]
                if len(mine) == 1:
                    draw_level(axes, mine[0]["ap"][1], theme.series_colour(place), method)
                elif mine:
                    x = [row["perturbation"][field] for row in mine]
                    draw_line(axes, x, [row["ap"][1] for row in mine], theme, place, method)

        return Panel("", label, _IOUS[1], draw)

    return [make_panel(field, label) for field, label in fields.items()]


def _is_along(perturbation: dict[str, float], field: str) -> bool:
    """Return whether nothing but one field of a disturbance differs from zero."""
    names = ("delay_s", "heading_sigma_deg", "position_sigma_m", "packet_loss")
    return not any(perturbation[name] for name in names if name != field)


def _make_num_agents(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]
    methods = [
        m
        for m in dict.fromkeys(row["method"] for row in rows)
        if any(r["num_agents"] > 1 for r in rows if r["method"] == m)
    ]

    def make_panel(title: str, ylabel: str, get: Callable[[dict[str, Any]], dict[str, float] | None]) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, method in enumerate(methods):
                mine = [(row["num_agents"], get(row)) for row in rows if row["method"] == method]
                found = [(float(n), interval) for n, interval in mine if interval is not None]
                draw_line(axes, [n for n, _ in found], [i for _, i in found], theme, place, method)
            axes.set_xticks(sorted({row["num_agents"] for row in rows}))

        return Panel(title, "agents", ylabel, draw)

    return [
        make_panel("Scenarios that have as many", _IOUS[0], lambda row: row["ap"][0]),
        make_panel("The same scenarios", f"gain of {_IOUS[0]} over one fewer", lambda row: row["gain_over_one_fewer"]),
    ]


def _make_risk_coverage(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["nulls"]]
    correctors = list(dict.fromkeys(row["corrector"] for row in rows))

    def make_panel(kind: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, corrector in enumerate(correctors):
                for row in (r for r in rows if r["corrector"] == corrector and r["kind"] == kind):
                    risk = row["risk_by_coverage"]
                    points = [((i + 1) / len(risk), v) for i, v in enumerate(risk) if v is not None]
                    if points:
                        axes.plot(*zip(*points), color=theme.series_colour(place), marker=".", lw=1.6, label=corrector)
            axes.set_xlim(0.0, 1.0)
            axes.set_ylim(-0.03, 1.0)

        return Panel(f"Null pairs: {kind}", "coverage", "risk (wrong of answered)", draw)

    return [make_panel(kind) for kind in dict.fromkeys(row["kind"] for row in rows)]


def _make_acceptance_roc(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["roc"]]
    numbers = list(dict.fromkeys(row["num_common"] for row in rows))

    def make_panel(boxes: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for row in (r for r in rows if r["boxes"] == boxes):
                is_vote = row["score"] == "voting"
                label = f"{row['num_common']} common, {row['score']}"
                colour = theme.series_colour(numbers.index(row["num_common"]))
                axes.plot(
                    row["null_rate"], row["success"], color=colour, ls="--" if is_vote else "-", lw=1.6, label=label
                )
            axes.set_xscale("log")
            axes.set_ylim(0.0, 1.0)

        return Panel(f"{boxes} boxes", "null pairs answered wrongly", "true pairs within 1 m and 1°", draw)

    return [make_panel(boxes) for boxes in dict.fromkeys(row["boxes"] for row in rows)]


def _make_pose_noise(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [
        row
        for stored in results
        for row in stored.result["rows"]
        if row["common_range"] is None and row["trial"]["noise"]["kind"] == "gaussian"
    ]
    correctors = list(dict.fromkeys(row["trial"]["corrector"] for row in rows))

    def make_panel(title: str, ylabel: str, get: Callable[[dict[str, Any]], float | None]) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, corrector in enumerate(correctors):
                mine = [(r["trial"]["noise"]["sigma_m"], get(r)) for r in rows if r["trial"]["corrector"] == corrector]
                points = sorted((x, y) for x, y in mine if y is not None)
                axes.plot(*zip(*points), color=theme.series_colour(place), marker="o", ms=4, lw=1.6, label=corrector)
            axes.set_ylim(bottom=0.0)

        return Panel(title, "sigma of the prior pose [m]", ylabel, draw)

    return [
        make_panel("Estimated within 1 m and 1°", "fraction of pairs", lambda row: row["score"]["success_rate"][0]),
        make_panel(
            "Displacement of the objects", "mean displacement [m]", lambda row: row["score"]["mean_displacement_m"]
        ),
    ]


def _make_ap_pose_noise(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]
    shown = [
        row
        for row in rows
        if row["method"] != "no-fusion" and row["level"]["position_sigma_m"] == row["level"]["heading_sigma_deg"]
    ]
    fusions = list(dict.fromkeys((row["method"], row["corrector"]) for row in shown))
    is_single = len({row["method"] for row in shown}) == 1

    def make_panel(iou: int) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, (method, corrector) in enumerate(fusions):
                mine = [row for row in shown if (row["method"], row["corrector"]) == (method, corrector)]
                x = [row["level"]["position_sigma_m"] for row in mine]
                label = corrector if is_single else f"{method}, {corrector}"
                draw_line(axes, x, [row["ap"][iou] for row in mine], theme, place, label)

        return Panel("", "sigma of the prior pose [m and °]", _IOUS[iou], draw)

    return [make_panel(iou) for iou in range(len(_IOUS))]


def _make_reliability(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]

    def draw(axes: Any, theme: Theme) -> None:
        axes.plot([0.0, 1.0], [0.0, 1.0], color=theme.text, lw=1.0, ls="--", label="calibrated")
        for place, row in enumerate(rows):
            x = [part["mean_score"] for part in row["bins"]]
            draw_line(axes, x, [part["correct"] for part in row["bins"]], theme, place, row["method"])

    return [Panel("", "score", "fraction of correct boxes, IoU 0.5", draw)]


def _make_map_observations(results: Sequence[StoredResult]) -> list[Panel]:
    # Places of another shape have groups of their own, in tables alone.
    rows = [row for stored in results for row in stored.result["summaries"] if row["group"].endswith(" observations")]
    methods = list(dict.fromkeys(row["method"] for row in rows))

    def draw(axes: Any, theme: Theme) -> None:
        for place, method in enumerate(methods):
            mine = [row for row in rows if row["method"] == method]
            x = [float(row["group"].split()[0]) for row in mine]
            draw_line(axes, x, [row["mean_ap"] for row in mine], theme, place, method)
        ticks = sorted({float(row["group"].split()[0]) for row in rows})
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)

    return [Panel("Crossings and dividers, 95 % intervals", "observations", "mAP (Chamfer-exact)", draw)]


def _make_latency_stack(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"] if row["drive"] is not None][::-1]
    times = [row["present_stages_ms"] for row in rows]

    def draw(axes: Any, theme: Theme) -> None:
        left = [0.0] * len(rows)
        for place, part in enumerate(("share", "perceive")):
            for alpha, (label, stages) in zip(_STACK_ALPHAS, _group_stages(times, part), strict=False):
                widths = [sum(of_row.get(stage, 0.0) for stage in stages) for of_row in times]
                axes.barh(
                    range(len(rows)), widths, 0.62, left=left, color=theme.series_colour(place), alpha=alpha, label=label
                )  # fmt: skip
                left = [a + b for a, b in zip(left, widths)]
        names = [f"{row['case']},\n{row['weights']}, {row['agents']:g} agents" for row in rows]
        axes.set_yticks(range(len(rows)), names)

    return [Panel("One step of an agent, by stage", "CPU time on one core [ms]", "", draw)]


def _group_stages(times: Sequence[dict[str, float]], part: str) -> list[tuple[str, list[str]]]:
    """Return labels and stages of one part of a step, the longest first; what has no opacity of its own is the last label."""
    longest = {stage: max(t.get(stage, 0.0) for t in times) for of_row in times for stage in of_row}
    stages = sorted((stage for stage in longest if stage.startswith(f"{part}:")), key=lambda s: (-longest[s], s))
    if len(stages) <= len(_STACK_ALPHAS):
        return [(stage, [stage]) for stage in stages]
    rest = f"{part}: other"
    named = [stage for stage in stages if stage != rest][: len(_STACK_ALPHAS) - 1]
    return [*((stage, [stage]) for stage in named), (rest, [stage for stage in stages if stage not in named])]


def _make_map_cost(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["costs"]]
    ways = list(dict.fromkeys(row["way"] for row in rows))
    labels = {"tiles": "tiles of tokens", "dense": "one dense BEV grid"}

    def make_panel(field: str, ylabel: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, way in enumerate(ways):
                mine = sorted((row["cells"] / 1000, row[field]) for row in rows if row["way"] == way)
                axes.plot(
                    *zip(*mine), color=theme.series_colour(place), marker="o", ms=4, lw=1.6, label=labels.get(way, way)
                )
            axes.set(xlim=(0.0, None), ylim=(0.0, None))

        return Panel("", "cells of the map (thousands)", ylabel, draw)

    return [make_panel("seconds", "CPU time [s]"), make_panel("peak_mib", "peak memory [MiB]")]


def _make_attacks(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"] if row["num_malicious"] == 1]
    methods = list(dict.fromkeys(row["method"] for row in rows if row["method"] != "no-fusion"))
    return [_make_attacked_method(rows, method, title=method if len(methods) > 1 else "") for method in methods]


def _make_attacked_method(rows: Sequence[dict[str, Any]], method: str, title: str) -> Panel:
    alone = [row for row in rows if row["method"] == "no-fusion" and row["attack"] == "none"]
    played = [row for row in rows if row["method"] == method]
    attacks = list(dict.fromkeys(row["attack"] for row in played))[::-1]
    # The oracle leaves malicious agents out, whatever they send: without attack, its result is that under every attack.
    oracle = [row for row in played if row["defence"] == "oracle" and row["attack"] == "none"]
    defences = list(dict.fromkeys(row["defence"] for row in played if row["defence"] != "oracle"))

    def draw(axes: Any, theme: Theme) -> None:
        for place, defence in enumerate(defences):
            mine = [row for row in played if row["defence"] == defence]
            values = [row["ap"][0]["value"] for row in mine]
            errors = [
                [max(0.0, row["ap"][0]["value"] - row["ap"][0]["low"]) for row in mine],
                [max(0.0, row["ap"][0]["high"] - row["ap"][0]["value"]) for row in mine],
            ]
            y = [attacks.index(row["attack"]) + 0.22 * ((len(defences) - 1) / 2 - place) for row in mine]
            axes.errorbar(
                values, y, xerr=errors, color=theme.series_colour(place), marker="o", ms=4, capsize=2, ls="none",
                label=f"defence: {defence}",
            )  # fmt: skip
        levels = (("ego alone", alone, "--"), ("oracle: malicious agent left out", oracle, ":"))
        for label, level, style in ((label, level, style) for label, level, style in levels if level):
            axes.axvline(level[0]["ap"][0]["value"], color=theme.text, lw=1.2, ls=style, label=label)
        axes.set_yticks(range(len(attacks)), ["no attack" if attack == "none" else attack for attack in attacks])

    return Panel(title, f"{_IOUS[0]}, 95 % interval over scenarios", "", draw, _ATTACK_IN * len(attacks))


def _make_malicious_agents(results: Sequence[StoredResult]) -> list[Panel]:
    rows = [row for stored in results for row in stored.result["rows"]]
    fractions = sorted({row["fraction"] for row in rows})
    offsets = sorted({row["offset_m"] for row in rows})

    def make_panel(attack: str) -> Panel:
        def draw(axes: Any, theme: Theme) -> None:
            for place, fraction in enumerate(fractions):
                mine = [row for row in rows if row["attack"] == attack and row["fraction"] == fraction]
                found = [{**row["found"], "value": row["found"]["successes"] / row["found"]["total"]} for row in mine]
                label = f"{fraction:.0%} of agents malicious"
                draw_line(axes, [row["offset_m"] for row in mine], found, theme, place, label)
            axes.set_xscale("log")
            axes.set_xticks(offsets, [f"{offset:g}" for offset in offsets])
            axes.set_xticks([], minor=True)
            axes.set_ylim(0.0, 1.02)

        return Panel(attack, "offset [m]", "malicious agents found at 5 % false", draw)

    return [make_panel(attack) for attack in dict.fromkeys(row["attack"] for row in rows)]


_EVALUATE = "manyeyes evaluate --data data/carla-towns-small --split test"
FIGURES = {
    "ap-bytes": StoredFigure("AP against log2(bytes per message), by method", _EVALUATE, _make_ap_bytes),
    "differences": StoredFigure("Paired differences of AP with 95 % intervals", _EVALUATE, _make_differences),
    "robustness": StoredFigure(
        "AP against delay, heading error and position error",
        "manyeyes study robustness --data data/carla-towns-small --split test",
        _make_robustness,
    ),
    "num-agents": StoredFigure(
        "AP against the number of agents",
        "manyeyes study num-agents --data data/carla-towns-small --split test",
        _make_num_agents,
    ),
    "reliability": StoredFigure(
        "Fraction of correct boxes against their score",
        "python benchmarks/reliability.py --data data/carla-towns-small --split test",
        _make_reliability,
    ),
    "attacks": StoredFigure(
        "AP under attacks, by defence",
        "manyeyes study attacks --data data/carla-towns-small --split val",
        _make_attacks,
    ),
    "risk-coverage": StoredFigure(
        "Risk against coverage of pose correctors without a prior",
        "manyeyes study pose-estimation --data data/carla-towns-small --split val",
        _make_risk_coverage,
    ),
    "acceptance-roc": StoredFigure(
        "True pairs that are answered right against null pairs that are answered wrongly",
        "python -m benchmarks.pose_verifier",
        _make_acceptance_roc,
    ),
    "pose-noise": StoredFigure(
        "Pose correctors against the noise of the prior pose",
        "manyeyes study pose-estimation --data data/carla-towns-small --split val",
        _make_pose_noise,
    ),
    "ap-pose-noise": StoredFigure(
        "AP against the noise of prior poses, by corrector and fusion",
        "manyeyes study pose-noise-ap --data data/carla-towns-small --split test",
        _make_ap_pose_noise,
        height_in=4.6,
    ),
    "map-observations": StoredFigure(
        "mAP of fused maps against the number of observations", "manyeyes study fusion", _make_map_observations
    ),
    "malicious-agents": StoredFigure(
        "Malicious mapping agents found at 5 % false positives against the offset of what they observe",
        "manyeyes study malicious-agents",
        _make_malicious_agents,
    ),
    "latency-stack": StoredFigure("CPU time of a step by stage", "python benchmarks/step.py", _make_latency_stack),
    "map-cost": StoredFigure(
        "CPU time and memory of map prediction against map size", "python benchmarks/map_cost.py", _make_map_cost
    ),
}
"""Figures that a document can name, by their names."""
