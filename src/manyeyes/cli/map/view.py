# SPDX-License-Identifier: Apache-2.0
"""Draws a map: a web page that needs no internet (.html), or a picture (.png), with truth and observations behind it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from manyeyes._bounds import InputPath, OutputFile, PositiveInt
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """The map and the output file."""

    folder: tyro.conf.Positional[Path]
    """The map's folder, of 'map fuse'."""
    truth: InputPath | None = None
    """A map's folder to hold it against; 'truth' beside the map is found by itself."""
    observations: InputPath | None = None
    """Observations to draw behind it; a folder 'observations' beside the map is found by itself."""
    out: OutputFile | None = None
    """The page (.html) or picture (.png); map.html in the map's folder by default."""
    max_observations: PositiveInt = 500
    """Draw at most so many observations, which bounds the size of the page."""


def main(options: Options) -> None:
    """Draw a map as a page or an image."""
    from rich.console import Console

    from manyeyes.datatypes.map_element import MapElements
    from manyeyes.studies.map_folder import MapFolder, load_observations, read_vector_map
    from manyeyes.viz.map_figures import MapPanel, save_figure
    from manyeyes.viz.map_page import make_page, save_map_page

    out = options.out or options.folder / "map.html"
    if out.suffix.lower() not in (".html", ".png"):
        raise ConfigError(f"--out ends in .html or .png; got {out.name}.")
    console = Console()
    parent = options.folder.parent
    vector_map = read_vector_map(options.folder)
    truth_folder = options.truth or _existing(parent / "truth")
    truth = read_vector_map(truth_folder).elements if truth_folder and truth_folder != options.folder else None
    observations_path = options.observations or _existing(parent / "observations")
    observations = load_observations(observations_path, console).observations if observations_path else ()
    observed = (
        MapElements.cat([o.elements_in_map() for o in observations[: options.max_observations]])
        if observations
        else None
    )
    title = options.folder.stem
    if out.suffix.lower() == ".png":
        save_figure([MapPanel(title, vector_map.select_published().elements, truth)], out, columns=1, width_in=10.0)
    else:
        cut_policy = MapFolder(truth_folder.parent).read_cut_policy() if truth_folder and truth is not None else None
        evaluated = cut_policy(vector_map.select_published().elements) if cut_policy else None
        save_map_page(make_page(title, vector_map, truth, observed, len(observations), evaluated), out)
    console.print(f"{out}: {len(vector_map.select_published())} published elements", highlight=False, soft_wrap=True)


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None
