# SPDX-License-Identifier: Apache-2.0
"""Print what a bug report needs: versions, machine, extras, shipped weights, towns."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from manyeyes.datatypes import ConfigError
from manyeyes.studies import provenance

EXTRAS = {
    "sim": ("libsumo", "sumo", "shapely", "pyarrow"),
    "map": ("shapely", "pyarrow", "pyogrio"),
    "view": ("matplotlib", "PIL"),
    "av2": ("pyarrow", "shapely"),
    "dask": ("dask", "distributed"),
    "ray": ("ray",),
    "icp": ("small_gicp",),
}


@dataclass(frozen=True)
class Options:
    """Output format and the folder of town files."""

    json: bool = False
    """Print one JSON object instead of a table."""
    towns: Path | None = None
    """A folder, a wheel of py123d or a CARLA installation with the towns' .xodr files."""


@dataclass(frozen=True)
class Extra:
    """An optional group of packages; missing: what is not there."""

    name: str
    missing: tuple[str, ...]


@dataclass(frozen=True)
class Weights:
    """Shipped weights, and the 8 bytes that name them on the wire."""

    name: str
    fingerprint: str


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
    weights: tuple[Weights, ...]
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
        tuple(Extra(name, tuple(m for m in modules if not _installed(m))) for name, modules in EXTRAS.items()),
        shipped_weights(),
        found[0],
        found[1],
        str(Path(provenance.__file__).resolve().parents[1]),
    )


def shipped_weights() -> tuple[Weights, ...]:
    """Return the weights inside the package, each loaded strictly."""
    from manyeyes.models import pretrained

    return tuple(Weights(name, pretrained.load(name).fingerprint.hex()) for name in pretrained.list_detectors())


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
    """Print the diagnosis of this installation."""
    diagnosis = diagnose(options.towns)
    if options.json:
        sys.stdout.write(json.dumps(provenance.to_plain(diagnosis), indent=2) + "\n")
        return
    Console().print(_table(diagnosis))


def _installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


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
    for extra in diagnosis.extras:
        remedy = f"missing {', '.join(extra.missing)}: pip install 'manyeyes[{extra.name}]'"
        lines.append((f"extra {extra.name}", remedy if extra.missing else "present"))
    weights = ", ".join(f"{w.name} ({w.fingerprint})" for w in diagnosis.weights) or "none"
    towns = f"{', '.join(diagnosis.towns)} from {diagnosis.towns_from}" if diagnosis.towns else diagnosis.towns_from
    for name, value in (*lines, ("weights", weights), ("towns", towns)):
        # Text, not markup: the brackets of 'manyeyes[sim]' are to be seen.
        table.add_row(name, str(value).replace("[", r"\["))
    return table
