# SPDX-License-Identifier: Apache-2.0
"""A map's whole life in a folder or at a URL: the log of observations, releases of the fused map, and what changed between them.

::

    store.json                  format, version, frame
    log/                        segments of observations, retractions, quarantine (observation_log)
    catalogue.sqlite            index of the log (log_index); of a store at a URL in the user's cache, made from the log
    tiles/X_Y/HASH.*.parquet    elements of a tile (formats.geoparquet, lossless), named by content; releases share equal ones
    releases/000001.json        manifest of a release: tiles with hashes, parent, algorithm, settings, watermark of the log
    deltas/000001/              what changed since the parent (map_diff)
    work/                       results of steps of a fusion that is under way (tiled_fusion)

A manifest is written last: a release is there whole or not at all, and readers need no lock. Nothing that a release names is
changed afterwards. Writers to a folder hold ``lock``; at a URL, of two that publish the second is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import MapFusionConfig
from manyeyes.maps.isolation import FailedObservationsError
from manyeyes.maps.store.executors import Executor, ProcessExecutor
from manyeyes.maps.store.log_index import ActiveObservations
from manyeyes.maps.store.map_diff import MapDelta
from manyeyes.maps.store.object_store import FolderStore, ObjectNotFoundError, StoreError, open_object_store
from manyeyes.maps.store.observation_log import ObservationLog, read_active
from manyeyes.maps.store.region_release import write_release
from manyeyes.maps.store.releases import STORE_VERSION, Manifest, ReleaseStore, Watermark, read_json
from manyeyes.maps.store.tiled_fusion import FusionJob, StepProgress, TiledFusionConfig, fuse_and


class MapStore:
    """A store; :meth:`create` makes one, the constructor opens one that is there.

    place: a folder, or a URL of fsspec such as ``s3://bucket/city``. options: of its file system, see
    :class:`~manyeyes.maps.store.object_store.UrlStore`.
    """

    def __init__(self, place: Path | str, options: tuple[tuple[str, str], ...] = ()) -> None:
        self.objects = open_object_store(place, options)
        location = self.objects.location
        content = read_json(self.objects, "store.json", "a store of maps")
        if content.get("format") != "manyeyes.store":
            raise StoreError(f"{location}/store.json: expected format 'manyeyes.store'; got {content.get('format')!r}.")
        if content["version"] > STORE_VERSION:
            raise StoreError(
                f"{location}/store.json: version {content['version']}, but this program knows up to {STORE_VERSION}; "
                "update manyeyes."
            )
        self.frame = MapFrame(content["latitude"], content["longitude"])
        self.published = ReleaseStore(self.objects, self.frame)

    @cached_property
    def log(self) -> ObservationLog:
        """The log of observations; readers of releases need none, and so no index."""
        if isinstance(self.objects, FolderStore):
            return ObservationLog(self.objects, self.frame, self.objects.folder / "catalogue.sqlite")
        return ObservationLog(self.objects, self.frame, _cached_index(self.objects.location), index_is_cache=True)

    @classmethod
    def create(cls, place: Path | str, frame: MapFrame, options: tuple[tuple[str, str], ...] = ()) -> MapStore:
        """Return a new, empty store about an origin; where one of the same frame is, it is opened."""
        content = {"format": "manyeyes.store", "version": STORE_VERSION, **asdict(frame)}
        open_object_store(place, options).put_new("store.json", json.dumps(content, indent=1).encode())
        store = cls(place, options)
        if store.frame != frame:
            raise StoreError(
                f"{place}: expected a store about {frame}; it is about {store.frame}: choose another folder."
            )
        return store

    @staticmethod
    def exists(place: Path | str, options: tuple[tuple[str, str], ...] = ()) -> bool:
        """Return whether a folder or URL holds a store."""
        try:
            open_object_store(place, options).get("store.json")
        except ObjectNotFoundError:
            return False
        return True

    @contextmanager
    def open_for_writing(self) -> Iterator[ObservationLog]:
        """Hold the store's lock and bring log and index together; gives the log to append to."""
        with self.objects.hold_lock():
            self.log.recover()
            yield self.log

    def observations_of(self, number: int | None = None) -> list[Observation]:
        """Return the observations that a release was made of, the last one if no number is given, ids ascending.

        Where no beginning of the log has the watermark of the release, as after a retraction: all that count now.
        """
        if not isinstance(self.objects, FolderStore):
            # The index is this user's own; another program may have written to the log.
            self.log.recover()
        active = self.log.active_observations()
        rows = _find_rows(active, self.manifest(number).watermark)
        return read_active(self.objects, active, np.arange(len(active)) if rows is None else rows)

    def releases(self) -> tuple[int, ...]:
        """Return numbers of all releases, ascending."""
        return self.published.numbers()

    def manifest(self, number: int | None = None) -> Manifest:
        """Return the manifest of a release, the last one if no number is given."""
        return self.published.manifest(number)

    def read(self, number: int | None = None, area: tuple[float, float, float, float] | None = None) -> VectorMap:
        """Return the map of a release, the last one if no number is given, elements by ascending id.

        area: only elements of tiles that it touches (x0, y0, x1, y1, metres): those that start there.
        """
        return self.published.read(number, area)

    def fuse(
        self,
        config: MapFusionConfig | None = None,
        tile_config: TiledFusionConfig | None = None,
        executor: Executor | None = None,
        progress: StepProgress | None = None,
    ) -> Manifest:
        """Fuse all observations that count and publish the map; steps done before a kill, or for a former release, are reused.

        Workers read the log and write results of steps, then the release, to the store; this process holds their names alone.
        Observations with which the fusion fails go to the quarantine, ``log.rejected``, and the rest is fused.
        """
        job = FusionJob(self.objects, self.objects, config or MapFusionConfig())
        tile_config = tile_config or TiledFusionConfig()
        with self.open_for_writing() as log, (executor or ProcessExecutor()).open() as session:
            while True:
                watermark = _watermark_of(log.index.iterate_active())

                def write(blocks: tuple[str, ...], watermark: Watermark = watermark) -> Manifest:
                    return write_release(job, self.published, blocks, watermark, session, progress)

                try:
                    manifest = fuse_and(write, job, log.index, tile_config, session, progress)
                    break
                except FailedObservationsError as error:
                    log.quarantine(error.failures)
            self.published.commit(manifest)
            return manifest

    def publish(self, fused: VectorMap, algorithm: str, settings: str, watermark: Watermark) -> Manifest:
        """Publish a map that was fused elsewhere."""
        with self.open_for_writing():
            manifest = self.published.write(fused, algorithm, settings, watermark)
            self.published.commit(manifest)
            return manifest

    def delta(self, number: int) -> MapDelta:
        """What release ``number`` changed, against its parent."""
        return self.published.delta(number)

    def clear_work(self) -> None:
        """Delete kept results of steps; the next fusion does them all again."""
        with self.open_for_writing():
            self.objects.delete(self.objects.list("work"))

    def collect_garbage(self) -> list[str]:
        """Delete objects of tiles and deltas that no release names, as a killed writer leaves them; their keys."""
        with self.open_for_writing():
            return self.published.collect_garbage()


