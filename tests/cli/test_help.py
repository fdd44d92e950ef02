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


def run_help(command: tuple[str, ...]) -> tuple[str, set[str], float]:
    """Run a command with --help: its text, the modules that it imported, and its user and system time in seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-c", CODE, *command, "--help"], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    text, _, modules = done.stdout.rpartition("MODULES ")
    return text, set(modules.split()), after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize("command", [(), *COMMANDS], ids=" ".join)
def test_help_takes_less_than_half_a_second_of_cpu_time(command: tuple[str, ...]) -> None:
    for _ in range(3):
        text, modules, cpu_s = run_help(command)
        assert " ".join(("manyeyes", *command)) in text
        assert not HEAVY_MODULES & modules
        if cpu_s < MAX_CPU_S:
            return
    pytest.fail(f"manyeyes {' '.join(command)} --help took {cpu_s:.2f} s of CPU time three times.")
