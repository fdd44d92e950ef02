# SPDX-License-Identifier: Apache-2.0
"""Makes one map of a folder of observations: each observation's pose is corrected once, then lines and crossings are fused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes._bounds import OutputFolder, WorkerCount
from manyeyes.datatypes import ConfigError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

    from manyeyes.maps.elements.observation_file import LoadedObservations
    from manyeyes.maps.fusion.fuse import MapFusionConfig
    from manyeyes.maps.store.executors import Executor
    from manyeyes.maps.store.store import MapStore


@dataclass(frozen=True)
class Options:
    """What is fused, and how."""

    observations: tyro.conf.Positional[Path]
    """A Parquet file of observations, a folder of them, or a folder of 'map simulate'; see docs/reference/map-observations.md."""
    out: OutputFolder | None = None
    """Folder for the map, two GeoParquet files; 'map' beside the observations by default."""
    method: str = "manyeyes"
    """A registered method: manyeyes, manyeyes-two-agents, which publishes only what two agents detected, manyeyes-map-model, for
    observations of the shipped map models, or a baseline such as
    union, chamfer-nms, polymerge; an unknown name lists all."""
    store: str | None = None
    """Instead of a map's folder: a store, made if it is not there, which takes the observations in and publishes a release. A
    folder, or a URL such as s3://bucket/city; see docs/guides/map-cluster.md."""
    executor: str = "process"
    """What fuses a store's tiles: inline, process, dask or ray."""
    workers: WorkerCount | None = None
    """How many processes; one a core by default. The map does not depend on it."""
    address: str | None = None
    """Of a running cluster, such as tcp://scheduler:8786 (dask) or ray://head:10001 (ray); by default one starts here."""


def main(options: Options) -> None:
    """Fuse observations to a map, with a method or a store."""
    from rich.console import Console

    from manyeyes._lock import hold_folder
    from manyeyes.maps.registry import MAP_FUSION_METHODS
    from manyeyes.studies.map_folder import load_observations

    if options.out is not None and ":/" in str(options.out):
        raise ConfigError(f"--out is a folder of this machine; for {options.out} say --store and the URL of a store.")
    config = MAP_FUSION_METHODS.get(options.method).config_class()
    console = Console()
    if options.store is not None:
        _fuse_into_store(options, options.store, console)
        return
    loaded = load_observations(options.observations, console)
    base = options.observations if options.observations.is_dir() else options.observations.parent
    out = options.out or base / ("map" if options.method == "manyeyes" else options.method)
    with hold_folder(out):
        _fuse_into_folder(options, loaded, config, out, console)


def _fuse_into_folder(
    options: Options, loaded: LoadedObservations, config: object, out: Path, console: Console
) -> None:
    """Fuse observations, without those that make the method fail, and write the map."""
    import time

    from manyeyes.maps.fusion.observed_ground import ObservedGround
    from manyeyes.maps.isolation import reject_failed
    from manyeyes.maps.registry import fuse_isolated
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import GROUND_FILE, print_none_published, report_rejected, write_vector_map

    start = time.perf_counter()
    with console.status(f"Fusing {len(loaded.observations)} observations"):
        fused, failures = fuse_isolated(loaded.observations, options.method, config, loaded.frame)
    seconds = time.perf_counter() - start
    failed = [reject_failed(str(options.observations), loaded.observations[one.row], one.reason) for one in failures]
    report_rejected(failed, console)
    rejected = (*loaded.rejected, *failed)
    num_fused = len(loaded.observations) - len(failed)
    failed_rows = {one.row for one in failures}
    counted = [o for row, o in enumerate(loaded.observations) if row not in failed_rows]
    write_vector_map(fused, out)
    ObservedGround.of_observations(counted, loaded.frame).write(out / GROUND_FILE)
    published = len(fused.select_published())
    payload = {
        "observations": num_fused,
        "rejected": len(rejected),
        "quarantine": rejected,
        "elements": len(fused),
        "published": published,
        "hash": fused.quantised_hash(),
        "seconds": seconds,
    }
    provenance.write_json(out / "fuse.json", payload, {"options": options, "settings": config}, None)
    console.print(
        f"{out}: {published} published elements of {len(fused)} from {num_fused} observations in {seconds:.1f} s",
        highlight=False,
        soft_wrap=True,
    )
    print_none_published(published, len(fused), console)


