# SPDX-License-Identifier: Apache-2.0
"""Counts with their nouns."""

from manyeyes._text import count_noun


def test_one_is_singular_and_thousands_are_grouped() -> None:
    assert [count_noun(n, "frame") for n in (0, 1, 2, 1200)] == ["0 frames", "1 frame", "2 frames", "1,200 frames"]
