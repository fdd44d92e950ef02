# SPDX-License-Identifier: Apache-2.0
"""Other settings for the replay of a recorded run: what the agent would have perceived with them.

What it received stays as recorded: other agents do not react to what it would have sent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, get_args

from manyeyes.datatypes import ConfigError
from manyeyes.runtime.authentication import SecurityMode
from manyeyes.runtime.recorder import RunConfig


def parse_changes(changes: Sequence[str]) -> Callable[[RunConfig], RunConfig]:
    """Return what makes changes such as security=require, strategy=late, budget-bytes=2000 or pose-correction=none.

    Raises:
        ConfigError: a setting that does not exist, or a value that it cannot have; the text lists the known ones.
    """
    values = dict(_parse(change) for change in changes)
    return lambda config: replace(config, **values)


def _parse(change: str) -> tuple[str, Any]:
    name, _, text = change.partition("=")
    field = name.replace("-", "_")
    if field not in _SETTINGS or not text:
        known = ", ".join(f"{known.replace('_', '-')}={value}" for known, (_, value) in _SETTINGS.items())
        raise ConfigError(f"A change of a run is one of {known}; got {change!r}.")
    try:
        return field, _SETTINGS[field][0](text)
    except ValueError:
        raise ConfigError(f"{name} is {_SETTINGS[field][1]}; got {text!r}.") from None


def _parse_mode(text: str) -> str:
    if text not in get_args(SecurityMode):
        raise ValueError
    return text


def _parse_name(text: str) -> str | None:
    return None if text == "none" else text


def _parse_bytes(text: str) -> int | None:
    if text == "none":
        return None
    if int(text) <= 0:
        raise ValueError
    return int(text)


_SETTINGS: dict[str, tuple[Callable[[str], Any], str]] = {
    "security": (_parse_mode, "|".join(get_args(SecurityMode))),
    "strategy": (str, "NAME"),
    "budget_bytes": (_parse_bytes, "BYTES|none"),
    "pose_correction": (_parse_name, "NAME|none"),
    "misbehaviour": (_parse_name, "NAME|none"),
}
"""Settings that can be changed: how their text is read, and what it is."""
