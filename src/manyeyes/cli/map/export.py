# SPDX-License-Identifier: Apache-2.0
"""Writes a map for others: GeoJSON, GeoPackage, GeoParquet, Lanelet2, Argoverse 2, nuScenes, PMTiles, or its graph."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from manyeyes._bounds import LengthM, OutputFile


@dataclass(frozen=True)
class Options:
    """What is written, and as what."""

    folder: tyro.conf.Positional[str]
    """The map: the folder of 'map fuse', or a store in a folder or at a URL (s3://bucket/city; city@2 is its release 2)."""
    file: tyro.conf.Positional[OutputFile]
    """The file; .geojson, .gpkg, .parquet, .osm, .pmtiles and .npz name their format, .json needs --format."""
    format: str | None = None
    """geojson, geopackage, geoparquet, lanelet2, argoverse2, nuscenes, pmtiles or graph, where the ending does not say it."""
    crs: str | None = None
    """Coordinate system of a GeoPackage: EPSG:4326 by default, such as EPSG:25832, or local, metres about the map's origin."""
    simplify_m: LengthM = 0.05
    """Lines may leave their stations by so much, metres; 0 writes every station."""
    include_unpublished: bool = False
    """Also what is not published: candidates, deprecated and retired elements."""


def main(options: Options) -> None:
    """Write a map in another format."""
    from rich.console import Console

    from manyeyes.maps.formats.export import export_map
    from manyeyes.studies.map_folder import print_none_published, read_vector_map

    vector_map = read_vector_map(options.folder)
    selected = vector_map if options.include_unpublished else vector_map.select_published()
    options.file.parent.mkdir(parents=True, exist_ok=True)
    export_map(selected, options.file, options.format, options.simplify_m, options.crs)
    console = Console()
    console.print(f"{options.file}: {len(selected)} elements", highlight=False, soft_wrap=True)
    print_none_published(len(selected), len(vector_map), console)
