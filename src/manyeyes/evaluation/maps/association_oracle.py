# SPDX-License-Identifier: Apache-2.0
"""Oracles that know which true element every observed one shows: maps at the prior poses, and at jointly estimated ones.

The joint estimate is a reference for methods whose associations may be wrong, not a bound: least squares over the poses of all
observations and an offset of each true station across its line, from every observed metre. Priors are those of the crowd: half of
the variance of a pose, by default, is one error of the whole drive. Observed lines are bent, so that the points of one are not
independent: their variance grows with their number. Rows and drives have Geman-McClure weights, for wrong poses and displaced
elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment
from manyeyes.evaluation.maps.matching import MatchingProtocol, make_lines, resample_lines
from manyeyes.evaluation.maps.observed_area import replace_geometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_GAP_M = 6.0
"""Metres of a true line without observation that are left out."""
_METRES = MatchingProtocol("stations", spacing_m=1.0)
_ROW_SCALES_M = (2.0, 1.4, 1.0, 0.7, 0.5, 0.5, 0.5, 0.5)
"""Geman-McClure scale of rows in each iteration."""
_DRIVE_SCALE = 3.0
"""Geman-McClure scale of a drive's prior, in standard deviations."""
_CROSSING_SIGMA_M = 0.3
_MIN_SIGMA_M = 0.01


@dataclass(frozen=True, eq=False)
class AssociatedRows:
    """Measurements (M,) of the offsets of true stations: observation, point (M, 2) in the agent's frame, its true place (M, 2),
    direction (M, 2) that is measured, station, and variance (M,), square metres.
    """

    observation: Ints
    point: Floats
    place: Floats
    direction: Floats
    station: Ints
    variance: Floats


def fuse_with_true_association(experiment: FleetExperiment, poses: Floats | None = None) -> MapElements:
    """Return every observed true element, moved by the mean offset of its observations at poses (N, 3), by default the priors."""
    truth = experiment.place.truth
    points_by_element: dict[int, list[Floats]] = {}
    for k, row, origin in _list_associations(experiment):
        observation = experiment.observations[k]
        line = observation.elements.polyline(row)
        true = _move(line, experiment.fleet.true_poses[k])
        points_by_element.setdefault(origin, []).append(
            np.hstack((true, _move(line, observation.pose if poses is None else poses[k])))
        )
    rows: list[int] = []
    parts: list[Floats] = []
    for origin in sorted(points_by_element):
        point_pairs = np.concatenate(points_by_element[origin])
        line = truth.polyline(origin)
        shifted = (
            [line + (point_pairs[:, 2:] - point_pairs[:, :2]).mean(0)]
            if truth.kind[origin] == CROSSING
            else _shift_line(line, point_pairs)
        )
        rows += [origin] * len(shifted)
        parts += shifted
    return replace_geometry(truth, rows, parts)


def estimate_poses_with_true_association(experiment: FleetExperiment) -> Floats:
    """Return the poses (N, 3) of all observations by joint least squares with the true associations."""
    observations, rows = experiment.observations, make_associated_rows(experiment)
    poses = np.array([o.pose for o in observations], dtype=np.float64).reshape(-1, 3)
    prior_poses = poses.copy()
    drives = _group_drives(experiment)
    fraction = experiment.trial.fleet_config.drive_error_fraction
    information = [_drive_information([observations[k].covariance for k in drive], fraction) for drive in drives]
    for scale_m in _ROW_SCALES_M:
        jacobian, offset = _linearize(rows, poses)
        residual = _remove_station_means(rows, offset, 1 / rows.variance)
        kernel = (scale_m**2 / (scale_m**2 + residual**2)) ** 2
        normal, right_side = _eliminate_stations(rows, jacobian, offset, kernel / rows.variance, len(poses))
        for drive, inverse in zip(drives, information):
            index = (3 * drive[:, None] + np.arange(3)).ravel()
            error = (poses[drive] - prior_poses[drive]).ravel()
            square = float(error @ inverse @ error) / len(drive)
            weight = (_DRIVE_SCALE**2 / (_DRIVE_SCALE**2 + square)) ** 2
            normal[np.ix_(index, index)] += weight * inverse
            right_side[index] -= weight * (inverse @ error)
        poses = poses + np.linalg.solve(normal, right_side).reshape(-1, 3)
    return poses


def make_associated_rows(experiment: FleetExperiment) -> AssociatedRows:
    """Return a row for each observed metre of a true line, and two, of its middle, for each observed crossing."""
    truth, config = experiment.place.truth, experiment.trial.fleet_config
    first_station: dict[int, int] = {}
    stations: dict[int, Floats] = {}
    num_stations = 0
    parts: list[tuple[Ints, Floats, Floats, Floats, Ints, Floats]] = []
    for k, row, origin in _list_associations(experiment):
        line, true_pose = experiment.observations[k].elements.polyline(row), experiment.fleet.true_poses[k]
        is_crossing = truth.kind[origin] == CROSSING
        if origin not in first_station:
            stations[origin] = np.zeros((2, 2)) if is_crossing else _resample(truth.polyline(origin))
            first_station[origin] = num_stations
            num_stations += len(stations[origin])
        if is_crossing:
            point = np.repeat(line.mean(0)[None], 2, 0)
            place, direction, station = _move(point, true_pose), np.eye(2), np.arange(2)
            variance = np.full(2, _CROSSING_SIGMA_M**2)
        else:
            point = _resample(line)
            true, at = _move(point, true_pose), stations[origin]
            station = np.hypot(true[:, None, 0] - at[None, :, 0], true[:, None, 1] - at[None, :, 1]).argmin(1)
            place, direction = at[station], _compute_normals(at)[station]
            sigma_m = config.point_sigma_m + config.point_sigma_per_m * np.hypot(*point.T)
            # The bend of a line is common to its points: half of its variance is taken as an error of their mean.
            variance = np.maximum(sigma_m**2 + 0.5 * len(point) * config.lateral_bend_m**2, _MIN_SIGMA_M**2)
        parts.append((np.full(len(point), k), point, place, direction, first_station[origin] + station, variance))
    if not parts:
        none, no_points = np.zeros(0, np.int64), np.zeros((0, 2))
        return AssociatedRows(none, no_points, no_points, no_points, none, np.zeros(0))
    observation, point, place, direction, station, variance = (np.concatenate(column) for column in zip(*parts))
    return AssociatedRows(observation, point, place, direction, station, variance)


