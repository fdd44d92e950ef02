# SPDX-License-Identifier: Apache-2.0
"""Studies of the map model, in the form of the CrowdMap paper's tables: 'manyeyes map evaluate --study' runs them by name."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

MODEL_STUDIES = {
    "local": "local",
    "semi-global": "semi_global",
    "full-map": "full_map",
    "map-pose-noise": "map_pose_noise",
}
"""Studies of the map model, and their modules."""


def run_model_study(options: Options, console: Console) -> None:
    """Runs one of MODEL_STUDIES; what is finished is kept under --out."""
    from manyeyes.datatypes import ConfigError
    from manyeyes.studies.maps.running import find_missing_files

    if options.data is None:
        raise ConfigError(f"The study {options.study!r} needs --data, a dataset of towns such as data/carla-maps.")
    find_missing_files(options, console)
    import_module(f"manyeyes.studies.maps.{MODEL_STUDIES[options.study or '']}").run(options, console)
