# SPDX-License-Identifier: Apache-2.0
"""Optional dependencies, imported where they are used."""

from __future__ import annotations

import importlib
from typing import Any

from manyeyes.datatypes.errors import MissingExtraError


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an optional dependency.

    Args:
        module: full name, such as "shapely".
        extra: the extra of manyeyes that installs it.
        purpose: what needs it, the subject of the error's sentence.

    Raises:
        MissingExtraError: it is not installed; the text is the pip line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(extra, purpose) from error
