# SPDX-License-Identifier: Apache-2.0
"""The memory benchmark's ruler: it sees what is allocated, and its line is the one through the points."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def memory():
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("memory_benchmark", FOLDER / "memory.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


PEAKS = """
import memory, torch

for mib in (200, 50):
    print(memory.peak_of(lambda: torch.ones(mib << 18).sum()))
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory is read from /proc")
def test_the_peak_includes_released_memory():
    """In a process of its own: what other threads of the tests' process release meanwhile would be subtracted."""
    ran = subprocess.run([sys.executable, "-c", PEAKS], cwd=FOLDER, capture_output=True, text=True, check=True)
    assert [float(line) for line in ran.stdout.split()] == pytest.approx([200, 50], abs=15)


def test_the_line_is_the_one_through_the_points(memory):
    exact = [memory.Cell(1, 50.0, n, 3.0 + 2.0 * n / 1024) for n in (100, 500, 4000)]
    line = memory.line_through(exact)
    assert (line.intercept_mib, line.kib_per_token) == (pytest.approx(3.0), pytest.approx(2.0))
    assert line.r_squared == pytest.approx(1.0)
    bent = [memory.Cell(1, 50.0, n, (n / 1000) ** 2) for n in (1000, 2000, 3000, 4000)]
    # Squares 1, 4, 9, 16 about the line 5 n - 5: residuals 1, -1, -1, 1 of a variance of 129 in all.
    assert memory.line_through(bent).r_squared == pytest.approx(1 - 4 / 129)


def test_a_range_is_rounded_to_whole_cells_of_the_coarsest_stride(memory):
    grid = memory.detector_of(50.0).config.grid
    assert (grid.x_min, grid.x_max) == (pytest.approx(-25.6), pytest.approx(25.6))
    assert grid.shape[1] % 32 == 0
