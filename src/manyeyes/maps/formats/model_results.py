# SPDX-License-Identifier: Apache-2.0
"""Result files of MapTR and StreamMapNet, with the poses of their samples, as observations.

Layouts, as the projects' evaluators write them (both are JSON with ``meta`` and ``results``):

- MapTR, MapTRv2 (``nuscmap_results.json``): results is a list of ``{"sample_token", "vectors": [{"pts": [[x, y], ...],
  "cls_name": "divider" | "ped_crossing" | "boundary" | ..., "type", "confidence_level"}]}``. On nuScenes the points are in
  the frame of the roof LiDAR, x right and y forward (``axes="lidar"``); on Argoverse 2 in the vehicle's, x forward and y left.
- StreamMapNet, VectorMapNet (``submission_vector.json``): results maps a token to ``{"vectors": [[[x, y], ...], ...],
  "scores": [...], "labels": [...]}``, labels counting 0 ped_crossing, 1 divider, 2 boundary; points in the vehicle's frame.

Neither file holds poses. They come as a :class:`PoseTable`: out of a CSV (:func:`read_pose_csv`), or of a nuScenes data set's own
tables (:func:`read_nuscenes_poses`). What neither file holds is filled in so: sigma is 0.3 m a point (the authors publish average
precision at 0.5 m, no deviation), style is unknown ("none"), the view is the model's range.
A sample that cannot be used (no pose, a ring that crosses itself, a coordinate that is no number) is rejected with its reason.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import ManyeyesError
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE, MapElements
from manyeyes.maps.elements.observation import MapFrame, Observation, ObservationError, shorten
from manyeyes.maps.elements.observation_file import LoadedObservations, RejectedRows

Array = NDArray[np.float64]

_KIND_OF_NAME = {
    "divider": DIVIDER,
    "boundary": BOUNDARY,
    "ped_crossing": CROSSING,
    "crossing": CROSSING,
    "crosswalk": CROSSING,
    "stop_line": STOP_LINE,
}
_KIND_OF_LABEL = (CROSSING, DIVIDER, BOUNDARY)
_SIGMA_M = 0.3
# Models say a ring's first point again at its end, and not quite there.
_CLOSED_M = 0.5
_POSE_SIGMA = (0.7, 0.7, math.radians(0.8))
_COLUMNS = ("token", "agent", "pass_id", "time_ns", "x", "y", "yaw")
# Latitude and longitude of the zero of nuScenes' maps (the data set's documentation).
_NUSCENES_ORIGIN = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}


_MAX_FILE_BYTES = 1 << 32  # nuScenes' table of all samples has more than 1 GB


class ModelResultsError(ManyeyesError):
    """A result file or a table of poses that cannot be read; the text names the file and the field."""


@dataclass(frozen=True)
class SamplePose:
    """Agent, time and prior pose of a sample: x, y (m) and yaw (rad) in the frame; sigma: standard deviation of each."""

    agent: str
    pass_id: str
    time_ns: int
    pose: tuple[float, float, float]
    sigma: tuple[float, float, float] = _POSE_SIGMA


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of samples, by token, in one frame."""

    frame: MapFrame
    tokens: tuple[str, ...]
    poses: tuple[SamplePose, ...]


@dataclass(frozen=True)
class ModelResultOptions:
    """What a result file does not say. range_x, range_y: the model's view, metres forward and left of the vehicle.

    axes: of the points, "vehicle" (x forward, y left) or "lidar" (x right, y forward). min_score: elements below are left out.
    """

    axes: Literal["vehicle", "lidar"] = "vehicle"
    range_x: tuple[float, float] = (-30.0, 30.0)
    range_y: tuple[float, float] = (-15.0, 15.0)
    min_score: float = 0.0
    sigma_m: float = _SIGMA_M
    model: str = ""


