# SPDX-License-Identifier: Apache-2.0
"""Tables of model cards are those of their stored results."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS, RESULTS = ROOT / "src/manyeyes/models/weights", ROOT / "benchmarks/results"
CARDS = [card for card in sorted(WEIGHTS.glob("*.md")) if (RESULTS / card.stem).is_dir()]


def test_some_cards_have_stored_results() -> None:
    assert "costr-sensors" in {card.stem for card in CARDS}


@pytest.mark.slow
@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.stem)
def test_a_card_is_that_of_its_results(card: Path) -> None:
    words = [sys.executable, ROOT / "scripts/model_card.py", card, RESULTS / card.stem, "--check"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
