# SPDX-License-Identifier: Apache-2.0
"""The Python of the guide on live agents runs as it stands there."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "guides" / "live.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_code_of_the_guide_runs(capsys) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "live.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert 1 <= len(lines) <= 5 and all(re.fullmatch(r"\d+ \d+", line) for line in lines)
