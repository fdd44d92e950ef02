# SPDX-License-Identifier: Apache-2.0
"""A plain folder of clouds with a table of poses for each agent: the layout for data that is in no published one.

``<scenario>/<agent>/poses.csv`` and ``<scenario>/<agent>/clouds/<timestamp_ns>.bin`` (``.pcd``, ``.npz``, ``.npy``); an agent is
named by its number, a roadside unit by a negative one. One agent alone may lie in the scenario's folder itself. Columns of
``poses.csv``: ``timestamp_ns``, ``x``, ``y``, ``z`` and ``qw``, ``qx``, ``qy``, ``qz`` or ``roll``, ``pitch``, ``yaw``
(radians, R = Rz Ry Rx): world from LiDAR, right-handed, metres. Optional: ``cloud`` (a file in the agent's folder),
``speed_mps``, ``sensor_height_m``, and
``body_x``, ``body_y``, ``body_length``, ``body_width``, ``body_height`` (of the vehicle's own body, its middle ahead and to the
left of the LiDAR).

``boxes.csv`` beside it holds true boxes that the agent observes, in the world: ``timestamp_ns``, ``id``, ``label``, ``x``, ``y``,
``z`` (the middle), ``length``, ``width``, ``height``, ``yaw``, and optionally ``vx``, ``vy``; an object has one id in all tables.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.box_table import BoxTable
from manyeyes.datasets.formats.point_file import SUFFIXES, read_cloud
from manyeyes.datasets.ground_height import estimate_sensor_height
from manyeyes.datasets.lidar_frame import make_body, make_lidar_frame, merge_listed_boxes, rotation_of_quaternion
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.registry import register_dataset
from manyeyes.datasets.tables import Table
from manyeyes.datatypes import AgentBody, AgentFrame, RecordingError, Snapshot, Transform

POSES, BOXES, CLOUDS = "poses.csv", "boxes.csv", "clouds"
MAX_OFFSET_NS = 50_000_000
"""Sweeps of two agents belong to one snapshot if their times differ by no more."""
_AGENT = re.compile(r"-?\d+")
_POLE_RANGE_M = 40.0
_BODY = ("body_x", "body_y", "body_length", "body_width", "body_height")


def _is_agent(folder: Path) -> bool:
    return (folder / POSES).is_file() and (folder / CLOUDS).is_dir()


def _list_folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _is_scenario(folder: Path) -> bool:
    return _is_agent(folder) or any(_is_agent(p) and _AGENT.fullmatch(p.name) for p in _list_folders(folder))


def contains_agents(path: Path) -> bool:
    """Return whether a folder is an agent's, a scenario, or holds some, or splits with some, by names alone."""
    below = ("", "*/", "*/*/", "*/*/*/")
    return any(_is_agent(poses.parent) for place in below for poses in path.glob(f"{place}{POSES}"))


@dataclass(frozen=True)
class AgentTable:
    """One agent's rows in the order of time: clouds (N), timestamp_ns (N,), poses of the LiDAR in the world (N, 3, 3), (N, 3).

    speed_mps, height_m: (N,) or None where the table does not have them. boxes: what the agent lists.
    """

    id: int
    folder: Path
    clouds: tuple[Path, ...]
    timestamp_ns: np.ndarray
    world_from_lidar: Transform
    speed_mps: np.ndarray | None
    height_m: np.ndarray | None
    boxes: BoxTable
    has_boxes: bool
    body: AgentBody | None


