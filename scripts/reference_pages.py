# SPDX-License-Identifier: Apache-2.0
"""Write the generated pages of docs/reference from the code: command line, presets, and the list of public names.

python scripts/reference_pages.py          writes them
python scripts/reference_pages.py --check  fails where a stored page differs
"""

from __future__ import annotations

import ast
import dataclasses
import re
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro

from manyeyes._lazy import Definition, find_public_names
from manyeyes.agents.strategies.registry import list_strategies
from manyeyes.cli.arguments import PARSER_CONFIG
from manyeyes.cli.main import COMMAND_GROUPS, COMMANDS, Command, load_command
from manyeyes.comms.channel import CHANNELS
from manyeyes.evaluation.detection.protocols import PROTOCOLS
from manyeyes.maps.registry import list_map_fusions
from manyeyes.models.fusion.registry import list_fusion_modules
from manyeyes.models.pretrained import list_detectors
from manyeyes.simulator.fleet import CROWDS, PLACES
from manyeyes.simulator.presets import SIMULATION_PRESETS, SimulationPreset
from manyeyes.training.presets import TRAINING_PLANS, TRAINING_PRESETS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "manyeyes"
REFERENCE = ROOT / "docs" / "reference"
GENERATED = "<!-- written by scripts/reference_pages.py -->"


def escape(text: str) -> str:
    """Escape a text for a cell of a table, and for Markdown that reads angle brackets and underscores."""
    return re.sub(r"([|<>*_\[\]])", r"\\\1", " ".join(text.split()))


