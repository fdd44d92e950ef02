# SPDX-License-Identifier: Apache-2.0
"""Score thresholds of methods from the results of an evaluation of other data, such as a validation split."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.operating_point import OperatingThreshold

Thresholds = dict[str, dict[str, OperatingThreshold]]
"""By method and class."""


def load_thresholds(path: Path, data: Path, split: str | None) -> Thresholds:
    """Read the thresholds of greatest F of each method and class from results.json of 'manyeyes evaluate'.

    data, split: what they will be used on.

    Raises:
        ConfigError: it is no such file, or of the same data.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        origin = stored["provenance"]["config"]["options"]
        stats: list[dict[str, Any]] = stored["result"]["stats"]
        found: Thresholds = {}
        for row in stats:
            if row["best_threshold"] is not None:
                threshold = OperatingThreshold(float(row["best_threshold"]), "validation")
                found.setdefault(row["method"], {})[row["class_name"]] = threshold
        chosen_on = (Path(origin["data"]).resolve(), origin["split"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: no results.json of 'manyeyes evaluate' with thresholds ({error!r}); evaluate a validation split, and "
            "give its file."
        ) from error
    if chosen_on == (data.resolve(), split):
        raise ConfigError(
            f"{path}: its thresholds were chosen on the same data and split; give the results of a validation split."
        )
    return found
