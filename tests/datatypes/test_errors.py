# SPDX-License-Identifier: Apache-2.0
"""Errors of worker processes arrive as they were raised."""

import pickle
from concurrent.futures import ProcessPoolExecutor

import pytest

from manyeyes.datatypes import CheckpointError, ConfigError, MissingExtraError

ERRORS = (
    MissingExtraError("sim", "traffic"),
    MissingExtraError("sim,view", "demo"),
    ConfigError("a"),
    CheckpointError("b"),
)


@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_pickling_keeps_type_and_text(error: Exception) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)


def _raise() -> None:
    raise MissingExtraError("sim", "traffic")


def test_worker_raises_missing_extra() -> None:
    with ProcessPoolExecutor(1) as pool, pytest.raises(MissingExtraError, match="traffic needs the 'sim' extra"):
        pool.submit(_raise).result(timeout=60)


def test_a_missing_extra_names_the_line_for_a_checkout_too() -> None:
    text = str(MissingExtraError("sim,view", "demo"))
    assert "pip install 'manyeyes[sim,view]'" in text and "in a checkout: pip install -e '.[sim,view]'" in text
    assert "--find-links FOLDER" in text
