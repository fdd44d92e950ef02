# SPDX-License-Identifier: Apache-2.0
"""Every numbered example runs as a script."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = REPOSITORY.parent / "shared" / "data"


def run(example: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, str(REPOSITORY / "examples" / example), *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here() -> None:
    tested = Path(__file__).read_text()
    examples = sorted(p.name for p in (REPOSITORY / "examples").glob("[0-9]*.py"))
    assert examples
    assert [name for name in examples if f'run("{name}"' not in tested] == []


@pytest.mark.slow
def test_01_two_agents() -> None:
    alone, helped = run("01_two_agents.py").strip().splitlines()
    # Houses occlude the four cars of the side streets; the roadside unit at the corner detects them.
    assert alone.startswith("alone: 3 of 7 cars") and alone.endswith("[(31, 14), (27, 24), (27, -15), (31, -26)]")
    assert 80 < int(helped.split()[1]) < 2000 and ": 7 of 7 cars" in helped and helped.endswith("[]")
    assert all(int(line.split(" cars, ")[1].split()[0]) <= 1 for line in (alone, helped))


@pytest.mark.slow
def test_02_evaluate_recording(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    out = run("02_evaluate_recording.py", str(tmp_path / "drive"))
    rows = [line.split() for line in out.strip().splitlines()]
    assert [row[0] for row in rows] == ["no-fusion", "late", "intermediate", "early"]
    # Collaboration helps clearly on this drive, and its gain is that of the AP.
    ap = [float(row[2]) for row in rows]
    assert all(other > ap[0] + 0.15 for other in ap[1:]) and int(rows[2][5]) < 10_000
    assert [float(row[-1]) for row in rows[1:]] == pytest.approx([value - ap[0] for value in ap[1:]], abs=0.0011)


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "av2").is_dir(), reason="../shared/data/av2 is not beside this repository")
def test_03_argoverse2(tmp_path: Path) -> None:
    picture = tmp_path / "pair.png"
    alone, helped, both, _ = run("03_argoverse2.py", str(SHARED / "av2"), str(picture)).strip().splitlines()
    assert "all 99229 points" in both
    found = [int(line.split(": ")[1].split()[0]) for line in (alone, helped, both)]
    false = [int(line.split(", ")[-1].split()[0]) for line in (alone, helped, both)]
    # The message is worth as much as all points of the other LiDAR, within one vehicle.
    assert found[1] >= found[0] + 4 and abs(found[2] - found[1]) <= 1 and false[1] <= false[0]
    assert 1000 < int(helped.split()[1]) < 10_000
    assert picture.stat().st_size > 50_000


@pytest.mark.slow
def test_04_map_fusion(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
    pytest.importorskip("shapely", reason="the 'map' extra is not installed")
    page = tmp_path / "crossroads.html"
    fused, union, last = run("04_map_fusion.py", str(page)).strip().splitlines()
    assert fused.startswith("fused: ") and union.startswith("union: ") and last.startswith("wrote ")
    assert float(fused.split("mAP ")[1][:4]) > float(union.split("mAP ")[1][:4])
    assert page.stat().st_size > 1_000_000


@pytest.mark.slow
def test_05_delay_and_bandwidth(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    lines = run("05_delay_and_bandwidth.py", str(tmp_path / "drive")).strip().splitlines()
    budgets, received = ([int(line.split()[k]) for line in lines] for k in (2, 6))
    found = [int(line.split(": ")[1].split("%")[0]) for line in lines]
    assert budgets == [0, 300, 600, 1200, 4096] and received[0] == 0
    # Three senders at most stay in the budget; a few hundred bytes bring most of the gain.
    assert all(0 < got <= 3 * budget for got, budget in zip(received[1:], budgets[1:])) and received == sorted(received)
    assert found[1] >= found[0] + 10 and found[-1] >= found[1]


@pytest.mark.slow
def test_06_map_server() -> None:
    *lines, last = run("06_map_server.py").strip().splitlines()
    score = [float(line.rsplit("mAP ", 1)[1]) for line in (*lines, last)]
    assert len(lines) == 8 and " 96 messages" in lines[-1]
    assert score[-1] > 0.9 and score[-2] > 0.8 > score[0]


@pytest.mark.slow
def test_07_map_model(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    picture = tmp_path / "street.png"
    single, several = run("07_map_model.py", str(picture)).strip().splitlines()
    assert single.startswith("1 frames") and several.startswith("5 frames")
    # The AP of dividers is higher from five frames than from one.
    assert float(several.split("divider ")[1].split(",")[0]) > float(single.split("divider ")[1].split(",")[0])
    assert picture.stat().st_size > 10_000


def read_code_blocks(guide: Path) -> list[str]:
    """The blocks of Python in a page."""
    return [block.split("```")[0] for block in guide.read_text().split("```python\n")[1:]]


@pytest.mark.parametrize(
    ("guide", "example", "package"),
    [
        ("own-detector.md", "08_own_detector.py", "own_detector"),
        ("own-method.md", "09_own_method.py", "own_method"),
        ("own-data.md", "10_own_data.py", "own_reader"),
    ],
)
def test_the_code_of_a_guide_is_that_of_its_example_and_package(guide: str, example: str, package: str) -> None:
    text, code = (REPOSITORY / "docs" / "guides" / guide).read_text(), (REPOSITORY / "examples" / example).read_text()
    blocks = read_code_blocks(REPOSITORY / "docs" / "guides" / guide)
    absent = [block for block in blocks if block not in code and textwrap.indent(block, "    ") not in code]
    assert len(blocks) >= 2 and absent == []
    assert (REPOSITORY / "tests" / "plugins" / package / "pyproject.toml").read_text() in text


@pytest.mark.slow
def test_08_own_detector(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    heading, *rows = run("08_own_detector.py", str(tmp_path / "drive")).strip().splitlines()[-4:]
    assert heading.split()[0] == "method" and [row.split()[0] for row in rows] == ["no-fusion", "late", "early"]
    ap = [float(row.split()[1]) for row in rows]
    assert 0.1 < ap[0] < ap[1] < ap[2]


@pytest.mark.slow
def test_09_own_method(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    *_, first, second = run("09_own_method.py", str(tmp_path / "drive")).strip().splitlines()
    assert [row.split()[0] for row in (first, second)] == ["intermediate", "moving-first"]
    assert all(0 < int(row.split()[-1]) <= 1000 for row in (first, second)) and first.split()[1:] != second.split()[1:]


@pytest.mark.slow
def test_10_own_data(tmp_path: Path) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    opened, heading, *rows = run("10_own_data.py", str(tmp_path / "drive")).strip().splitlines()[-5:]
    assert opened.split()[0] == "NpzRecording" and heading.split()[0] == "method"
    assert [row.split()[0] for row in rows] == ["no-fusion", "late", "early"]
    assert all(float(row.split()[1]) > 0.5 for row in rows)


def test_12_false_claim(tmp_path: Path) -> None:
    rows = run("12_false_claim.py", str(tmp_path / "claim.png")).strip().splitlines()
    assert len(rows) == 3 and all("agent 1 normal" in row and "[(15, 2), (28, 11)]" in row for row in rows)
    assert "agent 2 malicious" in rows[2] and (tmp_path / "claim.png").is_file()


@pytest.mark.slow
def test_11_live_agents(tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="the 'live' extra is not installed")
    rows = sorted(run("11_live_agents.py", str(tmp_path / "keys")).strip().splitlines())
    assert [row.partition(":")[0] for row in rows] == ["agent 1", "agent 2"]
    assert all(row.endswith("[(10, 0), (20, 4)]") for row in rows)


@pytest.mark.slow
def test_12_correct_pose(tmp_path: Path) -> None:
    picture = tmp_path / "pose.png"
    status, accuracy, _, _ = run("12_correct_pose.py", str(picture)).strip().splitlines()
    assert int(status.split()[1]) >= 7 and status.endswith("common objects")
    assert float(accuracy.split()[2]) < 0.5
    assert picture.stat().st_size > 5_000
