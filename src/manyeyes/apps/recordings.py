# SPDX-License-Identifier: Apache-2.0
"""Opens a recording by what its folder holds, and says how long an ego waits where sweeps are not simultaneous."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datasets.dair_index import dair_root
from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.opv2v import Opv2vRecording

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.apps.playing import Playing
    from manyeyes.datasets.recording import Recording

# Half of DAIR-V2X's period: a pair's later sweep is heard, and the next pair has not begun.
PAIRS_WAIT_S = 0.05


def open_recording(root: Path, split: str | None = None) -> Opv2vRecording | DairRecording:
    """DAIR-V2X's layout where the folder has a vehicle-side or an infrastructure-side, else OPV2V's."""
    return Opv2vRecording(root, split) if dair_root(root) is None else DairRecording(root, split)


def with_patience(config: ReplayConfig, playing: Playing, recording: Recording) -> ReplayConfig:
    """The configuration with the wait that suits the recording, unless the user chose one.

    The two sweeps of a DAIR-V2X pair are some ten milliseconds apart, either way: an ego that does not wait would never
    hear an infrastructure whose sweep is the later one.
    """
    if playing.wait_ms is None and isinstance(recording, DairRecording):
        return replace(config, wait_s=PAIRS_WAIT_S)
    return config
