# SPDX-License-Identifier: Apache-2.0
"""Write tables and figures of README and documents from the results stored in benchmarks/results; --check compares only.

A table stands between <!-- report: FILE --> and <!-- end of report -->; FILE is below benchmarks/results. Results without command,
commit, seeds or split are refused. Figures (<!-- report: figure NAME FILE -->) are SVG files in docs/images/plots.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Which repository, and whether it is written."""

    root: Path = Path()
    """Root of the repository: README.md, docs and benchmarks/results are below it."""
    check: bool = False
    """Write nothing; the exit code is 1 where a document differs from its results."""


def main(options: Options) -> None:
    """Write or check the tables and figures of all documents."""
    from rich.console import Console

    from manyeyes._io import atomic_write_text
    from manyeyes.datatypes import ConfigError
    from manyeyes.viz.documents import find_documents

    documents = find_documents(options.root)
    if not documents:
        raise ConfigError(
            f"{options.root}: no document with a marker <!-- report: ... -->; give the repository by --root."
        )
    changed = [document for document in documents if document.text != document.updated]
    names = ", ".join(str(document.path.relative_to(options.root)) for document in changed)
    if options.check and changed:
        raise ConfigError(f"{names}: differs from benchmarks/results; run 'manyeyes report docs'.")
    for document in changed:
        atomic_write_text(document.path, document.updated)
    text = f"{names}: written" if changed else f"{len(documents)} documents and figures are those of their results"
    Console().print(text, highlight=False, soft_wrap=True)
