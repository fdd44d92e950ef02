# SPDX-License-Identifier: Apache-2.0
"""The default corrector and its rivals by the names that a person gives them."""

from __future__ import annotations

from functools import partial

from manyeyes.alignment.decide import DETECTED, correct
from manyeyes.alignment.estimate import Corrector
from manyeyes.alignment.rivals import coalign, feaco, fpv_rcnn, given, icp, mash, v2x_reg, vips
from manyeyes.alignment.rivals.v2x_reg import V2xRegConfig
from manyeyes.datatypes import ConfigError

CORRECTORS: dict[str, Corrector] = {
    "vote": partial(correct, config=DETECTED),
    "given": given.correct,
    "coalign": coalign.correct,
    "fpv-rcnn": fpv_rcnn.correct,
    "feaco": feaco.correct,
    "icp": icp.correct,
    "vips": vips.correct,
    "v2x-reg-odist": v2x_reg.correct,
    "v2x-reg-oiou": partial(v2x_reg.correct, config=V2xRegConfig("oIoU")),
    "mash": mash.correct,
}


def corrector(name: str) -> Corrector:
    """The corrector of that name; an unknown name lists the known ones."""
    if name not in CORRECTORS:
        raise ConfigError(f"No corrector is called {name!r}; known: {', '.join(CORRECTORS)}.")
    return CORRECTORS[name]