def format_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table of Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def list_options(command: Command) -> list[tuple[str, str, str, str]]:
    """List name, values, default and help of each option of a command, as the parser has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(command.options, config=PARSER_CONFIG)
    out = []
    for action in parser._actions:
        name = ", ".join(f"`{option}`" for option in action.option_strings) or f"`{action.metavar}`"
        if "--help" in name:
            continue
        text, _, default = str(action.help).rpartition(" (")
        default = default.removesuffix(")").removeprefix("default: ")
        metavar = action.metavar if isinstance(action.metavar, str) and action.option_strings else ""
        if not metavar and action.option_strings:
            default = {"True": "on", "False": "off"}[default]  # a flag
        metavar = metavar.replace("{None}|", "").replace("None,", "").replace("|", " or ")
        out.append((name, f"`{metavar}`" if metavar else "", f"`{default}`" if default else "", escape(text)))
    return out


def describe_command(name: str) -> str:
    """Describe one command: its text and the table of its options."""
    command = load_command(name)
    table = format_table(
        ("option", "value", "default", "meaning"),
        list_options(command),
    )
    about = "\n\n".join(escape(part) for part in command.about.strip().split("\n\n") if not part.startswith("    "))
    return f"## manyeyes {name}\n\n{about}\n\n{table}\n"


def make_command_line() -> str:
    """Make the page of the command line."""
    names = [name for name in COMMANDS if name not in COMMAND_GROUPS]
    parts = [
        f"# Command line\n\n{GENERATED}\n",
        "`manyeyes COMMAND --help` prints the same in a terminal. `required` stands where an option has no default; a name in\n"
        "capitals is positional. What commands are for: [commands](../guides/commands.md).\n",
        *map(describe_command, names),
    ]
    for group, commands in COMMAND_GROUPS.items():
        parts += [describe_command(f"{group} {name}") for name in commands]
    return "\n".join(parts)


def describe_simulation(preset: SimulationPreset) -> str:
    """Describe the splits of a preset: number of scenes and towns."""
    return "; ".join(f"{part.split} {part.count} ({shorten(part.towns)})" for part in preset.splits)


def shorten(names: Sequence[str]) -> str:
    """List names, of more than six the first and the last."""
    return ", ".join(names) if len(names) <= 6 else f"{names[0]} to {names[-1]}"


def describe_training(config: Any) -> tuple[str, str, str]:
    """Describe a training preset: steps or epochs, samples of a batch, what it trains."""
    steps = f"{config.steps:,}" if config.steps else f"{getattr(config, 'epochs', 0):g} epochs"
    detector = getattr(config, "detector", None)
    kind = type(config).__name__.removesuffix("TrainConfig")
    what = f"{kind}, fusion {detector.fusion}" if detector is not None else kind
    return steps, str(config.batch), what


def describe_protocol(protocol: Any) -> str:
    """List the settings of a protocol that differ from those of global-sort."""
    base = PROTOCOLS["global-sort"]
    differing = [
        f"{field.name} {getattr(protocol, field.name)}"
        for field in dataclasses.fields(protocol)
        if field.name != "name" and getattr(protocol, field.name) != getattr(base, field.name)
    ]
    return escape("; ".join(differing) or "the reference of this column")


def make_presets() -> str:
    """Make the page of presets: every name that an option takes."""
    names: Mapping[tuple[str, str], Sequence[str]] = {
        ("Strategies", "--methods"): list_strategies(),
        ("Fusion modules", "--fusion"): list_fusion_modules(),
        ("Detectors that ship", "--weights"): list_detectors(),
        ("Methods of map fusion", "--method"): list_map_fusions(),
        ("Policies of a simulated fleet", "map simulate --crowd"): tuple(CROWDS),
        ("Places of a simulated fleet", "map simulate PLACE"): tuple(PLACES),
    }
    simulation = format_table(
        ("preset", "scenes by split (towns)", "frames", "LiDAR"),
        (
            (f"`{name}`", describe_simulation(preset), str(preset.frames), f"`{preset.lidar}`")
            for name, preset in SIMULATION_PRESETS.items()
        ),
    )
    plans = format_table(
        ("plan", "stages", "steps together"),
        (
            (f"`{name}`", str(len(plan.stages)), f"{sum(stage.steps for _, stage in plan.stages):,}")
            for name, plan in TRAINING_PLANS.items()
        ),
    )
    training = format_table(
        ("preset", "steps", "batch", "trains"),
        ((f"`{name}`", *describe_training(config)) for name, config in TRAINING_PRESETS.items()),
    )
    channels = format_table(
        ("channel", "Mb/s", "largest packet [B]", "base latency [ms]", "jitter [ms]"),
        (
            (f"`{c.name}`", f"{c.rate_bps / 1e6:g}", str(c.mtu), f"{c.base_latency_s * 1e3:g}", f"{c.jitter_s * 1e3:g}")
            for c in CHANNELS
        ),
    )
    protocols = format_table(
        ("protocol", "settings that differ from `global-sort`"),
        ((f"`{name}`", describe_protocol(protocol)) for name, protocol in PROTOCOLS.items()),
    )
    parts = [
        f"# Presets\n\n{GENERATED}\n\nEvery name that an option of the command line takes.\n",
        f"## Recordings\n\n`manyeyes simulate --preset`\n\n{simulation}\n",
        f"## Plans of training\n\n`manyeyes train --preset`; a stage is a preset, too: `costr-small/stage1`.\n\n{plans}\n",
        f"## Presets of training\n\n{training}\n",
        f"## Channels\n\n`--channel`\n\n{channels}\n",
        f"## Protocols\n\n`--protocol`\n\n{protocols}\n",
        *(
            f"## {title}\n\n`{option}`: {', '.join(f'`{name}`' for name in sorted(listed))}\n"
            for (title, option), listed in names.items()
        ),
    ]
    return "\n".join(parts)


def read_public_names(package: str) -> dict[str, Definition]:
    """Read the public names of a package from its source; "" is manyeyes itself."""
    return find_public_names(ast.parse((PACKAGE / package / "__init__.py").read_text(encoding="utf-8")))


def list_packages() -> list[str]:
    """List the packages with public names."""
    folders = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
    return [name for name in folders if read_public_names(name)]


def make_api_pages() -> dict[str, str]:
    """Make a page for each package that defines public names, and an index of those of ``manyeyes``."""
    top = read_public_names("")
    members: dict[str, dict[str, Definition]] = {}
    for definition in (*top.values(), *(d for p in list_packages() for d in read_public_names(p).values())):
        package = definition.module.split(".")[1]
        members.setdefault(package, {})[f"{definition.module}.{definition.name}"] = definition
    pages = {
        f"api/{package}.md": f"# manyeyes.{package}\n\n{GENERATED}\n\n"
        + "\n".join(f"::: {path}\n" for path in sorted(found))
        for package, found in members.items()
    }
    rows = []
    for name, definition in sorted(top.items(), key=lambda item: item[0].lower()):
        rows.append((f"[`{name}`]({definition.module.split('.')[1]}.md)", f"`{definition.module}`"))
    table = format_table(("name", "module"), rows)
    about = "Names that `import manyeyes` gives, in metres, radians and nanoseconds ([conventions](../../concepts/conventions.md))."
    pages["api/index.md"] = f"# Public names\n\n{GENERATED}\n\n{about}\n\n{table}\n"
    return dict(sorted(pages.items()))


def make_pages() -> dict[str, str]:
    """Make every generated page, by its path in docs/reference."""
    return {"command-line.md": make_command_line(), "presets.md": make_presets(), **make_api_pages()}


def main(arguments: Sequence[str]) -> int:
    """Write the pages, or list those that differ; the exit code is 1 where one does."""
    differing = []
    for name, text in make_pages().items():
        path = REFERENCE / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            differing.append(name)
            if "--check" not in arguments:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    if differing:
        print(f"{'differ' if '--check' in arguments else 'written'}: {', '.join(differing)}")
    return int("--check" in arguments and bool(differing))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