RESULT_OPTIONS = {
    "maptr-nuscenes": ModelResultOptions(axes="lidar", model="maptr"),
    "maptr-av2": ModelResultOptions(model="maptr"),
    "streammapnet": ModelResultOptions(model="streammapnet"),
    "streammapnet-100x50": ModelResultOptions(range_x=(-50.0, 50.0), range_y=(-25.0, 25.0), model="streammapnet"),
}


def read_model_results(source: Path | str, poses: PoseTable, options: ModelResultOptions) -> LoadedObservations:
    """Return the samples of a result file of MapTR or StreamMapNet (distinguished by their layout) as observations, by token.

    Vectors of classes that are no element here, such as MapTRv2's centerline, are counted by class in ``left_out``.
    """
    path = Path(source)
    root = _json(path, _unique)
    results = root.get("results") if isinstance(root, dict) else None
    if not isinstance(results, list | dict):
        raise ModelResultsError(
            f"{path}: expected an object with 'results', a list (MapTR) or an object (StreamMapNet)."
        )
    pose_of_token = dict(zip(poses.tokens, poses.poses))
    kept, rejected, read = [], [], set[str]()
    left_out: Counter[str] = Counter()
    for row, (token, vectors) in enumerate(_samples(results)):
        context = f"{path}: sample '{shorten(token)}'"
        try:
            if token not in pose_of_token:
                raise ModelResultsError(f"{context} has no pose; add it to the table of poses.")
            if token in read:
                raise ModelResultsError(f"{context} is there twice; the first one counts. Leave one out.")
            read.add(token)
            kept.append(_observation(pose_of_token[token], vectors, options, context))
            left_out.update(_class_name(v.name) for v in vectors or () if _kind(v.name) is None)
        except (ModelResultsError, ObservationError) as error:
            rejected.append(RejectedRows(str(path), row, 1, str(error)))
    return LoadedObservations(poses.frame, tuple(kept), tuple(rejected), dict(left_out))


@dataclass(frozen=True)
class _Vector:
    """One element as a file has it: its class by name or number, its score, its points, all unchecked."""

    name: Any
    score: Any
    points: Any


def _samples(results: list[Any] | dict[str, Any]) -> Iterator[tuple[str, list[_Vector] | None]]:
    """Yield tokens and vectors of all samples in the file's order; None where a sample has another layout."""
    if isinstance(results, list):
        for item in results:
            item = item if isinstance(item, dict) else {}
            vectors = item.get("vectors")
            fits = isinstance(vectors, list) and all(isinstance(v, dict) for v in vectors)
            found = (
                [_Vector(v.get("cls_name"), v.get("confidence_level"), v.get("pts")) for v in vectors or ()]
                if fits
                else None
            )
            yield str(item.get("sample_token", "")), found
        return
    for token, item in results.items():
        columns = [item.get(k) for k in ("labels", "scores", "vectors")] if isinstance(item, dict) else [None]
        fits = all(isinstance(c, list) for c in columns) and len({len(c or ()) for c in columns}) == 1
        yield token, [_Vector(*row) for row in zip(*columns)] if fits else None


def _observation(
    sample_pose: SamplePose, vectors: list[_Vector] | None, options: ModelResultOptions, context: str
) -> Observation:
    if vectors is None:
        raise ModelResultsError(
            f"{context}: expected vectors with a class, a score and points each; got another layout."
        )
    lines, kinds, scores = [], [], []
    for number, vector in enumerate(vectors):
        kind = _kind(vector.name)
        score = _score(vector.score, f"{context} vector {number}")
        if kind is None or score < options.min_score:
            continue
        points = _points(vector.points, f"{context} vector {number}")
        if options.axes == "lidar":
            points = np.stack((points[:, 1], -points[:, 0]), 1)
        if kind == CROSSING and len(points) > 3 and math.dist(points[0], points[-1]) < _CLOSED_M:
            points = points[:-1]
        # A ring needs three points, a line two: evaluators drop shorter ones too.
        if len(points) >= (3 if kind == CROSSING else 2):
            lines.append(points)
            kinds.append(kind)
            scores.append(score)
    (x0, x1), (y0, y1) = options.range_x, options.range_y
    return Observation(
        agent=sample_pose.agent,
        pass_id=sample_pose.pass_id,
        time_ns=sample_pose.time_ns,
        pose=np.array(sample_pose.pose),
        covariance=np.diag([sigma * sigma for sigma in sample_pose.sigma]),
        view=np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]),
        elements=MapElements.of(lines, np.array(kinds, np.int64), np.array(scores), options.sigma_m),
        model=options.model,
    )


