# SPDX-License-Identifier: Apache-2.0
"""The help of every command is fast: CPU time of a process of its own, and nothing heavy is imported."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

from manyeyes.cli import main as cli

COMMANDS = [(name,) for name in cli.COMMANDS]
COMMANDS += [(group, name) for group, names in cli.COMMAND_GROUPS.items() for name in names]
HEAVY_MODULES = {"torch", "numpy", "numba", "scipy", "safetensors", "matplotlib", "pyarrow", "shapely"}
MAX_CPU_S = 0.5
CODE = """
import atexit, sys
atexit.register(lambda: print("MODULES", *sys.modules))
from manyeyes.cli.main import main
raise SystemExit(main(sys.argv[1:]))
"""


def measure_cpu_s(*arguments: str) -> tuple[str, float]:
    """Run Python in a process of its own: its output, and its user and system time in seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done.stdout, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize("command", [(), *COMMANDS], ids=" ".join)
def test_help_takes_less_than_half_a_second_of_cpu_time(command: tuple[str, ...]) -> None:
    """On a machine whose cores others use, too, the import of tyro alone (0.13 s), measured in turn, is the unit."""
    for _ in range(3):
        output, cpu_s = measure_cpu_s("-c", CODE, *command, "--help")
        text, _, modules = output.rpartition("MODULES ")
        assert " ".join(("manyeyes", *command)) in text
        assert not HEAVY_MODULES & set(modules.split())
        if cpu_s < MAX_CPU_S or cpu_s < MAX_CPU_S / 0.13 * measure_cpu_s("-c", "import tyro")[1]:
            return
    pytest.fail(f"manyeyes {' '.join(command)} --help took {cpu_s:.2f} s of CPU time three times.")
