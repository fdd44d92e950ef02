# SPDX-License-Identifier: Apache-2.0
"""Names of strategies: the two forms, and names of before; without heavy imports."""

from __future__ import annotations

TEMPORAL = "-temporal"
"""End of the names of strategies with memory."""
FORMER_NAMES = {"none": "no-fusion"}
"""Names that strategies had in stored commands and results, with today's. A stored row ``intermediate`` of before methods had
two forms is today's ``intermediate-temporal``."""


def current_name(name: str) -> str:
    """Return today's name of a strategy, of any name that it had."""
    return FORMER_NAMES.get(name, name)


def has_memory(name: str) -> bool:
    """Return whether a name is of the temporal form."""
    return name.endswith(TEMPORAL)


def form_of(name: str) -> str:
    """Return the end of a name that states its form: nothing or TEMPORAL."""
    return TEMPORAL if has_memory(name) else ""
