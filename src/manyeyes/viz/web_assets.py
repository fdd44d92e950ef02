# SPDX-License-Identifier: Apache-2.0
"""Files of web pages inside the package, and JSON that a page can hold."""

from __future__ import annotations

import json
from importlib import resources


def read_asset(name: str) -> str:
    """Return a file of this package as text that a page can hold, without comments that point to a source map."""
    text = (resources.files("manyeyes.viz") / name).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("//# sourceMappingURL=")]
    return "\n".join(lines).replace("</script", "<\\/script")


def to_safe_json(value: object) -> str:
    """Return JSON that cannot end the script element that holds it."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
