# SPDX-License-Identifier: Apache-2.0
"""Makes one map of a folder of observations: each observation's pose is corrected once, then lines and crossings are fused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """What is fused, and how."""

    observations: tyro.conf.Positional[Path]
    """A Parquet file of observations, a folder of them, or a folder of 'map simulate'; see docs/observation.md."""
    out: Path | None = None
    """Folder for the map, two GeoParquet files; 'map' beside the observations by default."""
    method: str = "manyeyes"
    """manyeyes, or a rival: union, chamfer_nms, crowdmap_literal, polymerge, frechet_clustering, heatmap_buffer, ..."""


def main(options: Options) -> None:
    """The verb."""
    import time

    from rich.console import Console

    from manyeyes.apps import provenance
    from manyeyes.apps.map_folder import observations_in, write_vector_map
    from manyeyes.evaluation.map_methods import Settings, check_method, map_of

    check_method(options.method)
    console = Console()
    reading = observations_in(options.observations, console)
    base = options.observations if options.observations.is_dir() else options.observations.parent
    out = options.out or base / ("map" if options.method == "manyeyes" else options.method)
    start = time.perf_counter()
    with console.status(f"Fusing {len(reading.observations)} observations"):
        made = map_of(options.method, reading.observations, Settings(), reading.frame)
    seconds = time.perf_counter() - start
    write_vector_map(made, out)
    published = len(made.published())
    payload = {
        "observations": len(reading.observations),
        "put_aside": len(reading.quarantined),
        "elements": len(made),
        "published": published,
        "hash": made.quantised_hash(),
        "seconds": seconds,
    }
    provenance.write_json(out / "fuse.json", payload, {"options": options, "settings": Settings()}, None)
    console.print(
        f"{out}: {published} published elements of {len(made)} from {len(reading.observations)} observations in {seconds:.1f} s",
        highlight=False,
        soft_wrap=True,
    )
