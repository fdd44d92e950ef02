# SPDX-License-Identifier: Apache-2.0
"""Types of bounded numbers for options: annotations that ``manyeyes.cli.bounds`` checks after parsing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

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


PositiveInt = Annotated[int, Bounds("an integer from 1 to 2**63 - 1", 1, MAX_INT)]
NonNegativeInt = Annotated[int, Bounds("an integer from 0 to 2**63 - 1", 0, MAX_INT)]
Seed = Annotated[int, Bounds("an integer from 0 to 2**63 - 1", 0, MAX_INT)]
FiniteFloat = Annotated[float, Bounds("a finite number")]
NonNegativeFloat = Annotated[float, Bounds("a finite number of at least 0", 0.0)]
PositiveFloat = Annotated[float, Bounds("a finite number above 0", 5e-324)]
Fraction = Annotated[float, Bounds("a number from 0 to 1", 0.0, 1.0)]
