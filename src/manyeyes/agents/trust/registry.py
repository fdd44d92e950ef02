# SPDX-License-Identifier: Apache-2.0
"""Misbehaviour detectors by name: ours, and those of third parties (entry points of the group manyeyes.misbehaviour)."""

from __future__ import annotations

from collections.abc import Callable

from manyeyes.agents.trust.interface import MisbehaviourDetector
from manyeyes.datatypes.registry import Registry

_DETECTORS: Registry[Callable[[], MisbehaviourDetector]] = Registry(
    "misbehaviour detector", "manyeyes.misbehaviour", "manyeyes.agents.trust.detectors"
)

register_misbehaviour_detector = _DETECTORS.register
"""Return a decorator that registers a misbehaviour detector, a class or function without arguments, under a name."""
list_misbehaviour_detectors = _DETECTORS.names


def get_misbehaviour_detector(name: str) -> MisbehaviourDetector:
    """Make the misbehaviour detector of a name, with its default settings.

    Raises:
        ConfigError: none has the name.
    """
    return _DETECTORS.get(name)()
