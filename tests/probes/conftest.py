# SPDX-License-Identifier: Apache-2.0
"""Probes are short in ``make test`` and long in ``make probes``."""

import os

import pytest


@pytest.fixture(scope="session")
def is_long() -> bool:
    """Whether probes take minutes or hours instead of seconds: the environment variable MANYEYES_PROBES is ``long``."""
    return os.environ.get("MANYEYES_PROBES") == "long"
