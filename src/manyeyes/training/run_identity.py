# SPDX-License-Identifier: Apache-2.0
"""What identifies a training run: its settings, seed and initial weights; runs of older code are compared by parsed settings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.errors import shorten
from manyeyes.models import checkpoint

_ABSENT = "absent"


@dataclass(frozen=True)
class RunIdentity:
    """Settings of a run (a frozen dataclass), its seed, and the fingerprint of its initial weights, empty for random ones."""

    config: Any
    seed: int
    begun: str = ""

    def to_record(self) -> dict[str, Any]:
        """Return the entries of a saved state that :meth:`list_differences` reads."""
        return {"config": checkpoint.config_to_json(self.config), "seed": self.seed, "begun": self.begun}

    def list_differences(self, stored: Mapping[str, Any]) -> list[str]:
        """Return in what a stored record differs, each with the stored value and that of this run; empty for the same run.

        Settings are compared parsed: fields that are newer than the record have their defaults.
        """
        try:
            config = checkpoint.config_from_json(type(self.config), str(stored.get("config")))
        except (ConfigError, ValueError) as error:
            return [f"its settings are not those of this version of manyeyes ({' '.join(str(error).split())[:300]})"]
        if config is None:
            return ["it has no settings"]
        found = list(_compare(_to_plain(config), _to_plain(self.config), ""))
        if stored.get("seed") != self.seed:
            found.append(f"the seed is {stored.get('seed')} there and {self.seed} here")
        begun = stored.get("begun") or ""
        if begun != self.begun:
            found.append(f"initial weights are {begun or 'random'} there and {self.begun or 'random'} here")
        return found


def _to_plain(config: Any) -> Any:
    """Return a configuration as a stored one is read, with all fields."""
    return json.loads(json.dumps(asdict(config)))


def _compare(stored: Any, mine: Any, path: str) -> Iterator[str]:
    """Yield the differences of two plain values, by dotted names of fields."""
    if isinstance(stored, dict) and isinstance(mine, dict):
        for name in sorted(stored.keys() | mine.keys()):
            yield from _compare(stored.get(name, _ABSENT), mine.get(name, _ABSENT), f"{path}.{name}" if path else name)
    elif stored != mine:
        yield f"{path} is {_show(stored)} there and {_show(mine)} here"


def _show(value: Any) -> str:
    return _ABSENT if value == _ABSENT else shorten(value)
