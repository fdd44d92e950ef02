# SPDX-License-Identifier: Apache-2.0
"""Chapter of a report: which vehicles the ego alone misses, and which sender supplied them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from statistics import median

from manyeyes.viz.report import Chapter
from manyeyes.viz.scene_player import PlayerDetections, PlayerFrame, PlayerMethod, ScenePlayer

HEADINGS = ("sender", "supplied", "vehicles", "sender's points", "ego's points")
TITLE = "What the ego alone misses, and which agent supplied it"


@dataclass
class _Supply:
    """What one sender supplied: ids of vehicles, and returns of the sender and of the ego on them, one a vehicle and frame."""

    ids: list[int] = field(default_factory=list)
    own: list[int] = field(default_factory=list)
    ego: list[int] = field(default_factory=list)


def find_matched(detections: PlayerDetections, min_score: float) -> set[int]:
    """Return the rows of the true boxes that detections of at least a score match."""
    kept = (detections.boxes.score >= min_score).tolist()
    return {row for row, is_kept in zip(detections.truth_row.tolist(), kept) if row >= 0 and is_kept}


def find_supplier(frame: PlayerFrame, row: int, received: tuple[int, ...]) -> int:
    """Return the row of the agent with the most returns on a true box, of the ego and of those received; -1 where none has any."""
    usable = [k for k, agent in enumerate(frame.agents) if k == 0 or agent.agent_id in received]
    best = max(usable, key=lambda k: (int(frame.num_returns[row, k]), -k))
    return best if frame.num_returns[row, best] > 0 else -1


def make_help_chapter(player: ScenePlayer, method: str) -> Chapter | None:
    """Return the chapter on what a method finds that the ego alone misses, at the score thresholds of both.

    A vehicle is supplied by the agent with the most returns on it of the ego and of the agents whose messages were fused. None
    where no method without messages was run, or the named one was not.
    """
    helped = next((m for m in player.methods if m.name == method and m.needs_messages), None)
    row = -1 if helped is None else player.find_alone(helped)
    if helped is None or row < 0:
        return None
    alone = player.methods[row]
    supplies: dict[str, _Supply] = defaultdict(_Supply)
    total = num_alone = num_helped = num_lost = 0
    for frame, own, fused in zip(player.frames, alone.frames, helped.frames):
        before, after = find_matched(own, alone.min_score), find_matched(fused, helped.min_score)
        total, num_alone, num_helped = total + len(frame.truth), num_alone + len(before), num_helped + len(after)
        num_lost += len(before - after)
        for found in after - before:
            agent = find_supplier(frame, found, fused.received)
            supply = supplies[_name_supplier(frame, agent)]
            supply.ids.append(int(frame.truth.id[found]))
            supply.own.append(int(frame.num_returns[found, agent]) if agent >= 0 else 0)
            supply.ego.append(int(frame.num_returns[found, 0]))
    if not supplies:
        return None
    ranked = sorted(supplies.items(), key=lambda item: -len(item[1].ids))
    rows = [
        (name, f"{len(s.ids):,}", str(len(set(s.ids))), f"{median(s.own):.0f}", f"{median(s.ego):.0f}")
        for name, s in ranked
    ]
    text = _describe(alone, helped, (total, num_alone, num_helped, num_lost), ranked)
    return Chapter(TITLE, text, table=(HEADINGS, *rows))


def _name_supplier(frame: PlayerFrame, agent: int) -> str:
    if agent < 0:
        return "none: no returns"
    return "ego itself" if agent == 0 else frame.agents[agent].name


def _describe(
    alone: PlayerMethod, helped: PlayerMethod, counts: tuple[int, int, int, int], ranked: list[tuple[str, _Supply]]
) -> str:
    total, num_alone, num_helped, num_lost = counts
    supplied = sum(len(s.ids) for _, s in ranked)
    unseen = sum(count == 0 for _, s in ranked for count in s.ego)
    lost = f"{num_lost:,} that it finds alone are lost." if num_lost else "None that it finds alone is lost."
    return (
        f"Counted in pairs of a vehicle and a frame, of which there are {total:,}: {alone.name} finds {num_alone:,}, {helped.name} "
        f"{num_helped:,}. Of the {total - num_alone:,} that the ego misses alone, {supplied:,} are found with messages; on "
        f"{unseen:,} of these its LiDAR has no point above the wheels. {lost} A vehicle is supplied by the agent with the most "
        "LiDAR points on it."
    )