def _list_associations(experiment: FleetExperiment) -> list[tuple[int, int, int]]:
    """List observation, row of its elements and row of the true element that it shows; false elements are left out."""
    offsets, found = experiment.fleet.origin_offsets, []
    for k in range(len(experiment.observations)):
        for row, origin in enumerate(experiment.fleet.origin[offsets[k] : offsets[k + 1]].tolist()):
            if 0 <= origin < len(experiment.place.truth):
                found.append((k, row, origin))
    return found


def _group_drives(experiment: FleetExperiment) -> list[Ints]:
    names = [(o.agent, o.pass_id) for o in experiment.observations]
    return [np.array([k for k, name in enumerate(names) if name == drive]) for drive in dict.fromkeys(names)]


def _drive_information(covariances: list[Floats], fraction: float) -> Floats:
    """Return the information (3n, 3n) of the priors of a drive, of whose variance a fraction is one common error."""
    count = len(covariances)
    shared = np.kron(np.ones((count, count)), np.mean(covariances, 0)) * fraction
    for k, covariance in enumerate(covariances):
        part = slice(3 * k, 3 * k + 3)
        shared[part, part] += (1 - fraction) * covariance + 1e-9 * np.eye(3)
    return np.linalg.inv(shared)


def _linearize(rows: AssociatedRows, poses: Floats) -> tuple[Floats, Floats]:
    """Return derivatives (M, 3) of the offsets by x, y, yaw of each row's pose, and the offsets (M,) themselves, metres."""
    pose = poses[rows.observation]
    sine, cosine = np.sin(pose[:, 2]), np.cos(pose[:, 2])
    x = cosine * rows.point[:, 0] - sine * rows.point[:, 1]
    y = sine * rows.point[:, 0] + cosine * rows.point[:, 1]
    offset = ((pose[:, :2] + np.stack((x, y), 1) - rows.place) * rows.direction).sum(1)
    turn = rows.direction[:, 1] * x - rows.direction[:, 0] * y
    return np.column_stack((rows.direction, turn)), offset


def _remove_station_means(rows: AssociatedRows, offset: Floats, weight: Floats) -> Floats:
    count = int(rows.station.max()) + 1 if len(rows.station) else 0
    total = np.maximum(np.bincount(rows.station, weight, count), 1e-12)
    return offset - (np.bincount(rows.station, weight * offset, count) / total)[rows.station]


def _eliminate_stations(
    rows: AssociatedRows, jacobian: Floats, offset: Floats, weight: Floats, num_poses: int
) -> tuple[Floats, Floats]:
    """Return the normal matrix (3N, 3N) and right side (3N,) of the poses, after the Schur complement of the stations."""
    num_rows = len(rows.station)
    count = int(rows.station.max()) + 1 if num_rows else 0
    columns = 3 * rows.observation[:, None] + np.arange(3)
    starts = np.arange(0, 3 * num_rows + 1, 3)
    derivatives = csr_array((jacobian.ravel(), columns.ravel(), starts), shape=(num_rows, 3 * num_poses))
    of_station = csr_array((weight, rows.station, np.arange(num_rows + 1)), shape=(num_rows, count))
    weighted = csr_array(((weight[:, None] * jacobian).ravel(), columns.ravel(), starts), shape=derivatives.shape)
    total = np.maximum(np.bincount(rows.station, weight, count), 1e-12)
    coupling = (of_station.T @ derivatives).toarray()
    normal = (weighted.T @ derivatives).toarray() - coupling.T @ (coupling / total[:, None])
    mean = np.bincount(rows.station, weight * offset, count)
    right_side = -(weighted.T @ offset) + coupling.T @ (mean / total)
    return normal, np.asarray(right_side)


def _move(points: Floats, pose: Floats) -> Floats:
    sine, cosine = np.sin(pose[2]), np.cos(pose[2])
    return points @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def _resample(line: Floats) -> Floats:
    return resample_lines(make_lines([line]), _METRES).points


def _compute_normals(line: Floats) -> Floats:
    step = np.gradient(line, axis=0)
    return np.stack((-step[:, 1], step[:, 0]), 1) / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]


def _shift_line(line: Floats, point_pairs: Floats) -> list[Floats]:
    """Return the seen parts of a line, at 1 m, across it at the mean of the claimed points (K, 4): true x, y, claimed x, y."""
    stations = _resample(line)
    normal = _compute_normals(stations)
    nearest = np.hypot(
        point_pairs[:, None, 0] - stations[None, :, 0], point_pairs[:, None, 1] - stations[None, :, 1]
    ).argmin(1)
    lateral_m = ((point_pairs[:, 2:] - stations[nearest]) * normal[nearest]).sum(1)
    count = np.bincount(nearest, minlength=len(stations))
    mean = np.bincount(nearest, lateral_m, len(stations)) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    breaks = np.flatnonzero(np.diff(known) > MAX_GAP_M) + 1
    return [stations[part] + mean[part, None] * normal[part] for part in np.split(known, breaks) if len(part) > 1]
