# SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

from manyeyes.simulator.presets import SIMULATION_PRESETS
from manyeyes.simulator.sensors.lidars import describe_lidars

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "reference" / "lidars.md").read_text(encoding="utf-8")


def test_the_page_lists_the_sensors_of_the_table():
    (table,) = re.findall(r"<!-- lidars -->\n\n(.*?)\n\n<!-- end of lidars -->", PAGE, re.DOTALL)
    assert table == describe_lidars()


def test_the_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "docs/reference/lidars.md", "exec"), {})
    assert capsys.readouterr().out == "4 16\n"


def test_presets_of_the_protocol_exist():
    text = (DOCS / "reference" / "protocol.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:carla|sealed)-[\w-]+)`", text))
    assert named - set(SIMULATION_PRESETS) == set()
    assert len(named) >= 7
