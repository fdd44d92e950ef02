# SPDX-License-Identifier: Apache-2.0
"""Draws a map: a web page that needs no internet (.html), or a picture (.png), with truth and observations behind it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """What to draw."""

    folder: tyro.conf.Positional[Path]
    """The map's folder, of 'map fuse'."""
    truth: Path | None = None
    """A map's folder to hold it against; 'truth' beside the map is found by itself."""
    observations: Path | None = None
    """Observations to draw behind it; a folder 'observations' beside the map is found by itself."""
    out: Path | None = None
    """The page (.html) or picture (.png); map.html in the map's folder by default."""
    most: int = 500
    """At most so many observations are drawn: a page of a million lines helps nobody."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.datatypes.map_element import MapElements
    from manyeyes.studies.map_folder import MapFolder, observations_in, read_vector_map
    from manyeyes.viz.map_figures import Panel, save_figure
    from manyeyes.viz.map_page import page_of, save_map_page

    out = options.out or options.folder / "map.html"
    if out.suffix.lower() not in (".html", ".png"):
        raise ConfigError(f"--out ends in .html or .png; got {out.name}.")
    console = Console()
    beside = options.folder.parent
    made = read_vector_map(options.folder)
    truth_folder = options.truth or _if_there(beside / "truth")
    truth = read_vector_map(truth_folder).elements if truth_folder and truth_folder != options.folder else None
    seen_in = options.observations or _if_there(beside / "observations")
    seen = observations_in(seen_in, console).observations if seen_in else ()
    observed = MapElements.cat([o.in_map() for o in seen[: options.most]]) if seen else None
    title = options.folder.stem
    if out.suffix.lower() == ".png":
        save_figure([Panel(title, made.published().elements, truth)], out, columns=1, width_in=10.0)
    else:
        cut = MapFolder(truth_folder.parent).cut() if truth_folder and truth is not None else None
        judged = cut(made.published().elements) if cut else None
        save_map_page(page_of(title, made, truth, observed, len(seen), judged), out)
    console.print(f"{out}: {len(made.published())} published elements", highlight=False, soft_wrap=True)


def _if_there(path: Path) -> Path | None:
    return path if path.exists() else None
