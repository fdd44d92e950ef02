# SPDX-License-Identifier: Apache-2.0
"""Retract observations of a store, then fuse and publish the map without them.

The log's files and former releases still hold them: a retraction changes what is fused and erases nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from manyeyes._bounds import WorkerCount
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """Which observations, and why."""

    store: tyro.conf.Positional[str]
    """The store's folder or URL, of 'map fuse --store'."""
    reason: str
    """Why; the log records it."""
    ids: tuple[str, ...] = ()
    """Ids of observations: 32 hexadecimal digits each, or enough of the first ones to be unique."""
    agent: str | None = None
    """Instead of ids: all observations of this pseudonym."""
    pass_id: str | None = None
    """Instead of ids: all observations of this pass; with --agent, only that agent's."""
    fuse: bool = True
    """Fuse and publish a release at once; else the next fusion leaves them out."""
    method: str | None = None
    """The method of the new release: manyeyes or a variant of it; by default that of the last release."""
    executor: str = "process"
    """What fuses the tiles: inline, process, dask or ray."""
    workers: WorkerCount | None = None
    """How many processes; one a core by default. The map does not depend on it."""
    address: str | None = None
    """Of a running cluster, such as tcp://scheduler:8786 (dask) or ray://head:10001 (ray); by default one starts here."""


def main(options: Options) -> None:
    """Remove observations of a store and publish the map."""
    from rich.console import Console

    from manyeyes.cli.map.fuse import find_store_config, make_store_config, publish_release
    from manyeyes.maps.store.executors import make_executor
    from manyeyes.maps.store.store import compute_watermark
    from manyeyes.studies.map_folder import open_store, report_rejected

    selects_by_sender = options.agent is not None or options.pass_id is not None
    if bool(options.ids) == selects_by_sender:
        raise ConfigError("Name the observations: --ids ID ..., or --agent NAME, --pass-id NAME or both.")
    if not options.reason.strip():
        raise ConfigError("--reason is empty; the log records why observations are retracted.")
    executor = make_executor(options.executor, options.workers, options.address)
    store, console = open_store(options.store), Console()
    config = None
    if options.method is not None:
        config = make_store_config(options.method)
    elif options.fuse:
        config = find_store_config(store)

    def print_status(text: str) -> None:
        console.print(f"{options.store}: {text}", highlight=False, markup=False, soft_wrap=True)

    with store.open_for_writing() as log:
        report_rejected(log.rejected, console)
        selected = log.find(options.ids, options.agent, options.pass_id)
        count = log.retract(selected, options.reason)
        active = log.active_observations()
    print_status(f"{count} observations retracted now, {len(selected) - count} before; {len(active)} count")
    last = store.manifest() if store.releases() else None
    if last is not None and last.watermark == compute_watermark(active.ids, active.time_ns):
        print_status(f"release {last.number} is already without them")
    elif options.fuse and config is not None:
        known = len(log.rejected)
        print_status(f"release {publish_release(store, config, executor, console)} is without them")
        report_rejected(log.rejected[known:], console)
    else:
        print_status(
            "no new release; run this again without --no-fuse, or 'manyeyes map fuse OBSERVATIONS --store' this store"
        )
