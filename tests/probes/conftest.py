# SPDX-License-Identifier: Apache-2.0
"""Probes are short in ``make test`` and long in ``make probes``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.probes.runs import Run


IS_LONG = os.environ.get("MANYEYES_PROBES") == "long"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests marked ``long`` unless probes are long."""
    left_out = [] if IS_LONG else [item for item in items if item.get_closest_marker("long")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture(scope="session")
def is_long() -> bool:
    """Whether probes take minutes or hours instead of seconds: the environment variable MANYEYES_PROBES is ``long``."""
    return IS_LONG


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory, is_long: bool) -> Iterator[dict[str, Run]]:
    """Small commands by name, which were run once in this process: NAME-0 is the folder of each."""
    pytest.importorskip("libsumo", reason="scenarios need the sim extra")
    from tests.probes.runs import PRESET, TRAINING, make_simulation, prepare_runs

    from manyeyes.simulator.presets import SIMULATION_PRESETS
    from manyeyes.training.presets import TRAINING_PRESETS

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SIMULATION_PRESETS, PRESET, make_simulation(2 if is_long else 1))
        patch.setitem(TRAINING_PRESETS, PRESET, TRAINING)
        yield prepare_runs(tmp_path_factory.mktemp("runs"))
