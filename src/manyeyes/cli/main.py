# SPDX-License-Identifier: Apache-2.0
"""The command ``manyeyes``: one literal table of verbs; a verb's module is imported when it is called, not before."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Iterable, Sequence

from manyeyes import __version__

VERBS = {
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
GROUPS = {
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
INTERRUPTED = 130


def help_text(group: str = "") -> str:
    """What ``manyeyes --help`` prints, or the help of a group of verbs."""
    table, prog = (GROUPS[group], f"manyeyes {group}") if group else (VERBS, "manyeyes")
    width = max(map(len, table)) + 2
    verbs = "\n".join(f"  {verb.ljust(width)}{what}" for verb, what in table.items())
    about = (
        f"manyeyes {group}: {VERBS[group]}."
        if group
        else "manyeyes: many agents, each with its own eyes and few bytes to say what it sees."
    )
    return (
        f"{about}\n\nusage: {prog} VERB [options]\n\n{verbs}\n\n"
        f"{prog} VERB --help lists the options of a verb; manyeyes --version prints the version.\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb; the exit code is 0, 1 for a designed error, 2 for wrong arguments, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(help_text())
        return 0
    if words[0] in ("-V", "--version"):
        sys.stdout.write(f"manyeyes {__version__}\n")
        return 0
    if words[0] in GROUPS:
        return _group(words[0], words[1:])
    return _run(words[0], words[1:]) if words[0] in VERBS else _unknown(words[0], VERBS)


def module_of(verb: str) -> str:
    """The module that holds a verb's Options and main."""
    return f"manyeyes.cli.{MODULES.get(verb, verb).replace(' ', '.')}"


def _group(group: str, words: Sequence[str]) -> int:
    """A verb of a group, such as ``map fuse``, lives in the module ``map.fuse``."""
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(help_text(group))
        return 0
    known = GROUPS[group]
    return _run(f"{group} {words[0]}", words[1:]) if words[0] in known else _unknown(words[0], known)


def _unknown(word: str, known: Iterable[str]) -> int:
    close = difflib.get_close_matches(word, known, 1)
    hint = f"did you mean {close[0]}? " if close else ""
    return _fail(f"there is no verb {word!r}; {hint}Known verbs: {', '.join(known)}.", 2)


def _run(verb: str, words: Sequence[str]) -> int:
    try:
        import tyro

        from manyeyes.datatypes.errors import ManyeyesError

        module = importlib.import_module(module_of(verb))
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED)
    try:
        # Options of a nested dataclass keep their short names: --channel, not --playing.channel.
        looks = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
        prog, about = f"manyeyes {verb}", module.__doc__
        module.main(tyro.cli(module.Options, args=list(words), prog=prog, description=about, config=looks))
    except ManyeyesError as error:
        return _fail(" ".join(str(error).split()), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    except KeyboardInterrupt:
        return _fail("stopped.", INTERRUPTED)
    return 0


def _fail(text: str, code: int) -> int:
    sys.stderr.write(f"manyeyes: {text}\n")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
