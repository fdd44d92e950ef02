# SPDX-License-Identifier: Apache-2.0
"""Print what a bug report needs: versions, machine, extras and the commands that lack them, shipped weights, towns.

The exit code is 1 where shipped weights are missing or damaged. With --compile, compile the demo's loops ahead instead.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from manyeyes.cli.requirements import EXTRAS, REQUIREMENTS, is_installed
from manyeyes.datatypes import CheckpointError, ConfigError, ManyeyesError
from manyeyes.studies import provenance

if TYPE_CHECKING:
    from manyeyes.models.shipped import WeightsStatus


@dataclass(frozen=True)
class Options:
    """Output format and the folder of town files."""

    json: bool = False
    """Print one JSON object instead of a table."""
    towns: Path | None = None
    """A folder, a wheel of py123d or a CARLA installation with the towns' .xodr files."""
    compile: bool = False
    """Instead of the diagnosis, compile the loops of demo and view in two processes, a minute or two, so that the first run of
    these commands takes no longer than later ones. Loops that are compiled already are kept."""


@dataclass(frozen=True)
class Extra:
    """An optional group of packages. missing: modules that are not installed. commands: those that cannot run without them."""

    name: str
    missing: tuple[str, ...]
    commands: tuple[str, ...]


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of an installation."""

    versions: dict[str, str | None]
    git_commit: str | None
    system: str
    cpu: str
    cores: int
    torch_threads: int
    cuda: str
    extras: tuple[Extra, ...]
    weights: tuple[WeightsStatus, ...]
    towns: tuple[str, ...]
    towns_from: str
    package: str


def diagnose(towns: Path | None = None) -> Diagnosis:
    """Inspect this installation; nothing is changed or downloaded."""
    import torch

    found = find_towns(towns)
    return Diagnosis(
        provenance.installed_versions(),
        provenance.git_commit(),
        platform.platform(),
        provenance.cpu_name(),
        os.cpu_count() or 1,
        torch.get_num_threads(),
        f"{torch.cuda.get_device_name(0)}, CUDA {torch.version.cuda}" if torch.cuda.is_available() else "none",
        tuple(_inspect_extra(name) for name in EXTRAS),
        inspect_weights(),
        found[0],
        found[1],
        str(Path(provenance.__file__).resolve().parents[1]),
    )


def inspect_weights() -> tuple[WeightsStatus, ...]:
    """Check the shipped weights against their manifest, then load the detectors of third parties."""
    from manyeyes.models import pretrained
    from manyeyes.models.shipped import WeightsStatus, check_shipped_weights

    try:
        shipped = check_shipped_weights()
    except CheckpointError as error:
        shipped = (WeightsStatus("manifest", "", str(error)),)
    known = {status.name for status in shipped}
    return (*shipped, *(_inspect_detector(name) for name in pretrained.list_detectors() if name not in known))


def _inspect_detector(name: str) -> WeightsStatus:
    from manyeyes.models import pretrained
    from manyeyes.models.shipped import WeightsStatus

    try:
        return WeightsStatus(name, pretrained.load(name).fingerprint.hex())
    except ManyeyesError as error:
        return WeightsStatus(name, "", str(error))


def _inspect_extra(name: str) -> Extra:
    commands: list[str] = []
    for command, requirements in REQUIREMENTS.items():
        conditions = [r.condition for r in requirements if r.extra == name and r.missing]
        always = "" in conditions
        commands += [command] if always else [f"{command} ({condition})" for condition in conditions]
    missing = tuple(module for module in EXTRAS[name] if not is_installed(module))
    return Extra(name, missing, tuple(commands))


def find_towns(folder: Path | None = None) -> tuple[tuple[str, ...], str]:
    """Return the CARLA towns that can be read, and where they lie; no town, and what to do, when there is none."""
    from manyeyes.simulator.scene.towns import TOWNS, find_town

    found: list[str] = []
    places: list[str] = []
    remedy = ""
    for town in TOWNS:
        try:
            source = find_town(town, folder)
        except ConfigError as error:
            remedy = str(error)
            continue
        found.append(town)
        places.append(str(source.parent) if isinstance(source, Path) else "a wheel of py123d")
    return tuple(found), " and ".join(dict.fromkeys(places)) if found else remedy


def main(options: Options) -> None:
    """Print the diagnosis of this installation, or compile loops ahead.

    Raises:
        CheckpointError: shipped weights are missing or damaged; the diagnosis is printed before. ConfigError: both options.
    """
    if options.compile and options.json:
        raise ConfigError("--json is the form of the diagnosis; leave it out with --compile.")
    if options.compile:
        _compile_ahead(Console())
        return
    diagnosis = diagnose(options.towns)
    if options.json:
        sys.stdout.write(json.dumps(provenance.to_plain(diagnosis), indent=2) + "\n")
    else:
        Console().print(_table(diagnosis))
    if problems := [status.problem for status in diagnosis.weights if status.problem]:
        sys.stdout.flush()
        raise CheckpointError(f"{'; '.join(problems)}. Install manyeyes again: pip install --force-reinstall manyeyes")


def _compile_ahead(console: Console) -> None:
    from manyeyes.cli.compile_ahead import compile_ahead

    begin = time.monotonic()
    with console.status("Compiling loops") as status:
        compiled = compile_ahead(lambda count: status.update(f"Compiling loops: {count}"))
    if compiled is None:
        text = (
            "Nothing was compiled: loops cannot be kept, as neither the folder of the package nor the user's cache folder can be "
            "written. Set NUMBA_CACHE_DIR to a folder that can be."
        )
    else:
        text = f"{compiled.num_loops} loops compiled in {time.monotonic() - begin:.0f} s; they are kept in {compiled.folder}"
    console.print(text, highlight=False, soft_wrap=True)


def _table(diagnosis: Diagnosis) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    present = [f"{name} {version}" for name, version in diagnosis.versions.items() if version]
    lines: list[tuple[str, Any]] = [
        ("versions", ", ".join(present)),
        ("commit", diagnosis.git_commit or "not a checkout"),
        ("package", diagnosis.package),
        ("system", diagnosis.system),
        ("processor", f"{diagnosis.cpu}, {diagnosis.cores} cores; torch uses {diagnosis.torch_threads} threads"),
        ("CUDA", diagnosis.cuda),
    ]
    lines += [(f"extra {extra.name}", _describe_extra(extra)) for extra in diagnosis.extras]
    lines += [(f"weights {w.name}", w.problem or f"{w.fingerprint}, intact") for w in diagnosis.weights]
    towns = f"{', '.join(diagnosis.towns)} from {diagnosis.towns_from}" if diagnosis.towns else diagnosis.towns_from
    for name, value in (*lines, ("towns", towns)):
        # Text, not markup: the brackets of 'manyeyes[sim]' are to be seen.
        table.add_row(name, str(value).replace("[", r"\["))
    return table


def _describe_extra(extra: Extra) -> str:
    if not extra.missing:
        return "present"
    needed = f"; needed by {', '.join(extra.commands)}" if extra.commands else ""
    return f"missing {', '.join(extra.missing)}: pip install 'manyeyes[{extra.name}]'{needed}"
