# SPDX-License-Identifier: Apache-2.0
"""The command ``manyeyes``: one literal table of verbs; a verb's module is imported when it is called, not before."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Iterable, Sequence

from manyeyes import __version__

COMMANDS = {
    "demo": "make a drive, share bytes, perceive, judge: table, pictures, animation, report",
    "simulate": "make scenes from a seed, in OPV2V's layout",
    "train": "train a detector on a recording",
    "quantise": "fit the codebook by which trained weights send few bytes",
    "evaluate": "judge methods on a split: AP with intervals, bytes, paired differences",
    "run": "replay your own OPV2V-format recording as demo does",
    "view": "draw a frame of a recording, or animate a drive",
    "align": "where agents are, from what they detect: claimed and corrected poses judged",
    "map": "one map from many drives: build, simulate, fuse, evaluate, diff, export, view, import, retract",
    "doctor": "print what a bug report needs",
}
COMMAND_GROUPS = {
    "map": {
        "build": "a recording's sensors become elements, messages, and one map",
        "simulate": "send a crowd through a place: observations and truth from a seed",
        "import": "result files of MapTR or StreamMapNet with their poses become observations",
        "fuse": "one map of a folder of observations",
        "retract": "take observations of a store back, and publish the map without them",
        "evaluate": "judge a map against the truth, or methods in a study",
        "diff": "what changed from one map to another",
        "export": "GeoJSON, GeoPackage, Lanelet2, Argoverse 2, nuScenes, PMTiles",
        "view": "a web page (.html) that needs no internet, or a picture (.png)",
    },
}
MODULES = {"run": "replay", "align": "pose", "quantise": "fit_codebook", "map import": "map import_predictions"}
"""The modules of verbs that are called otherwise."""
INTERRUPTED_EXIT_CODE = 130


def make_help_text(group: str = "") -> str:
    """What ``manyeyes --help`` prints, or the help of a group of verbs."""
    table, prog = (COMMAND_GROUPS[group], f"manyeyes {group}") if group else (COMMANDS, "manyeyes")
    width = max(map(len, table)) + 2
    command_lines = "\n".join(f"  {command.ljust(width)}{what}" for command, what in table.items())
    about = (
        f"manyeyes {group}: {COMMANDS[group]}."
        if group
        else "manyeyes: many agents, each with its own eyes and few bytes to say what it sees."
    )
    return (
        f"{about}\n\nusage: {prog} VERB [options]\n\n{command_lines}\n\n"
        f"{prog} VERB --help lists the options of a verb; manyeyes --version prints the version.\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb; the exit code is 0, 1 for a designed error, 2 for wrong arguments, 130 after Ctrl-C."""
    argument_list = list(sys.argv[1:] if arguments is None else arguments)
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


def module_of(verb: str) -> str:
    """The module that holds a verb's Options and main."""
    return f"manyeyes.cli.{MODULES.get(verb, verb).replace(' ', '.')}"


def _run_group(group: str, arguments: Sequence[str]) -> int:
    """A verb of a group, such as ``map fuse``, lives in the module ``map.fuse``."""
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
    return _fail(f"there is no verb {word!r}; {hint}Known verbs: {', '.join(known)}.", 2)


def _run_command(command: str, arguments: Sequence[str]) -> int:
    try:
        import tyro

        from manyeyes.datatypes.errors import ManyeyesError

        module = importlib.import_module(module_of(command))
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED_EXIT_CODE)
    try:
        # Options of a nested dataclass keep their short names: --channel, not --playing.channel.
        tyro_config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
        prog, about = f"manyeyes {command}", module.__doc__
        module.main(tyro.cli(module.Options, args=list(arguments), prog=prog, description=about, config=tyro_config))
    except ManyeyesError as error:
        return _fail(" ".join(str(error).split()), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED_EXIT_CODE)
    return 0


def _fail(text: str, code: int) -> int:
    sys.stderr.write(f"manyeyes: {text}\n")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
