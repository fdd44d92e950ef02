# SPDX-License-Identifier: Apache-2.0
"""The animation of a replay holds one picture an instant, with every method in it once."""

import pytest

pytest.importorskip("PIL", reason="needs the 'view' extra")

from PIL import Image

from manyeyes.studies.replay_report import _Film, _select_animated


def test_an_instant_is_complete_with_its_last_method_and_the_next_begins_empty() -> None:
    film = _Film(("late", "early"))
    colours = {"late": (255, 0, 0), "early": (0, 0, 255)}
    for instant in range(3):
        for method in ("early", "late"):
            film.add(method, Image.new("RGB", (4, 2), (*colours[method][:1], instant, colours[method][2])))
            assert len(film.images) == instant + (method == "late")
    for instant, image in enumerate(film.images):
        assert image.size == (4, 4)
        assert [image.getpixel((0, y)) for y in (0, 3)] == [(255, instant, 0), (0, instant, 255)]


@pytest.mark.parametrize(
    ("methods", "animated"),
    [
        (("no-fusion", "late", "intermediate"), ("no-fusion", "intermediate")),
        (
            ("late-temporal", "intermediate-temporal", "no-fusion-temporal"),
            ("no-fusion-temporal", "intermediate-temporal"),
        ),
        (("no-fusion", "intermediate-temporal", "no-fusion-temporal"), ("no-fusion-temporal", "intermediate-temporal")),
        (("late", "intermediate-temporal"), ("intermediate-temporal",)),
        (("late", "early"), ("late",)),
    ],
)
def test_the_animated_methods_are_of_one_form(methods: tuple[str, ...], animated: tuple[str, ...]) -> None:
    assert _select_animated(methods) == animated
