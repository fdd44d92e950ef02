# SPDX-License-Identifier: Apache-2.0
"""Changes between two maps: only what both observed is new or gone, in one frame or in two."""

import numpy as np
import pytest

from manyeyes.cli import main as cli
from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.change_summary import compare_maps
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.observation_file import write_observations
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.reframe import move_to_frame
from manyeyes.maps.fusion.observed_ground import ObservedGround
from manyeyes.studies.map_folder import GROUND_FILE, read_ground, write_vector_map

pytest.importorskip("pyarrow", reason="the map extra is not installed")
FRAME, OTHER = MapFrame(48.0, 11.0), MapFrame(48.01, 11.02)


def along(y, x0, x1):
    return np.stack((np.arange(x0, x1 + 0.5, 1.0), np.full(int(x1 - x0) + 1, float(y))), 1)


def vector_map(*lines, kind: int | list[int] = DIVIDER):
    return VectorMap.of(MapElements.of(lines, kind), FRAME)


def ground(x0, x1, frame=FRAME):
    view = np.array([[x0, -20.0], [x1, -20.0], [x1, 20.0], [x0, 20.0]])
    one = Observation("a", "p", 1, np.zeros(3), np.diag([0.1, 0.1, 1e-4]), view, MapElements.empty())
    return ObservedGround.of_observations([one], frame)


# Both saw x = 60 to 100. The old map goes on to the left of it, the new one to the right; at y = 10 a line came, at y = -10 one
# went.
OLD = vector_map(along(0, 0, 100), along(-10, 70, 90))
NEW = vector_map(along(0, 60, 200), along(10, 65, 95))


@pytest.mark.parametrize("frame", [FRAME, OTHER])
def test_only_ground_that_both_observed_counts(frame):
    old = move_to_frame(OLD, frame)
    change = compare_maps(old, NEW, ground(0, 100), ground(60, 200))
    divider = next(row for row in change.kinds if row.kind == "divider")
    assert divider.added_length_m == pytest.approx(30, abs=1) and divider.removed_length_m == pytest.approx(20, abs=1)
    assert divider.outside_old_length_m == pytest.approx(100, abs=2)
    assert divider.outside_new_length_m == pytest.approx(60, abs=2)
    assert (divider.num_added, divider.num_outside_old) == (1, 1)
    assert (divider.num_removed, divider.num_outside_new) == (1, 1)
    # Pieces are in the new map's frame.
    (gone,) = change.removed
    assert np.allclose(gone[:, 1], -10, atol=0.01)
    assert max(piece[:, 0].max() for piece in change.outside_new) == pytest.approx(60, abs=1)


def test_without_grounds_everything_counts():
    divider = compare_maps(OLD, NEW).kinds[0]
    assert divider.added_length_m == pytest.approx(130, abs=2) and divider.removed_length_m == pytest.approx(80, abs=2)
    assert divider.outside_old_length_m == divider.outside_new_length_m == 0


def test_a_map_equals_itself_in_another_frame():
    m = vector_map(along(0, 0, 100), along(3.5, 0, 80), kind=[DIVIDER, BOUNDARY])
    change = compare_maps(move_to_frame(m, OTHER), m)
    assert [(row.num_unchanged, row.num_changed, row.num_added) for row in change.kinds[:2]] == [(1, 0, 0)] * 2
    assert not change.added and not change.removed


def test_ground_is_found_beside_a_map_or_taken_near_its_lines(tmp_path):
    write_vector_map(OLD, tmp_path / "city" / "map")
    assert read_ground(tmp_path / "city" / "map", OLD).is_assumed
    (tmp_path / "city" / "observations").mkdir()
    view = np.array([[0.0, -5.0], [9.0, -5.0], [9.0, 5.0], [0.0, 5.0]])
    one = Observation("a", "p", 1, np.zeros(3), np.diag([0.1, 0.1, 1e-4]), view, OLD.elements.take([]))
    write_observations(tmp_path / "city" / "observations" / "a.parquet", [one], FRAME)
    assert read_ground(tmp_path / "city" / "map", OLD).area_m2 == 90
    ground(0, 50).write(tmp_path / "city" / "map" / GROUND_FILE)
    assert read_ground(tmp_path / "city" / "map", OLD).area_m2 == 50 * 40


def test_the_command_compares_frames_and_prints_what_it_assumes(tmp_path, capsys):
    write_vector_map(OLD, tmp_path / "old" / "map")
    write_vector_map(move_to_frame(NEW, OTHER), tmp_path / "new" / "map")
    for name, runs in (("old", ground(0, 100)), ("new", ground(60, 200))):
        runs.write(tmp_path / name / "map" / GROUND_FILE)
    words = ["map", "diff", str(tmp_path / "old" / "map"), str(tmp_path / "new" / "map")]
    assert cli.main([*words, "--out", str(tmp_path / "change.html")]) == 0
    output = capsys.readouterr().out
    assert "outside old" in output and "taken to cover" not in output
    (tmp_path / "new" / "map" / GROUND_FILE).unlink()
    assert cli.main(words) == 0
    assert "new/map has no observations: it is taken to cover the ground within 10 m" in " ".join(
        capsys.readouterr().out.split("\n")
    )
