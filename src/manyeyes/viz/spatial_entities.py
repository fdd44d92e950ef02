# SPDX-License-Identifier: Apache-2.0
"""Entities of one instant, ready to be logged: what ``viz.rerun_log`` and ``viz.foxglove_log`` write, each in its format.

Colours, labels, widths and the thinning of clouds are decided here, once for both.

| group | entity | content |
|---|---|---|
| `agents` | `AgentGroup` | claimed pose of each agent, its cloud in its frame |
| `corrections` | `LineGroup` | from claimed to corrected positions |
| `pose_errors` | `LineGroup` | from claimed to true positions |
| `ego/boxes` | `BoxGroup` | boxes, coloured by match with the truth, or by evidence |
| `truth` | `BoxGroup` | true boxes; missed ones in another colour |
| `links` | `LineGroup` | messages, wider by bytes, grey when late |
| `map` | `LineGroup` | map elements, an item a kind; again only where they changed |
| `plots` | `NumberGroup` | numbers by path |
| `events` | `TextGroup` | lines of text |
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import Boxes, Transform
from manyeyes.viz.spatial_frame import BOX_COLORS, Floats, ShownAgent, ShownBoxes, ShownLink, SpatialFrame

Rgb = tuple[int, int, int]
CloudColor = Literal["agent", "intensity"]
MAX_POINTS = 30_000
"""Points of a cloud that are logged; of longer ones every n-th."""
LATE_MS = 200.0
"""Age from which a message is drawn as late."""
LINK_HEIGHT_M = 2.5
"""Height of the lines of messages above the road, which clouds would hide."""
AGENT_COLORS: tuple[Rgb, ...] = (
    (90, 170, 255),
    (255, 170, 60),
    (120, 220, 120),
    (220, 120, 220),
    (240, 220, 90),
    (110, 220, 220),
)
MAP_COLORS: Mapping[str, Rgb] = {
    "divider": (240, 220, 120),
    "boundary": (90, 160, 240),
    "crossing": (120, 220, 140),
    "stop_line": (240, 100, 100),
}
"""Colours of map elements by kind."""
_GROUPS_WITHOUT_LABELS = frozenset({"truth", "map"})
"""Groups whose labels a viewer shows for a chosen item alone: their colours tell them apart."""
_OTHER_MAP_COLOR: Rgb = (200, 200, 90)
_LATE_COLOR, _LINK_COLOR, _CORRECTION_COLOR, _POSE_ERROR_COLOR = (
    (120, 120, 120),
    (255, 255, 255),
    (255, 90, 200),
    (150, 150, 150),
)
_INTENSITY_COLORS = np.array(((48, 18, 120), (40, 110, 220), (30, 190, 160), (170, 220, 60), (255, 245, 140)), float)
"""Colours of intensities 0, 1/4, 1/2, 3/4 and 1; others lie between."""
_BYTES_PER_CM, _MIN_LINK_M, _MAX_LINK_M = 500.0, 0.04, 0.6


@dataclass(frozen=True)
class LoggedCloud:
    """points: (N, 3) float32 in the frame of the agent. intensity: (N,) float32. colors: (N, 3) uint8."""

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    colors: NDArray[np.uint8]


@dataclass(frozen=True)
class LoggedAgent:
    """An agent: its name, claimed pose, colour, and cloud where it is known."""

    name: str
    world_from_agent: Transform
    color: Rgb
    cloud: LoggedCloud | None = None


@dataclass(frozen=True)
class AgentGroup:
    """All agents of an instant."""

    items: tuple[LoggedAgent, ...]


@dataclass(frozen=True)
class BoxGroup:
    """Boxes in the world: colors (N, 3) uint8, a label each, and pairs of text that a viewer shows for a chosen one."""

    group: str
    boxes: Boxes
    colors: NDArray[np.uint8]
    labels: tuple[str, ...]
    metadata: tuple[Mapping[str, str], ...]

    @property
    def shows_labels(self) -> bool:
        """Whether labels stand in the scene, and not only with a chosen box: those of detections."""
        return self.group not in _GROUPS_WITHOUT_LABELS


@dataclass(frozen=True)
class LoggedLines:
    """Polylines (K, 3) of one item in the world, metres. arrival_ns: of a message, if known."""

    name: str
    lines: tuple[Floats, ...]
    color: Rgb
    width_m: float = 0.1
    label: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)
    arrival_ns: int | None = None


@dataclass(frozen=True)
class LineGroup:
    """All lines of a group; they take the place of those that it had. are_arrows: each line is an arrow from its first point to its
    last.
    """

    group: str
    items: tuple[LoggedLines, ...]
    are_arrows: bool = False

    @property
    def shows_labels(self) -> bool:
        """Whether labels stand in the scene."""
        return self.group not in _GROUPS_WITHOUT_LABELS


@dataclass(frozen=True)
class NumberGroup:
    """Numbers by path of the plot, such as age_ms/3. colors: of those paths that stand for an agent, or for a kind of boxes."""

    values: Mapping[str, float]
    colors: Mapping[str, Rgb]


@dataclass(frozen=True)
class TextGroup:
    """Lines of text of an instant."""

    lines: tuple[str, ...]


Entity = AgentGroup | BoxGroup | LineGroup | NumberGroup | TextGroup


class SpatialDescription:
    """Describes frames, one after the other. cloud_color: points by agent, darker where their intensity is low, or by intensity."""

    def __init__(self, cloud_color: CloudColor = "agent") -> None:
        self.cloud_color: CloudColor = cloud_color
        self._map: Mapping[str, tuple[Floats, ...]] = {}
        self._filled = set[str]()
        self._rows = dict[int, int]()

    def describe(self, frame: SpatialFrame) -> Iterator[Entity]:
        """Yield the entities of one instant. Each replaces its group: lines that are gone are yielded as a group without items."""
        yield AgentGroup(tuple(self._make_agent(agent) for agent in frame.agents))
        corrected = [(agent, agent.corrected) for agent in frame.agents if agent.corrected is not None]
        true_poses = [(agent, agent.true_pose) for agent in frame.agents if agent.true_pose is not None]
        yield from self._make_lines("corrections", [_make_arrow(*pair, _CORRECTION_COLOR) for pair in corrected], True)
        yield from self._make_lines("pose_errors", [_make_arrow(*pair, _POSE_ERROR_COLOR) for pair in true_poses], True)
        yield _make_cubes("ego/boxes", frame.boxes)
        if frame.truth is not None:
            yield _make_cubes("truth", frame.truth)
        yield from self._make_lines("links", list(_make_links(frame.links, frame.agents)))
        if frame.map_lines is not self._map:
            ground_m = float(frame.agents[0].world_from_agent.translation[2]) if frame.agents else 0.0
            kinds = [_make_map(kind, lines, ground_m) for kind, lines in frame.map_lines.items()]
            yield from self._make_lines("map", kinds)
        self._map = frame.map_lines
        if frame.numbers:
            yield NumberGroup(frame.numbers, self._color_numbers(frame))
        if frame.events:
            yield TextGroup(frame.events)

    def _make_lines(self, group: str, items: Sequence[LoggedLines], are_arrows: bool = False) -> Iterator[LineGroup]:
        """Yield a group that has items, or had some."""
        if items or group in self._filled:
            self._filled.add(group)
            yield LineGroup(group, tuple(items), are_arrows)

    def _color_of(self, agent_id: int) -> Rgb:
        """Return the colour of an agent, which it keeps where others come and go."""
        return AGENT_COLORS[self._rows.setdefault(agent_id, len(self._rows)) % len(AGENT_COLORS)]

    def _make_agent(self, agent: ShownAgent) -> LoggedAgent:
        color = self._color_of(agent.agent_id)
        cloud = None
        if agent.points is not None:
            step = max(1, -(-len(agent.points) // MAX_POINTS))
            points = agent.points[::step]
            intensity = np.ones(len(points), np.float32) if agent.intensity is None else agent.intensity[::step]
            shades = shade_by_agent(color, intensity) if self.cloud_color == "agent" else shade_by_intensity(intensity)
            cloud = LoggedCloud(points, intensity, shades)
        return LoggedAgent(str(agent.agent_id), agent.world_from_agent, color, cloud)

    def _color_numbers(self, frame: SpatialFrame) -> dict[str, Rgb]:
        """Return the colours of the paths whose last part is an agent's id, or a kind of boxes."""
        colors: dict[str, Rgb] = {str(agent.agent_id): self._color_of(agent.agent_id) for agent in frame.agents}
        colors |= BOX_COLORS
        names = {path: path.rpartition("/")[2] for path in frame.numbers}
        return {path: colors[name] for path, name in names.items() if name in colors}


