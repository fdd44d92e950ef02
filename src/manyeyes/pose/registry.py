# SPDX-License-Identifier: Apache-2.0
"""The default corrector and the baselines by name.

FeaKM has weights: ``feakm`` is the shipped net, a path that ends in .safetensors one of 'manyeyes train'; ``@8`` after either
requires eight pairs instead of four. CLOUD_CORRECTORS take whole clouds instead of landmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from manyeyes.datatypes import ConfigError, PointCloud
from manyeyes.pose.baselines import coalign, feaco, fpv_rcnn, gicp, icp, identity, mash, v2x_reg, vips
from manyeyes.pose.baselines.v2x_reg import V2xRegConfig
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, correct_pose
from manyeyes.pose.feakm import load_feakm_corrector
from manyeyes.pose.registration import register_clouds
from manyeyes.pose.types import PoseCorrector, PoseEstimate, PosePrior

FEAKM = "feakm"
CORRECTORS: dict[str, PoseCorrector] = {
    "voting": partial(correct_pose, config=DETECTOR_BOXES_CONFIG),
    "identity": identity.correct,
    "coalign": coalign.correct,
    "fpv-rcnn": fpv_rcnn.correct,
    "feaco": feaco.correct,
    "icp": icp.correct,
    "vips": vips.correct,
    "v2x-reg-odist": v2x_reg.correct,
    "v2x-reg-oiou": partial(v2x_reg.correct, config=V2xRegConfig("oIoU")),
    "mash": mash.correct,
}

CLOUD_CORRECTORS: dict[str, Callable[[PointCloud, PointCloud, PosePrior | None], PoseEstimate]] = {
    "scan-registration": register_clouds,
    "gicp": gicp.correct,
}


def load_corrector(name: str) -> PoseCorrector:
    """The corrector of a name; ConfigError lists the known names."""
    weights, _, min_pairs = name.partition("@")
    if weights == FEAKM or weights.endswith(".safetensors"):
        if min_pairs and not min_pairs.isdecimal():
            raise ConfigError(f"{name!r}: after @, give the minimum number of pairs, the paper's 4 or 8.")
        return load_feakm_corrector(weights, int(min_pairs or 4))
    if name not in CORRECTORS:
        raise ConfigError(
            f"No corrector is called {name!r}; known: {', '.join(CORRECTORS)}, {FEAKM}, or a .safetensors file of FeaKM."
        )
    return CORRECTORS[name]
