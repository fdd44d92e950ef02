# SPDX-License-Identifier: Apache-2.0
"""List what changed from one map to another where both were observed; optionally as a web page."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from manyeyes._bounds import OutputFile


@dataclass(frozen=True)
class Options:
    """Two maps, of one frame or of two."""

    old: tyro.conf.Positional[str]
    """The earlier map: the folder of 'map fuse', or a store in a folder or at a URL (s3://bucket/city; city@2 is its release 2)."""
    new: tyro.conf.Positional[str]
    """The later map, likewise."""
    out: OutputFile | None = None
    """Also write this: .json with all numbers, or .html, a page that shows what is new and what is gone."""


def main(options: Options) -> None:
    """Compare two maps and write the changes."""
    from rich.console import Console

    from manyeyes.datatypes import ConfigError
    from manyeyes.evaluation.maps.change_summary import compare_maps
    from manyeyes.maps.formats.reframe import move_to_frame
    from manyeyes.maps.fusion.observed_ground import ASSUMED_MARGIN_M
    from manyeyes.maps.store.map_place import MapPlace
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import read_ground, read_vector_map
    from manyeyes.viz.map_page import make_change_page, save_map_page
    from manyeyes.viz.map_table import make_change_table

    if options.out is not None and options.out.suffix.lower() not in (".json", ".html"):
        raise ConfigError(f"--out ends in .json or .html; got {options.out.name}.")
    console = Console()
    old, new = read_vector_map(options.old), read_vector_map(options.new)
    grounds = [read_ground(place, m) for place, m in ((options.old, old), (options.new, new))]
    change = compare_maps(old, new, *grounds)
    console.print(make_change_table(change.kinds, f"From {options.old} to {options.new}"))
    for place, ground in zip((options.old, options.new), grounds):
        if ground.is_assumed:
            console.print(
                f"{place} has no observations: it is taken to cover the ground within {ASSUMED_MARGIN_M:g} m of its lines.",
                highlight=False,
                soft_wrap=True,
            )
    if options.out is None:
        return
    if options.out.suffix.lower() == ".json":
        provenance.write_json(options.out, change, options, None)
    else:
        moved = move_to_frame(old, new.frame)
        title = " to ".join(MapPlace.parse(place).name for place in (options.old, options.new))
        save_map_page(make_change_page(title, moved, new, change), options.out)
    console.print(f"{options.out} holds it", highlight=False, soft_wrap=True)