def shade_by_agent(color: Rgb, intensity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the colour of an agent, brighter by intensity (N,): (N, 3)."""
    light = 0.4 + 0.6 * np.clip(intensity, 0.0, 1.0)
    return (np.array(color)[None] * light[:, None]).astype(np.uint8)


def shade_by_intensity(intensity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return colours (N, 3) of intensities (N,), from dark blue (0) by green to light yellow (1)."""
    steps = np.linspace(0.0, 1.0, len(_INTENSITY_COLORS))
    light = np.clip(intensity, 0.0, 1.0)
    return np.stack([np.interp(light, steps, channel) for channel in _INTENSITY_COLORS.T], 1).astype(np.uint8)


def _make_arrow(agent: ShownAgent, to: Transform, color: Rgb) -> LoggedLines:
    claimed = agent.world_from_agent
    ends = np.stack((claimed.translation.double().numpy(), to.translation.double().numpy()))
    distance_m, turn_deg = measure_pose_difference(claimed, to)
    text = f"agent {agent.agent_id}: {distance_m:.2f} m, {turn_deg:.2f} deg"
    metadata = {"distance_m": f"{distance_m:.3f}", "turn_deg": f"{turn_deg:.3f}"}
    return LoggedLines(str(agent.agent_id), (ends,), color, label=text, metadata=metadata)


def measure_pose_difference(one: Transform, other: Transform) -> tuple[float, float]:
    """Return the horizontal distance of two poses in metres, and the angle between their headings in degrees."""
    offset = (other.translation.double() - one.translation.double())[:2]
    turn = float(other.yaw.double() - one.yaw.double())
    return float(offset.norm()), abs(np.degrees((turn + np.pi) % (2 * np.pi) - np.pi))


def _make_cubes(group: str, shown: ShownBoxes) -> BoxGroup:
    boxes = shown.boxes
    rows = list(zip(boxes.id.tolist(), boxes.score.tolist(), shown.kinds))
    numbers = [str(number) if number >= 0 else "" for number, _, _ in rows]
    return BoxGroup(
        group,
        boxes,
        np.array([BOX_COLORS[kind] for kind in shown.kinds], np.uint8).reshape(-1, 3),
        tuple(f"{name} {score:.2f} {kind}".lstrip() for name, (_, score, kind) in zip(numbers, rows)),
        tuple(
            {"score": f"{score:.2f}", "kind": kind, **({"id": name} if name else {})}
            for name, (_, score, kind) in zip(numbers, rows)
        ),
    )


def _make_links(links: Sequence[ShownLink], agents: Sequence[ShownAgent]) -> Iterator[LoggedLines]:
    """Yield the messages between agents whose poses are known."""
    above = np.array([0.0, 0.0, LINK_HEIGHT_M])
    positions = {agent.agent_id: agent.world_from_agent.translation.double().numpy() + above for agent in agents}
    for link in links:
        if link.sender in positions and link.receiver in positions:
            yield LoggedLines(
                f"{link.sender}-{link.receiver}",
                (np.stack((positions[link.sender], positions[link.receiver])),),
                _LATE_COLOR if link.age_ms > LATE_MS else _LINK_COLOR,
                min(max(_MIN_LINK_M, 0.01 * link.num_bytes / _BYTES_PER_CM), _MAX_LINK_M),
                f"{link.num_bytes} B, {link.age_ms:.0f} ms",
                {"bytes": str(link.num_bytes), "age_ms": f"{link.age_ms:.0f}"},
                link.arrival_ns,
            )


def _make_map(kind: str, lines: Sequence[Floats], ground_m: float) -> LoggedLines:
    """Return the elements of one kind, at the height of the road under the first agent."""
    lifted = tuple(np.column_stack((line, np.full(len(line), ground_m))) for line in lines)
    return LoggedLines(kind, lifted, MAP_COLORS.get(kind, _OTHER_MAP_COLOR), label=kind)
