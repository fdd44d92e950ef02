# SPDX-License-Identifier: Apache-2.0
"""Types of options: annotations of bounded numbers and of paths that ``manyeyes.cli.bounds`` checks after parsing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

MAX_INT = 2**63 - 1
"""Maximum of an integer option: torch and numpy hold 64 bits."""


@dataclass(frozen=True, repr=False)
class Bounds:
    """A closed interval of finite numbers, as metadata of ``typing.Annotated``."""

    text: str
    min: float = -math.inf
    max: float = math.inf

    def contains(self, value: float) -> bool:
        """Return whether a number is finite and in the interval."""
        return math.isfinite(value) and self.min <= value <= self.max

    def __repr__(self) -> str:
        return self.text


@dataclass(frozen=True)
class PathRole:
    """How a command uses a path, as metadata of ``typing.Annotated``: an existing input, or where it writes."""

    kind: Literal["input", "input map", "output folder", "output file"]


InputPath = Annotated[Path, PathRole("input")]
InputMap = Annotated[str, PathRole("input map")]
"""A map (``manyeyes.maps.store.map_place``): the folder of 'map fuse', or a store in a folder or at a URL; @N: its release."""
OutputFolder = Annotated[Path, PathRole("output folder")]
OutputFile = Annotated[Path, PathRole("output file")]
PositiveInt = Annotated[int, Bounds("an integer from 1 to 2**63 - 1", 1, MAX_INT)]
NonNegativeInt = Annotated[int, Bounds("an integer from 0 to 2**63 - 1", 0, MAX_INT)]
Seed = Annotated[int, Bounds("an integer from 0 to 2**63 - 1", 0, MAX_INT)]
FiniteFloat = Annotated[float, Bounds("a finite number")]
NonNegativeFloat = Annotated[float, Bounds("a finite number of at least 0", 0.0)]
PositiveFloat = Annotated[float, Bounds("a finite number above 0", 5e-324)]
Fraction = Annotated[float, Bounds("a number from 0 to 1", 0.0, 1.0)]
WorkerCount = Annotated[int, Bounds("an integer from 1 to 1024", 1, 1024)]
LoaderCount = Annotated[int, Bounds("an integer from 0 to 1024", 0, 1024)]
BatchSize = Annotated[int, Bounds("an integer from 1 to 65536", 1, 65_536)]
PixelCount = Annotated[int, Bounds("an integer from 1 to 16384", 1, 16_384)]
ByteCount = Annotated[int, Bounds("an integer from 1 to 2**31 - 1", 1, 2**31 - 1)]
TrialCount = Annotated[int, Bounds("an integer from 1 to 1000000", 1, 1_000_000)]
StageCount = Annotated[int, Bounds("an integer from 1 to 64", 1, 64)]
LayerCount = Annotated[int, Bounds("an integer from 0 to 64", 0, 64)]
ChannelCount = Annotated[int, Bounds("an integer from 1 to 2048", 1, 2048)]
ImageSide = Annotated[int, Bounds("an integer from 1 to 8192", 1, 8192)]
LearningRate = Annotated[float, Bounds("a number from 0 to 100", 0.0, 100.0)]
DurationMs = Annotated[float, Bounds("a number from 0 to 3600000, milliseconds", 0.0, 3.6e6)]
DurationS = Annotated[float, Bounds("a number from 0.001 to 86400, seconds", 1e-3, 8.64e4)]
LengthM = Annotated[float, Bounds("a number from 0 to 1000, metres", 0.0, 1e3)]
AngleDeg = Annotated[float, Bounds("a number from 0 to 180, degrees", 0.0, 180.0)]
ExtentM = Annotated[float, Bounds("a number from 0.1 to 10000, metres", 0.1, 1e4)]
PortNumber = Annotated[int, Bounds("an integer from 1 to 65535", 1, 65_535)]
PlaybackRate = Annotated[float, Bounds("a number from 0.001 to 10", 1e-3, 10.0)]
AgentId = Annotated[int, Bounds("an integer from -2**31 to 2**31 - 1", -(2**31), 2**31 - 1)]
CertificateMinutes = Annotated[int, Bounds("an integer from 1 to 1440, minutes", 1, 1_440)]
CertificateDays = Annotated[int, Bounds("an integer from 1 to 45, days", 1, 45)]
OffsetM = Annotated[float, Bounds("a number from -10000 to 10000, metres", -1e4, 1e4)]
LatitudeDeg = Annotated[float, Bounds("a number from -90 to 90, degrees", -90.0, 90.0)]
LongitudeDeg = Annotated[float, Bounds("a number from -180 to 180, degrees", -180.0, 180.0)]