def _kind(name: Any) -> int | None:
    """Return the element's kind; None for classes that are no element here, such as MapTRv2's centerline."""
    if isinstance(name, int) and not isinstance(name, bool):
        return _KIND_OF_LABEL[name] if 0 <= name < len(_KIND_OF_LABEL) else None
    return _KIND_OF_NAME.get(str(name))


def _class_name(name: Any) -> str:
    return f"class {shorten(repr(name) if isinstance(name, str) else name)}"


def _score(value: Any, context: str) -> float:
    if isinstance(value, int | float) and 0.0 <= value <= 1.0:
        return float(value)
    raise ModelResultsError(f"{context}: expected a score in [0, 1]; got {shorten(repr(value))}.")


def _points(value: Any, context: str) -> Array:
    """Return (M, 2) points; a third coordinate is left out."""
    try:
        points = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[-1] not in (2, 3) or not np.isfinite(points).all():
        raise ModelResultsError(f"{context}: expected a list of points [x, y] of finite numbers; got another value.")
    return points[:, :2]


def read_pose_csv(source: Path | str, frame: MapFrame) -> PoseTable:
    """Return poses from a CSV with the columns token, agent, pass_id, time_ns, x, y, yaw and, if there are, sigma_x, sigma_y,
    sigma_yaw.

    x, y in metres and yaw in radians in the frame; without sigmas 0.7 m and 0.8°.
    """
    path = Path(source)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ModelResultsError(f"{path}: expected a CSV of poses; {error}.") from error
    missing = [name for name in _COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise ModelResultsError(
            f"{path}: expected the columns {', '.join(_COLUMNS)}; {', '.join(missing)} missing or no row."
        )
    poses, tokens = [], dict[str, int]()
    for number, row in enumerate(rows, start=2):
        if row["token"] in tokens:
            first = tokens[row["token"]]
            raise ModelResultsError(
                f"{path} line {number}: token '{shorten(row['token'])}' is in line {first} too; leave one out."
            )
        tokens[row["token"]] = number
        sigma = [row.get(f"sigma_{axis}") or default for axis, default in zip(("x", "y", "yaw"), _POSE_SIGMA)]
        try:
            x, y, yaw, *spread = (float(v) for v in (row["x"], row["y"], row["yaw"], *sigma))
            time = int(row["time_ns"])
        except (TypeError, ValueError):
            raise ModelResultsError(
                f"{path} line {number}: expected numbers in time_ns, x, y, yaw and sigmas."
            ) from None
        if not np.isfinite([x, y, yaw]).all() or min(spread) <= 0:
            raise ModelResultsError(f"{path} line {number}: expected finite numbers and sigmas above 0.")
        poses.append(SamplePose(row["agent"], row["pass_id"], time, (x, y, yaw), (spread[0], spread[1], spread[2])))
    return PoseTable(frame, tuple(tokens), tuple(poses))


def read_nuscenes_poses(folder: Path | str, location: str, axes: Literal["vehicle", "lidar"] = "vehicle") -> PoseTable:
    """Return poses of a nuScenes data set's samples at one location, from its tables (the folder with ``sample_data.json``).

    The pose at the LiDAR's key frame. The vehicle's frame, or, for results with axes "lidar", the LiDAR's place with the vehicle's
    heading corrected by how the LiDAR is mounted. The four locations have maps of their own, so one table holds one location.
    """
    root = Path(folder)
    if location not in _NUSCENES_ORIGIN:
        raise ModelResultsError(f"Unknown location '{location}'; known: {', '.join(_NUSCENES_ORIGIN)}.")
    logs = {row["token"]: row for row in _table(root, "log", "token", "location", "vehicle")}
    scenes = {row["token"]: row for row in _table(root, "scene", "token", "log_token", "name")}
    samples = {row["token"]: row for row in _table(root, "sample", "token", "scene_token")}
    poses = {row["token"]: row for row in _table(root, "ego_pose", "token", "translation", "rotation")}
    mounts = {row["token"]: row for row in _table(root, "calibrated_sensor", "token", "translation", "rotation")}
    tokens, found = [], []
    for row in _table(root, "sample_data", "sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp"):
        if not row.get("is_key_frame") or "LIDAR_TOP" not in str(row.get("filename")):
            continue
        try:
            scene = scenes[samples[row["sample_token"]]["scene_token"]]
            log = logs[scene["log_token"]]
            ego, mount = poses[row["ego_pose_token"]], mounts[row["calibrated_sensor_token"]]
        except (KeyError, TypeError) as error:
            raise ModelResultsError(
                f"{root}: sample {shorten(row['sample_token'])} names {shorten(error)}, which no table holds."
            ) from None
        if log["location"] == location:
            try:
                pose = _planar(ego) if axes == "vehicle" else _lidar_pose(_planar(ego), _planar(mount))
                found.append(SamplePose(str(log["vehicle"]), str(scene["name"]), int(row["timestamp"]) * 1000, pose))
            except (TypeError, ValueError, IndexError, OverflowError) as error:
                raise ModelResultsError(
                    f"{root}: sample {shorten(row['sample_token'])}: expected a pose and a time in numbers; {shorten(error)}."
                ) from None
            tokens.append(row["sample_token"])
    if not tokens:
        raise ModelResultsError(
            f"{root}: no LiDAR key frame at '{location}'; give the folder with the tables of the data set."
        )
    return PoseTable(MapFrame(*_NUSCENES_ORIGIN[location]), tuple(tokens), tuple(found))


def _lidar_pose(ego: tuple[float, float, float], mount: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the LiDAR's x, y and the yaw of its y axis, which a result file calls forward."""
    (x, y, yaw), (dx, dy, turn) = ego, mount
    c, s = math.cos(yaw), math.sin(yaw)
    return x + c * dx - s * dy, y + s * dx + c * dy, yaw + (turn + math.pi / 2)


def _planar(row: dict[str, Any]) -> tuple[float, float, float]:
    """x, y and yaw of a nuScenes record: translation, and rotation as w, x, y, z."""
    w, x, y, z = row["rotation"]
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float(row["translation"][0]), float(row["translation"][1]), yaw


def _table(root: Path, name: str, *fields: str) -> Sequence[dict[str, Any]]:
    """Return the rows of one nuScenes table, which hold the fields."""
    path = root / f"{name}.json"
    rows = _json(path)
    if not isinstance(rows, list) or any(not isinstance(r, dict) or any(f not in r for f in fields) for r in rows):
        raise ModelResultsError(f"{path}: expected a list of records with {', '.join(fields)}.")
    return rows


def _json(path: Path, make_object: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Read a JSON file; make_object: of the pairs of an object, a dictionary without it."""
    try:
        return parse_json(read_file(path, _MAX_FILE_BYTES), make_object)
    except (OSError, ValueError) as error:
        raise ModelResultsError(f"{path}: expected a JSON file; {error}.") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a dictionary; ValueError where a key is there twice."""
    made = dict(pairs)
    if len(made) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"'{shorten(twice)}' is there twice in one object, leave one out")
    return made


__all__ = [
    "RESULT_OPTIONS",
    "ModelResultOptions",
    "ModelResultsError",
    "PoseTable",
    "SamplePose",
    "read_model_results",
    "read_nuscenes_poses",
    "read_pose_csv",
]
