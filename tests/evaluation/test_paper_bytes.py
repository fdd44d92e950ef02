# SPDX-License-Identifier: Apache-2.0
"""Bytes as papers count them, against the figures that they print."""

from __future__ import annotations

import math

import pytest

from manyeyes.evaluation.detection.paper_bytes import TokenLattice, count_paper_bytes, find_paper_rule

DENSE = TokenLattice(48 * 176, 256, code_bits=16)


@pytest.mark.parametrize(
    ("rule", "tokens", "expected"),
    [
        ("dense map", 7, 8_650_752),  # 2^23.04, whatever the number of tokens
        ("cells and indices", 242, 242 * 258 * 4),
        ("cells", 242, 242 * 256 * 4),
        ("codes", 242, 242 * 2),
        ("nothing", 0, 0),
    ],
)
def test_tokens_are_counted_by_the_rule(rule, tokens: int, expected: int) -> None:
    assert count_paper_bytes(rule, tokens, 0, 0, DENSE) == expected


def test_boxes_and_points_need_no_lattice() -> None:
    assert count_paper_bytes("boxes", 0, 10, 0, None) == 320
    assert count_paper_bytes("points", 0, 0, 1000, None) == 16_000
    assert math.isnan(count_paper_bytes("cells", 5, 0, 0, None))
    assert math.isnan(count_paper_bytes("codes", 5, 0, 0, TokenLattice(10, 4)))


@pytest.mark.parametrize(
    ("method", "fusion", "rule"),
    [
        ("late", "fast", "boxes"),
        ("early", "fast", "points"),
        ("no-fusion", "fast", "nothing"),
        ("intermediate", "fast", "cells and indices"),
        ("intermediate", "v2x-vit/bare", "dense map"),
        ("intermediate", "max", "dense map"),
        ("intermediate", "how2comm", "cells"),
        ("intermediate", "sparsealign/bare", "cells and indices"),
        ("intermediate-where2comm", "fast", "cells"),
        ("intermediate-codefilling", "max", "codes"),
    ],
)
def test_the_rule_is_that_of_the_paper(method: str, fusion: str, rule: str) -> None:
    assert find_paper_rule(method, fusion) == rule
