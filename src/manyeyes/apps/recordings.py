# SPDX-License-Identifier: Apache-2.0
"""Opens a recording by what its folder holds, and suits the replay to it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datasets.dair_index import dair_root
from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.apps.playing import Playing
    from manyeyes.datasets.recording import Recording

# Half of DAIR-V2X's period: a pair's later sweep is heard, and the next pair has not begun.
PAIRS_WAIT_S = 0.05


def open_recording(root: Path, split: str | None = None, images: bool = False) -> Opv2vRecording | DairRecording:
    """DAIR-V2X's layout where the folder has a vehicle-side or an infrastructure-side, else OPV2V's.

    images: with what cameras took, which is read of OPV2V's layout only.
    """
    if dair_root(root) is None:
        return Opv2vRecording(root, split, images=images)
    if images:
        raise ConfigError(f"{root}: pictures are read in OPV2V's layout only; choose a model of agents with LiDAR.")
    return DairRecording(root, split)


def suited_to(config: ReplayConfig, playing: Playing, recording: Recording) -> ReplayConfig:
    """The configuration with the wait and the reach that suit the recording; a wait that the user chose stays.

    The two sweeps of a DAIR-V2X pair are some ten milliseconds apart, either way: an ego that does not wait would never
    hear an infrastructure whose sweep is the later one. And its pairs collaborate at any distance, by its own protocol.
    """
    if not isinstance(recording, DairRecording):
        return config
    return replace(config, reach_m=math.inf, wait_s=config.wait_s if playing.wait_ms is not None else PAIRS_WAIT_S)
