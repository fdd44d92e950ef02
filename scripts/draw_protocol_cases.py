# SPDX-License-Identifier: Apache-2.0
"""Draw the golden cases of detection protocols for docs/reference/protocol-cases.md: python scripts/draw_protocol_cases.py

Boxes and results are those of tests/evaluation/protocol_cases.py, which the tests assert; nothing is drawn by hand.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.evaluation.protocol_cases import ALL_CASES, draw_cases  # noqa: E402

if __name__ == "__main__":
    for case in ALL_CASES:
        draw_cases(case, ROOT / "docs/images" / f"{case.name}.png")