def _fuse_into_store(options: Options, place: str, console: Console) -> None:
    """Takes the observations into a store's log and publishes a release, tile by tile."""
    from manyeyes.maps.elements.observation_file import RejectedRows, find_observation_files, read_observations
    from manyeyes.maps.store.executors import make_executor
    from manyeyes.maps.store.store import MapStore
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import report_rejected

    config = make_store_config(options.method)
    executor = make_executor(options.executor, options.workers, options.address)
    check_shared(place, options.executor)
    source = find_observation_files(options.observations)
    store = MapStore(place) if MapStore.exists(place) else MapStore.create(place, read_observations(source).frame)
    with store.open_for_writing() as log:
        ingested = log.ingest(source)
    known = len(log.rejected)
    report_rejected((*log.rejected, *ingested.rejected), console)
    number = publish_release(store, config, executor, console)
    report_rejected(log.rejected[known:], console)
    rejected = (*log.rejected, *ingested.rejected)
    payload = {
        "release": number,
        "observations": store.manifest(number).watermark.observations,
        "added": ingested.num_added,
        "known": ingested.num_known,
        "rejected": len(rejected),
        "quarantine": [RejectedRows(*row) for row in log.index.list_rejected()],
    }
    store.objects.put("fuse.json", provenance.render_json(payload, {"options": options}, None)[1].encode())
    console.print(
        f"{place}: release {number} after {ingested.num_added} new observations, {ingested.num_known} known, "
        f"{len(rejected)} rejected",
        highlight=False,
        soft_wrap=True,
    )


def check_shared(place: str, executor: str) -> None:
    """Refuse a store that other processes cannot reach, where they are to fuse it."""
    if place.startswith("memory://") and executor != "inline":
        raise ConfigError(f"{place} lies in the memory of one process; say --executor inline, or choose another store.")


def make_store_config(method: str) -> MapFusionConfig:
    """Return the configuration with which a store is fused; ConfigError for a method that does not fuse by tiles."""
    from manyeyes.maps.registry import MAP_FUSION_METHODS, OURS, VARIANTS

    if method not in (OURS, *VARIANTS):
        raise ConfigError(f"A store is fused by {', '.join((OURS, *VARIANTS))}; fuse without --store for {method}.")
    return MAP_FUSION_METHODS.get(method).config_class()


def find_store_config(store: MapStore) -> MapFusionConfig:
    """Return the configuration of the last release of a store, that of manyeyes where there is none.

    Raises:
        ConfigError: the release was made with another configuration than those of the registered methods.
    """
    from manyeyes.maps.registry import MAP_FUSION_METHODS, OURS, VARIANTS

    if not store.releases():
        return make_store_config(OURS)
    last = store.manifest()
    for name in (OURS, *VARIANTS):
        config = MAP_FUSION_METHODS.get(name).config_class()
        if repr(config) == last.settings:
            return config
    raise ConfigError(
        f"{store.objects.location}: release {last.number} was made with other settings than those of this version's "
        f"{', '.join((OURS, *VARIANTS))}; say with --method which of them makes the next one."
    )


def publish_release(store: MapStore, config: MapFusionConfig, executor: Executor, console: Console) -> int:
    """Fuse all observations of a store that count, publish the map, and return the release's number."""
    from manyeyes.viz.progress import make_progress_bars

    with make_progress_bars(console) as progress:
        tasks: dict[str, TaskID] = {}

        def report(step: str, finished: int, total: int) -> None:
            task = tasks.get(step)
            if task is None:
                task = tasks[step] = progress.add_task(step, total=total)
            progress.update(task, completed=finished, total=total)

        return store.fuse(config, executor=executor, progress=report).number
