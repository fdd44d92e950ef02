# SPDX-License-Identifier: Apache-2.0
"""The command ``manyeyes``: one literal table of verbs; a verb's module is imported when it is called, not before."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence

from manyeyes import __version__

VERBS = {
    "demo": "make a drive, share bytes, perceive, judge: table, pictures, animation, report",
    "simulate": "make scenes from a seed, in OPV2V's layout",
    "train": "train a detector on a recording",
    "evaluate": "judge methods on a split: AP with intervals, bytes, paired differences",
    "run": "replay your own OPV2V-format recording as demo does",
    "view": "draw a frame of a recording, or animate a drive",
    "doctor": "print what a bug report needs",
}
INTERRUPTED = 130


def help_text() -> str:
    """What ``manyeyes --help`` prints."""
    width = max(map(len, VERBS)) + 2
    verbs = "\n".join(f"  {verb.ljust(width)}{what}" for verb, what in VERBS.items())
    return (
        "manyeyes: many agents, each with its own eyes and few bytes to say what it sees.\n\n"
        f"usage: manyeyes VERB [options]\n\n{verbs}\n\n"
        "manyeyes VERB --help lists the options of a verb; manyeyes --version prints the version.\n"
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
    if words[0] not in VERBS:
        close = difflib.get_close_matches(words[0], VERBS, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        return _fail(f"there is no verb {words[0]!r}; {hint}Known verbs: {', '.join(VERBS)}.", 2)
    return _run(words[0], words[1:])


def _run(verb: str, words: Sequence[str]) -> int:
    try:
        import tyro

        from manyeyes.datatypes.errors import ManyeyesError

        module = importlib.import_module(f"manyeyes.apps.{verb}")
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