@register_dataset(
    "folder",
    matches=contains_agents,
    layout=f"<scenario>/<agent>/{POSES} and {CLOUDS}/<timestamp_ns>.bin, .pcd, .npz or .npy",
)
class FolderRecording(RecordingReader):
    """Scenarios of plain folders under a root: several, in a split, or one.

    The ego is the agent with the lowest number from 0 on, its rows are the snapshots; of every other agent the sweep within
    MAX_OFFSET_NS of the ego's that is nearest in time, if there is one. Rows whose cloud is absent are left out and named in
    ``missing_summary``. Tables are read when the recording is opened.
    """

    def __init__(self, root: Path | str, split: str | None = None, *, drop_nan: bool = False) -> None:
        self.root, self._drop_nan = Path(root), drop_nan
        folder = self.root if split is None else self.root / split
        if not folder.is_dir():
            raise RecordingError(f"{folder}: no such folder, expected scenarios; check the path and the split.")
        inside = [p for p in _list_folders(folder) if _is_scenario(p)]
        self._folders = {p.name: p for p in ([folder] if _is_scenario(folder) else inside)}
        if not self._folders:
            splits = [p.name for p in _list_folders(folder) if any(_is_scenario(q) for q in _list_folders(p))]
            first = f"it has splits: {', '.join(splits)}; name one" if splits else "check the path"
            raise RecordingError(f"{folder}: no scenario with {POSES} and {CLOUDS} in it; {first}.")
        problems: list[str] = []
        missing: list[FileProblem] = []
        self._agents = {n: tuple(_read_agents(p, n, problems, missing)) for n, p in self._folders.items()}
        self._agents = {name: agents for name, agents in self._agents.items() if agents}
        self.scenarios = tuple(self._agents)
        self.missing_summary, self.missing_files = tuple(problems), tuple(missing)
        if not self._agents:
            raise RecordingError(
                f"{folder}: no agent has a cloud; {problems[0] if problems else 'the tables are empty'}."
            )
        self._heights: dict[Path, float] = {}

    def length(self, scenario: str) -> int:
        """Return how many sweeps the ego has."""
        return len(self._of(scenario)[0].clouds)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents, the ego first and roadside units last."""
        return tuple(agent.id for agent in self._of(scenario))

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Read the ego's sweep and those of others at its time; without truth where no agent has a table of boxes."""
        require_index(self, scenario, index)
        agents = self._of(scenario)
        now = int(agents[0].timestamp_ns[index])
        rows = [(agent, row) for agent in agents if (row := _nearest(agent, now)) is not None]
        rows[0] = (agents[0], index)
        frames = tuple(self._frame(agent, row) for agent, row in rows)
        listed = [agent.boxes.at(int(agent.timestamp_ns[row]), agent.id) for agent, row in rows]
        has_truth = any(agent.has_boxes for agent in agents)
        return Snapshot(scenario, index, frames, merge_listed_boxes(listed, frames) if has_truth else None)

    def _of(self, scenario: str) -> tuple[AgentTable, ...]:
        if scenario not in self._agents:
            require_index(self, scenario, 0)
        return self._agents[scenario]

    def _frame(self, agent: AgentTable, row: int) -> AgentFrame:
        return make_lidar_frame(
            read_cloud(agent.clouds[row], self._drop_nan),
            agent.world_from_lidar[row],
            self._height(agent, row),
            agent.id,
            int(agent.timestamp_ns[row]),
            0.0 if agent.speed_mps is None else float(agent.speed_mps[row]),
            agent.id < 0,
            agent.body,
        )

    def _height(self, agent: AgentTable, row: int) -> float:
        """Return metres from the road up to the LiDAR: stated, or found in the agent's first cloud so that it stays the same."""
        if agent.height_m is not None:
            return float(agent.height_m[row])
        if agent.folder not in self._heights:
            xyz = read_cloud(agent.clouds[0], self._drop_nan).xyz
            self._heights[agent.folder] = estimate_sensor_height(xyz, _POLE_RANGE_M if agent.id < 0 else 25.0)
        return self._heights[agent.folder]


def _read_agents(folder: Path, scenario: str, problems: list[str], missing: list[FileProblem]) -> Sequence[AgentTable]:
    """Read the tables of a scenario's agents, the ego first; what is absent is added to problems and to missing."""
    if _is_agent(folder):
        folders = [(0, folder)]
    else:
        inside = [p for p in _list_folders(folder) if _is_agent(p)]
        unnamed = [p for p in inside if not _AGENT.fullmatch(p.name) or len(p.name) > 9]
        if unnamed:
            raise RecordingError(
                f"{unnamed[0]}: an agent's folder is named by a number; rename it, roadside units below 0."
            )
        folders = sorted(((int(p.name), p) for p in inside), key=lambda pair: (pair[0] < 0, abs(pair[0])))
    agents = []
    for id, place in folders:
        agent = _read_agent(place, id, scenario, problems, missing)
        if len(agent.clouds):
            agents.append(agent)
    return agents


