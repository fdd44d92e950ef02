# SPDX-License-Identifier: Apache-2.0
"""The rate of a team's clock: real time where the team fits, slower by agents, frames and other programs."""

import pytest

from manyeyes.cli.live.rate import choose_rate


def test_a_team_that_fits_runs_in_real_time_and_others_in_slow_motion() -> None:
    assert choose_rate([0.01, 0.01], 2) == 1.0
    # Two agents of 0.2 s a frame on two cores: half of a frame of 0.1 s each.
    assert choose_rate([0.2, 0.2], 2) == pytest.approx(0.2)
    assert choose_rate([0.05, 0.2], 8) == pytest.approx(0.25)


@pytest.mark.parametrize("load", [0.5, 2.0, 8.0])
def test_agents_frames_and_other_programs_slow_it_down(load: float) -> None:
    quiet = choose_rate([0.1] * 4, 2)
    assert choose_rate([0.1] * 4, 2, load) < quiet
    assert choose_rate([0.1] * 5, 2) < quiet and choose_rate([0.2] * 4, 2) < quiet < choose_rate([0.1] * 4, 4)
