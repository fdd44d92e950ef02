# SPDX-License-Identifier: Apache-2.0
"""Pack what a training run needs to go on into small files, and unpack it again, for example to keep it in a repository.

python scripts/pack_run.py pack runs/costr-small kept
python scripts/pack_run.py unpack kept runs/costr-small

The folder of a run is that of one stage or of a plan. Of a finished stage its weights.safetensors is copied, of an unfinished one
last.pt becomes last.packed, of at most 10 MB. The unpacked run is not bit by bit the packed one: averaged weights and moments of
Adam are rounded (manyeyes.training.packed_state). A running one may be packed, since its files are replaced whole. Packed states of
stages that have ended since are removed. Unpacking keeps what the run has already.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from manyeyes._io import atomic_write
from manyeyes.datatypes import ManyeyesError
from manyeyes.training.packed_state import pack_state, unpack_state

WEIGHTS, STATE, PACKED = "weights.safetensors", "last.pt", "last.packed"


def pack_run(run: Path, out: Path) -> list[Path]:
    """Pack the folder of a run; returns the files that were written."""
    written: list[Path] = []
    for folder in (run, *sorted(path for path in run.iterdir() if path.is_dir())):
        kept = out / folder.relative_to(run)
        if (folder / WEIGHTS).exists():
            atomic_write(kept / WEIGHTS, (folder / WEIGHTS).read_bytes())
            (kept / PACKED).unlink(missing_ok=True)
            written.append(kept / WEIGHTS)
        elif (folder / STATE).exists():
            pack_state(folder / STATE, kept / PACKED)
            written.append(kept / PACKED)
    return written


def unpack_run(kept: Path, run: Path) -> list[Path]:
    """Unpack the folder of a run; what is there already is kept, so that a newer state is never lost."""
    written: list[Path] = []
    for file in sorted((*kept.rglob(WEIGHTS), *kept.rglob(PACKED))):
        path = run / file.relative_to(kept).with_name(WEIGHTS if file.name == WEIGHTS else STATE)
        if path.exists() or path.with_name(WEIGHTS).exists():
            continue
        if file.name == WEIGHTS:
            atomic_write(path, file.read_bytes())
        else:
            unpack_state(file, path)
        written.append(path)
    return written


def main() -> int:
    """Run the action of the command line; the exit code is 1 after an error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path, help="the folder of the run, or the packed one")
    parser.add_argument("target", type=Path, help="the packed folder, or that of the run")
    options = parser.parse_args()
    if not options.source.is_dir():
        parser.error(f"{options.source}: no such folder")
    try:
        written = (pack_run if options.action == "pack" else unpack_run)(options.source, options.target)
    except ManyeyesError as error:
        sys.stderr.write(f"pack_run: {error}\n")
        return 1
    for path in written:
        print(f"{path}: {path.stat().st_size:,} bytes")
    if not written:
        print("nothing to do")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
