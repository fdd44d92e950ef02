# SPDX-License-Identifier: Apache-2.0
"""Studies of detection as commands: each a file, each writing JSON, Markdown and a picture."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

STUDIES = {
    "robustness": "delay, errors of pose, lost packets, one at a time and together (CoSTr, Table II)",
    "bandwidth": "AP against bytes a message, for each way to choose tokens and to write them (CoSTr, Fig. 3)",
    "num-agents": "one agent to five",
    "ablation": "branches of a training, side by side (CoSTr, Table III)",
    "shared-bandwidth": "every agent judged as ego, one budget for the channel (CoSTr, Eq. 2)",
    "pose-noise-ap": "errors of pose, with and without a corrector before each fusion (FeaKM, Tables 1 and 2)",
    "feakm": "branches of FeaKM: its confidence map, its scales (FeaKM, Table 3)",
    "pose-estimation": "how good corrected poses are, by corrector, error and objects in common",
    "qualitative": "one frame under errors, methods side by side (CoSTr, Fig. 4)",
}

MODULES = {
    "robustness": "detection.robustness",
    "bandwidth": "detection.bandwidth",
    "num-agents": "detection.num_agents",
    "ablation": "detection.ablation",
    "shared-bandwidth": "detection.shared_bandwidth",
    "pose-noise-ap": "pose.pose_noise_ap",
    "feakm": "pose.feakm",
    "pose-estimation": "pose.pose_estimation",
    "qualitative": "detection.qualitative",
}


def check_study(name: str) -> None:
    """Refuse a study that is not there."""
    if name not in STUDIES:
        raise ConfigError(f"No study is called {name!r}; known: {', '.join(STUDIES)}.")


def run_named_study(options: Options, console: Console) -> None:
    """Run the named study; cells that are kept are not made again."""
    check_study(options.study or "")
    importlib.import_module(f"manyeyes.studies.{MODULES[str(options.study)]}").run(options, console)
