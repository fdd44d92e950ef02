# SPDX-License-Identifier: Apache-2.0
"""The command ``manyeyes``: one literal table of commands; a command's module is imported when it is called, not before."""

from __future__ import annotations

import difflib
import importlib
import io
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

from manyeyes import __version__
from manyeyes.studies.catalog import STUDIES, load_options, run_study

COMMANDS = {
    "demo": "simulate a drive, run every fusion method on it, and write a table, figures, an animation and a report",
    "check": "check a recording: layout, missing files, sensors, time stamps, labels, distance from the training of weights",
    "simulate": "simulate scenes from a seed, in OPV2V's layout",
    "train": "train a detector on recordings: one stage, or all from nothing to what ships",
    "finetune": "train finished weights on over 20 to 500 labelled frames of your own sensor",
    "fit-codebook": "fit the codebook that quantises the tokens of trained weights",
    "calibrate": "calibrate the scores of trained weights, and with them the score from which boxes are drawn",
    "evaluate": "evaluate methods on a split: AP with intervals, bytes, paired differences",
    "replay": "replay your own recording as demo does",
    "export": "export detections to the result files of KITTI or nuScenes",
    "view": "draw a frame of a recording, animate a drive, or log it for the viewers rerun and Foxglove",
    "pose": "evaluate pose correction from detected objects: prior and corrected poses",
    "map": "one map from many drives: build, simulate, fuse, evaluate, diff, export, view, import, retract",
    "live": "agents as processes on a network: run one, demo of a team, map server, replay of a recorded run",
    "keys": "keys and certificates of agents on a network: make, issue, verify, revoke",
    "study": "reproduce a table or figure: robustness, bandwidth, pose noise, map fusion, ...",
    "report": "documents of results, and checks of them: docs, check-cells",
    "doctor": "print what a bug report needs",
}
COMMAND_GROUPS = {
    "map": {
        "build": "build one map of a recording, from sensor data by way of messages",
        "simulate": "simulate a fleet: observations and ground truth of a place from a seed",
        "import": "convert maps (Argoverse 2, Lanelet2, GeoPackage), or results of MapTR and StreamMapNet, to observations",
        "fuse": "fuse a folder of observations to one map",
        "retract": "remove observations from a store, and publish the map without them",
        "evaluate": "evaluate a map against the ground truth",
        "diff": "list what changed from one map to another",
        "export": "export a map: GeoJSON, GeoPackage, Lanelet2, Argoverse 2, nuScenes, PMTiles",
        "view": "draw a map as a web page (.html) that needs no internet, or as an image (.png)",
    },
    "live": {
        "run": "run one agent on a network, on the frames of a recording in real time",
        "demo": "run a whole team on this machine, a process for each agent",
        "map": "run a map server on the network: local maps of agents are fused to one map",
        "replay": "compute a recorded run again, and compare bit for bit",
        "export": "write a recorded run as a file for the viewer Foxglove",
    },
    "keys": {
        "anchor": "make an anchor, the key that all certificates are traced to, and a trust file",
        "issue": "issue a certificate of an agent, or of an issuer",
        "pool": "issue a pool of pseudonyms of one agent",
        "show": "print what a certificate states",
        "verify": "verify that a trust file admits a certificate now",
        "revoke": "revoke a certificate in a trust file",
        "trust": "print the anchors, issuers and revocations of a trust file",
        "demo": "make a whole federation for tests: anchor, issuer, trust file, agents",
    },
    "report": {
        "docs": "write tables of README and documents from stored results, or check them",
        "check-cells": "make random rows of a stored table again, and compare their numbers",
    },
    "study": {name: study.summary for name, study in STUDIES.items()},
}
MODULES = {
    "fit-codebook": "fit_codebook",
    "map import": "map import_sources",
    "report check-cells": "report check_cells",
}
"""Modules of commands whose name differs from the command."""
INTERRUPTED_EXIT_CODE = 130
_ENCODING_REMEDY = f"{sys.getfilesystemencoding()} of this environment: set PYTHONUTF8=1, or rename the file."


