# SPDX-License-Identifier: Apache-2.0
"""Bytes of a message as the paper of its method counts them, from the contents of our messages.

They never stand in one column with bytes on the bus: papers leave out headers, poses, indices, request maps and more.

``dense map``: the whole feature map in float32, H W C 4, whatever is in it (OPV2V, V2VNet, DiscoNet, V2X-ViT, F-Cooper, CoAlign).
``cells``: features of sent cells in float32, n C 4, without indices (Where2comm, How2comm, ERMVP).
``cells and indices``: n (C + 2) 4 (CoSTr, Eq. 13; SparseAlign).
``codes``: n r log2(K) / 8, without indices (CodeFilling). ``boxes``: 7 numbers and a score in float32. ``points``: x, y, z and
intensity in float32. Source: the papers' sections on communication volume.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

PaperRule = Literal["nothing", "dense map", "cells", "cells and indices", "codes", "boxes", "points"]

_BOX_NUMBERS, _POINT_NUMBERS, _FLOAT_BYTES = 8, 4, 4
_RULES_OF_FUSIONS: dict[str, PaperRule] = {
    "max": "dense map",
    "attfuse": "dense map",
    "v2vnet": "dense map",
    "disconet": "dense map",
    "v2x-vit": "dense map",
    "where2comm": "cells",
    "how2comm": "cells",
    "ermvp": "cells",
}
"""Of the tokens of a fusion; those that are not listed count as CoSTr does."""
_RULES_OF_STRATEGIES: dict[str, PaperRule] = {
    "no-fusion": "nothing",
    "late": "boxes",
    "late-weighted": "boxes",
    "early": "points",
    "intermediate-where2comm": "cells",
    "intermediate-codefilling": "codes",
}
"""Of strategies, without the end of their form, whose count does not depend on the fusion."""


@dataclass(frozen=True)
class TokenLattice:
    """The tokens of a detector. num_cells: of the whole map; channels: of the features; code_bits: of a row of codes, without its
    proposal; 0 without a codebook.
    """

    num_cells: int
    channels: int
    code_bits: float = 0.0


def find_paper_rule(method: str, fusion: str) -> PaperRule:
    """Return how a paper counts. method: a strategy without the end of its form; fusion: a name in either mode."""
    return _RULES_OF_STRATEGIES.get(method) or _RULES_OF_FUSIONS.get(fusion.partition("/")[0], "cells and indices")


def count_paper_bytes(
    rule: PaperRule, tokens: float, objects: float, points: float, lattice: TokenLattice | None
) -> float:
    """Return the bytes of a message with that many tokens, objects and points; NaN where tokens of no known lattice count."""
    if rule == "nothing":
        return 0.0
    if rule == "boxes":
        return objects * _BOX_NUMBERS * _FLOAT_BYTES
    if rule == "points":
        return points * _POINT_NUMBERS * _FLOAT_BYTES
    if lattice is None:
        return math.nan
    if rule == "codes":
        return tokens * lattice.code_bits / 8 if lattice.code_bits else math.nan
    if rule == "dense map":
        return float(lattice.num_cells * lattice.channels * _FLOAT_BYTES)
    return tokens * (lattice.channels + 2 * (rule == "cells and indices")) * _FLOAT_BYTES