def _find_rows(active: ActiveObservations, watermark: Watermark) -> NDArray[np.int64] | None:
    """Return the rows of the first segments of a log whose observations have this watermark; None where there are none such."""
    for last in range(len(active.segments), -1, -1):
        rows = np.flatnonzero(active.segment < last)
        if len(rows) == watermark.observations:
            found = compute_watermark([active.ids[row] for row in rows.tolist()], active.time_ns[rows])
            return rows if found == watermark else None
    return None


def compute_watermark(ids: Sequence[str], times_ns: NDArray[np.int64]) -> Watermark:
    """Return the watermark of a set of observations."""
    return _watermark_of(sorted(zip(ids, times_ns.tolist(), strict=True)))


def _watermark_of(observations: Iterable[tuple[str, int]]) -> Watermark:
    """Return the watermark of observations (id, time in ns), ids ascending."""
    digest, count, latest = hashlib.blake2b(digest_size=16), 0, -1
    for name, time_ns in observations:
        digest.update(name.encode())
        count, latest = count + 1, max(latest, time_ns)
    return Watermark(count, digest.hexdigest(), latest)


def _cached_index(location: str) -> Path:
    """Return the file of the index of a store at a URL, in the user's cache; of one in memory, a file of this process."""
    name = hashlib.blake2b(location.encode(), digest_size=8).hexdigest()
    if location.startswith("memory:"):
        return Path(tempfile.gettempdir()) / f"manyeyes-{os.getpid()}" / name / "catalogue.sqlite"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "manyeyes" / "stores" / name / "catalogue.sqlite"