def make_help_text(group: str = "") -> str:
    """Make the text of ``manyeyes --help``, or the help of a group of commands."""
    table, prog = (COMMAND_GROUPS[group], f"manyeyes {group}") if group else (COMMANDS, "manyeyes")
    width = max(map(len, table)) + 2
    lines: list[str] = []
    for command, what in table.items():
        heading = f"{STUDIES[command].group}:" if group == "study" else None
        lines += [heading] if heading and heading not in lines else []
        lines.append(f"  {command.ljust(width)}{what}")
    command_lines = "\n".join(lines)
    about = (
        f"manyeyes {group}: {COMMANDS[group]}."
        if group
        else "manyeyes: collaborative perception of many agents that exchange few bytes."
    )
    return (
        f"{about}\n\nusage: {prog} COMMAND [options]\n\n{command_lines}\n\n"
        f"{prog} COMMAND --help lists the options of a command; manyeyes --version prints the version.\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code is 0, 1 for a designed error, 2 for wrong arguments, 130 after Ctrl-C."""
    argument_list = list(sys.argv[1:] if arguments is None else arguments)
    _escape_output()
    if undecoded := next((word for word in argument_list if not _is_text(word)), None):
        return _fail(f"the argument {undecoded!a} is no text in the encoding {_ENCODING_REMEDY}", 2)
    if not argument_list or argument_list[0] in ("-h", "--help", "help"):
        sys.stdout.write(make_help_text())
        return 0
    if argument_list[0] in ("-V", "--version"):
        sys.stdout.write(f"manyeyes {__version__}\n")
        return 0
    if argument_list[0] in COMMAND_GROUPS:
        return _run_group(argument_list[0], argument_list[1:])
    return (
        _run_command(argument_list[0], argument_list[1:])
        if argument_list[0] in COMMANDS
        else _report_unknown(argument_list[0], COMMANDS)
    )


def module_of(command: str) -> str:
    """Name the module that holds a command's Options and main."""
    return f"manyeyes.cli.{MODULES.get(command, command).replace(' ', '.')}"


class Command(NamedTuple):
    """A command: its options class, what runs it, and the text above its options."""

    options: type
    main: Callable[[Any], None]
    about: str


def load_command(command: str) -> Command:
    """Import what a command needs to parse its arguments."""
    group, _, name = command.partition(" ")
    if group == "study":
        return Command(load_options(name), partial(run_study, name), f"Study {name}: {STUDIES[name].summary}.")
    module = importlib.import_module(module_of(command))
    return Command(module.Options, module.main, module.__doc__ or "")


def _run_group(group: str, arguments: Sequence[str]) -> int:
    """Run a command of a group; ``map fuse`` lives in the module ``map.fuse``."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        sys.stdout.write(make_help_text(group))
        return 0
    known = COMMAND_GROUPS[group]
    return (
        _run_command(f"{group} {arguments[0]}", arguments[1:])
        if arguments[0] in known
        else _report_unknown(arguments[0], known)
    )


def _report_unknown(word: str, known: Iterable[str]) -> int:
    close = difflib.get_close_matches(word, known, 1)
    hint = f"did you mean {close[0]}? " if close else ""
    return _fail(f"there is no command {word!r}; {hint}Known commands: {', '.join(known)}.", 2)


def _run_command(command: str, arguments: Sequence[str]) -> int:
    try:
        from manyeyes.cli.arguments import UsageError, parse_options
        from manyeyes.cli.requirements import check_requirements
        from manyeyes.datatypes.errors import ManyeyesError

        options, run, about = load_command(command)
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED_EXIT_CODE)
    try:
        parsed = parse_options(options, f"manyeyes {command}", about, arguments)
        check_requirements(command, parsed)
        run(parsed)
    except UsageError as error:
        return _fail(str(error), 2)
    except ManyeyesError as error:
        return _fail(" ".join(str(error).split()), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    except UnicodeEncodeError as error:
        return _fail(f"{error.object[:200]!a} cannot be written in the encoding {_ENCODING_REMEDY}", 1)
    except MemoryError:
        return _fail("not enough memory; use fewer --workers, smaller inputs or a machine with more.", 1)
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED_EXIT_CODE)
    return 0


def _is_text(word: str) -> bool:
    """Return whether a word of the command line could be decoded: libraries take paths as UTF-8 only."""
    return not any("\ud800" <= letter <= "\udfff" for letter in word)


def _escape_output() -> None:
    """Print letters that the encoding of the output lacks as escapes instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _fail(text: str, code: int) -> int:
    sys.stderr.write(f"manyeyes: {text}\n")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
