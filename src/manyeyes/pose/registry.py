# SPDX-License-Identifier: Apache-2.0
"""Pose correctors by name: the default, the baselines and those of third parties; and the function that uses one.

A corrector of landmarks or of whole clouds is a function of ego, other and prior. A corrector with weights is registered as
the function that loads it: of a shipped name or a file, and of the minimum number of pairs. ``feakm`` is FeaKM's shipped net,
a path that ends in .safetensors one of 'manyeyes train'; ``@8`` after either requires eight pairs instead of four.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from manyeyes.datatypes import Boxes, ConfigError, PointCloud
from manyeyes.datatypes.numbers import Numbers
from manyeyes.datatypes.registry import Registry
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseCorrector, PoseEstimate, PosePrior

FEAKM = "feakm"
Kind = Literal["landmarks", "clouds", "weights"]
Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class RegisteredCorrector:
    """A registered function and what it compares, landmarks or clouds; or weights: it loads a corrector of landmarks."""

    function: Callable[..., Any]
    kind: Kind


POSE_CORRECTORS: Registry[RegisteredCorrector] = Registry(
    "pose corrector",
    "manyeyes.pose_corrector",
    "manyeyes.pose.corrector",
    "manyeyes.pose.registration",
    "manyeyes.pose.feakm",
    "manyeyes.pose.learned_voting",
    "manyeyes.pose.baselines",
)


def register_pose_corrector(name: str, kind: Kind = "landmarks") -> Callable[[Function], Function]:
    """Register a corrector under a name, as a decorator.

    Args:
        name: what commands and ``correct_pose`` call it. kind: what the function compares; see RegisteredCorrector.

    Raises:
        ConfigError: another corrector has the name.
    """

    def decorate(function: Function) -> Function:
        POSE_CORRECTORS.register(name)(RegisteredCorrector(function, kind))
        return function

    return decorate


JointCorrector = Callable[[Sequence[Landmarks], Sequence[PosePrior | None]], list[PoseEstimate]]
"""Corrects all agents at once: landmarks of the ego, then of the others, and the priors of the others."""
_JOINT_CORRECTORS: dict[str, JointCorrector] = {}


def register_joint_corrector(name: str) -> Callable[[JointCorrector], JointCorrector]:
    """Register how the corrector of a name corrects several agents at once, as a decorator."""

    def decorate(function: JointCorrector) -> JointCorrector:
        _JOINT_CORRECTORS[name] = function
        return function

    return decorate


def find_joint_corrector(name: str) -> JointCorrector | None:
    """Return how the corrector of a name corrects several agents at once; None if it knows pairs alone."""
    find_corrector(name)
    return _JOINT_CORRECTORS.get(name)


def list_correctors(*kinds: Kind) -> tuple[str, ...]:
    """Return the names of all correctors of these kinds."""
    return tuple(name for name, found in POSE_CORRECTORS.load_all().items() if found.kind in kinds)


def find_corrector(name: str) -> RegisteredCorrector:
    """Return the corrector of a name, of landmarks or of clouds; weights are loaded.

    Raises:
        ConfigError: no corrector has the name, or what follows @ is no number of pairs.
    """
    weights, _, min_pairs = name.partition("@")
    key = FEAKM if weights.endswith(".safetensors") else weights
    found = POSE_CORRECTORS.get(key)
    if found.kind == "weights" and (min_pairs.isdecimal() or not min_pairs):
        return RegisteredCorrector(found.function(weights, int(min_pairs or 4)), "landmarks")
    if min_pairs:
        raise ConfigError(
            f"{name!r}: after the @ of a corrector with weights, give the minimum number of pairs, the paper's 4 or 8."
        )
    return found


def load_corrector(name: str) -> PoseCorrector:
    """Return the corrector of landmarks of a name.

    Raises:
        ConfigError: no corrector of landmarks has the name.
    """
    found = find_corrector(name)
    if found.kind != "landmarks":
        known = ", ".join(list_correctors("landmarks", "weights"))
        raise ConfigError(f"{name!r} compares whole clouds, not landmarks; choose one of {known}.")
    return found.function


def correct_pose(
    ego: Landmarks | Boxes | PointCloud | Numbers,
    other: Landmarks | Boxes | PointCloud | Numbers,
    prior: PosePrior | None = None,
    corrector: str = "voting",
) -> PoseEstimate:
    """Estimate ego_from_other, the other agent's pose in the ego's frame, from what both observe at one instant.

    Args:
        ego, other: each in its own frame: boxes, or an array (N, 6) of their x, y (m), yaw (rad), length, width (m) and score, or
            (N, 7) of their centre x, y, z and length, width, height (m) and yaw (rad). For a corrector of clouds: clouds, or arrays
            (N, 3), metres.
        prior: what is known of the pose before; see ``PosePrior.of`` and ``PosePrior.from_pose``.
        corrector: a registered name.

    Returns:
        The pose to use with its covariance, the pairs of boxes, and the status: AMBIGUOUS and NO_MATCH are not measured, and their
        pose is the prior or None (docs/concepts/pose-correction.md).

    Raises:
        ConfigError: the corrector is not known. ShapeError: an array has another shape.
    """
    found = find_corrector(corrector)
    convert = _as_cloud if found.kind == "clouds" else _as_landmarks
    return found.function(convert(ego), convert(other), prior)


def _as_landmarks(objects: Any) -> Landmarks:
    return Landmarks.of(objects)


def _as_cloud(points: Any) -> PointCloud:
    return points if isinstance(points, PointCloud) else PointCloud.of(points)