def _read_agent(folder: Path, id: int, scenario: str, problems: list[str], missing: list[FileProblem]) -> AgentTable:
    table = Table.read(folder / POSES)
    table.require("timestamp_ns", "x", "y", "z")
    time = table.integers("timestamp_ns")
    clouds = _find_clouds(folder, table, time)
    absent = [path for path in clouds if not path.is_file()]
    if absent:
        problems.append(
            f"{folder}: {len(absent)} of {len(clouds)} clouds are not there, the first is {absent[0].name}; left out"
        )
        missing += [FileProblem(path, "missing", scenario, f"{POSES} has a row of it") for path in absent]
    kept = np.array([row for row in np.argsort(time, kind="stable") if clouds[row] not in absent], np.int64)
    _check_times(table.path, time[kept])
    poses = _poses(table)
    optional = {n: table.numbers(n)[kept, 0] if n in table.names else None for n in ("speed_mps", "sensor_height_m")}
    has_boxes = (folder / BOXES).is_file()
    return AgentTable(
        id,
        folder,
        tuple(clouds[row] for row in kept),
        time[kept],
        poses[torch.from_numpy(kept)],
        optional["speed_mps"],
        optional["sensor_height_m"],
        BoxTable.read(folder / BOXES) if has_boxes else BoxTable.empty(),
        has_boxes,
        _body(table),
    )


def _body(table: Table) -> AgentBody | None:
    """Return the body that the first row states; None where the table has no such columns."""
    if _BODY[0] not in table.names or not table.rows:
        return None
    return make_body(table.path, "body_x to body_height", table.numbers(*_BODY)[0].tolist())


def _find_clouds(folder: Path, table: Table, time: np.ndarray) -> list[Path]:
    """Return the cloud of each row: of the column ``cloud``, else named by the time."""
    if "cloud" in table.names:
        names = table.texts("cloud")
        outside = [name for name in names if not name or Path(name).is_absolute() or ".." in Path(name).parts]
        if outside:
            raise RecordingError(
                f"{table.path}: '{outside[0]}' is no file in the agent's folder; name one as clouds/<file>."
            )
        return [folder / name for name in names]
    by_stem = {p.stem: p for p in (folder / CLOUDS).iterdir() if p.suffix in SUFFIXES}
    return [by_stem.get(str(t), folder / CLOUDS / f"{t}{SUFFIXES[0]}") for t in time.tolist()]


def _check_times(path: Path, time: np.ndarray) -> None:
    twice = time[1:][np.diff(time) == 0]
    if len(twice):
        raise RecordingError(f"{path}: two rows of the time {twice[0]}; keep one of them.")


def _poses(table: Table) -> Transform:
    """Return world from LiDAR (rows,), float64."""
    place = torch.from_numpy(table.numbers("x", "y", "z"))
    if "qw" in table.names:
        quaternion = torch.from_numpy(table.numbers("qw", "qx", "qy", "qz"))
        length = quaternion.norm(dim=-1)
        bad = ((length - 1).abs() > 0.01).nonzero()[:, 0]
        if len(bad):
            row = int(bad[0])
            raise RecordingError(
                f"{table.path}: the quaternion in row {row + 2} has length {float(length[row]):.3f}, expected 1; normalise it."
            )
        return Transform(rotation_of_quaternion(quaternion), place)
    if not {"roll", "pitch", "yaw"} <= set(table.names):
        raise RecordingError(
            f"{table.path}: expected the columns qw, qx, qy, qz or roll, pitch, yaw (radians); add them."
        )
    roll, pitch, yaw = torch.from_numpy(table.numbers("roll", "pitch", "yaw")).unbind(1)
    return Transform.from_rpy(place, roll, pitch, yaw)


def _nearest(agent: AgentTable, timestamp_ns: int) -> int | None:
    """Return the agent's row nearest in time; None where it is farther than MAX_OFFSET_NS."""
    offset = np.abs(agent.timestamp_ns - timestamp_ns)
    row = int(offset.argmin())
    return row if offset[row] <= MAX_OFFSET_NS else None
