# SPDX-License-Identifier: Apache-2.0
"""Draws a map: a web page that needs no internet (.html), or a picture (.png), with truth and observations behind it."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from manyeyes._bounds import InputMap, InputPath, OutputFile, PositiveInt
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """The map and the output file."""

    folder: tyro.conf.Positional[str]
    """The map: the folder of 'map fuse', or a store in a folder or at a URL (s3://bucket/city; city@2 is its release 2)."""
    truth: InputMap | None = None
    """A map to hold it against, likewise; 'truth' beside the map's folder is found by itself."""
    observations: InputPath | None = None
    """Observations to draw behind it; a folder 'observations' beside the map's folder is found by itself."""
    out: OutputFile | None = None
    """The page (.html) or picture (.png); map.html in the map's folder by default, of a store at a URL in out/map/NAME."""
    max_observations: PositiveInt = 500
    """Draw at most so many observations, the earliest ones, which bounds the size of the page."""
    basemap: str | None = None
    """URL of tiles behind the map, with {z}, {x} and {y}: the page then fetches them from there. By default it fetches nothing."""
    basemap_credit: str = ""
    """Whose tiles these are, shown on the page."""


def main(options: Options) -> None:
    """Draw a map as a page or an image."""
    from rich.console import Console

    from manyeyes.maps.store.map_place import MapPlace
    from manyeyes.studies.map_folder import MapFolder, load_observations, read_vector_map
    from manyeyes.viz.map_figures import MapPanel, save_figure
    from manyeyes.viz.map_page import Basemap, make_page, save_map_page

    place = MapPlace.parse(options.folder)
    out = options.out or place.output_folder / "map.html"
    if out.suffix.lower() not in (".html", ".png"):
        raise ConfigError(f"--out ends in .html or .png; got {out.name}.")
    basemap = None if options.basemap is None else Basemap(options.basemap, options.basemap_credit)
    console = Console()
    vector_map = read_vector_map(options.folder)
    true_place = options.truth or place.beside("truth")
    true_place = None if true_place is None else MapPlace.parse(true_place)
    truth = None if true_place in (None, place) else read_vector_map(str(true_place)).elements
    observations_path = options.observations or place.beside("observations")
    observations = load_observations(observations_path, console).observations if observations_path else ()
    title = place.name
    if out.suffix.lower() == ".png":
        save_figure([MapPanel(title, vector_map.select_published().elements, truth)], out, columns=1, width_in=10.0)
    else:
        true_folder = None if true_place is None or truth is None else true_place.folder
        cut_policy = None if true_folder is None else MapFolder(true_folder.parent).read_cut_policy()
        evaluated = cut_policy(vector_map.select_published().elements) if cut_policy else None
        page = make_page(title, vector_map, truth, observations, evaluated, options.max_observations, basemap)
        save_map_page(page, out)
    console.print(f"{out}: {len(vector_map.select_published())} published elements", highlight=False, soft_wrap=True)
