# SPDX-License-Identifier: Apache-2.0
"""Bytes under keys, in a folder or at a URL that fsspec knows: what a store of maps and the blocks of a fusion are kept in.

Needed of a store: an object is there whole or not at all, and a key can be created once. So no file is renamed or changed and no
lock is needed where the system has none. S3 gives both: a PUT is whole, and ``If-None-Match: *`` refuses a second one.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import inspect
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Protocol, cast

from manyeyes._io import atomic_write, remove_unfinished
from manyeyes.datatypes import ConfigError, ManyeyesError
from manyeyes.datatypes.extras import import_extra
from manyeyes.maps.store.map_place import is_url

_READ_AHEAD_BYTES = 1 << 20
"""A segment of a log is read in such parts, as a block needs a few of its groups of rows."""


_CLIENT_PACKAGES = ("aiobotocore", "aiohttp", "botocore", "gcsfs", "azure")
"""Packages whose own exceptions say that a store cannot be reached or refuses, besides OSError."""


class StoreError(ManyeyesError):
    """A store that is damaged, locked, not reachable, or of another frame or version; the text names the object and the remedy."""


class ObjectNotFoundError(StoreError):
    """There is no object under a key."""


class ObjectStore(Protocol):
    """Objects (bytes) under keys such as ``tiles/0_-1/HASH.lines.parquet``; pickles, as workers open it too."""

    @property
    def location(self) -> str:
        """The folder or URL."""
        ...

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Write an object: whole or not at all. durable: also after a loss of power, where the store leaves a choice."""
        ...

    def put_new(self, key: str, data: bytes) -> bool:
        """Write an object unless there is one under the key; returns whether it was written."""
        ...

    def get(self, key: str) -> bytes:
        """Read an object; ObjectNotFoundError where there is none."""
        ...

    def open(self, key: str) -> IO[bytes]:
        """Open an object to read parts of it; ObjectNotFoundError where there is none."""
        ...

    def list(self, folder: str) -> list[str]:
        """List the keys below ``folder/``, ascending."""
        ...

    def delete(self, keys: Sequence[str]) -> None:
        """Delete objects; those that are not there are passed over."""
        ...

    def hold_lock(self) -> contextlib.AbstractContextManager[None]:
        """Hold off other writers, where the store can; then clear away what killed ones left half-written."""
        ...


@dataclass(frozen=True)
class FolderStore:
    """Objects as files below a folder, which workers reach under the same path."""

    folder: Path

    @property
    def location(self) -> str:
        """The folder, as a text."""
        return str(self.folder)

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Write beside the final name, flush, rename."""
        atomic_write(self.folder / key, data, durable=durable)

    def put_new(self, key: str, data: bytes) -> bool:
        """Write unless it is there; the lock keeps other writers away."""
        if (self.folder / key).exists():
            return False
        self.put(key, data)
        return True

    def get(self, key: str) -> bytes:
        """Read a whole file."""
        with self._naming(key):
            return (self.folder / key).read_bytes()

    def open(self, key: str) -> IO[bytes]:
        """Open a file to read."""
        with self._naming(key):
            return (self.folder / key).open("rb")

    @contextmanager
    def _naming(self, key: str) -> Iterator[None]:
        try:
            yield
        except (FileNotFoundError, NotADirectoryError) as error:
            reason = os.strerror(error.errno or errno.ENOENT)
            raise ObjectNotFoundError(f"{self.folder / key}: {reason}; restore it from a copy.") from None

    def list(self, folder: str) -> list[str]:
        """List files, those that are being written left out."""
        below = self.folder / folder
        return sorted(
            path.relative_to(self.folder).as_posix()
            for path in below.rglob("*")
            if path.name[0] != "." and path.is_file()
        )

    def delete(self, keys: Sequence[str]) -> None:
        """Delete files that are there."""
        for key in keys:
            (self.folder / key).unlink(missing_ok=True)

    @contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold the folder's lock, which the system takes back from a program that is killed."""
        with hold_lock(self.folder / "lock"):
            for name in ("log", "tiles", "deltas", "releases", "work"):
                remove_unfinished(self.folder / name)
            yield


@dataclass(frozen=True)
class UrlStore:
    """Objects below a URL of fsspec, such as ``s3://bucket/city`` or ``memory://city``.

    options: of the file system, such as ``(("endpoint_url", "http://host:9000"),)``; workers get them, too. Credentials are better
    left to the environment of each worker.
    """

    url: str
    options: tuple[tuple[str, str], ...] = ()

    @property
    def location(self) -> str:
        """The URL, as it was given."""
        return self.url

    @property
    def _root(self) -> str:
        return str(_file_system(self.url, self.options)._strip_protocol(self.url)).rstrip("/")

    def put(self, key: str, data: bytes, durable: bool = True) -> None:
        """Write an object as one request."""
        with self._naming(key) as files:
            files.pipe_file(f"{self._root}/{key}", data)

    def put_new(self, key: str, data: bytes) -> bool:
        """Create an object, which the store refuses where there is one."""
        try:
            with self._naming(key) as files:
                files.pipe_file(f"{self._root}/{key}", data, mode="create")
        except FileExistsError:
            return False
        return True

    def get(self, key: str) -> bytes:
        """Read a whole object."""
        with self._naming(key) as files:
            return files.cat_file(f"{self._root}/{key}")

    def open(self, key: str) -> IO[bytes]:
        """Open an object; reading fetches the parts that are read."""
        with self._naming(key) as files:
            handle = files.open(f"{self._root}/{key}", "rb", block_size=_READ_AHEAD_BYTES, cache_type="readahead")
            return cast(IO[bytes], handle)

    def list(self, folder: str) -> list[str]:
        """List objects; what other programs have written is seen."""
        folder = folder.rstrip("/")
        with self._naming(folder) as files:
            files.invalidate_cache()
            if _finds_by_prefix(files):
                # Of a path that holds nothing, S3 is asked again, whether that is an object; of a prefix it is not.
                names = files.find(self._root, prefix=f"{folder}/")
            else:
                names = files.find(f"{self._root}/{folder}")
            start = len(self._root) + 1
            return sorted(name[start:] for name in names if name.startswith(f"{folder}/", start))

    def delete(self, keys: Sequence[str]) -> None:
        """Delete objects that are there."""
        for key in keys:
            with contextlib.suppress(ObjectNotFoundError), self._naming(key) as files:
                files.rm_file(f"{self._root}/{key}")

    @contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold nothing: an object store has no lock; of two writers the one that publishes last is refused."""
        yield

    @contextmanager
    def _naming(self, key: str) -> Iterator[Any]:
        """Give the file system; name the object and the remedy where it cannot be reached."""
        files = _file_system(self.url, self.options)
        try:
            yield files
        except FileExistsError:
            raise
        except FileNotFoundError as error:
            reason = " ".join(str(error).split())
            raise ObjectNotFoundError(f"{self.url}/{key}: not found ({reason}); check the address.") from None
        except Exception as error:
            if not isinstance(error, OSError) and type(error).__module__.partition(".")[0] not in _CLIENT_PACKAGES:
                raise
            reason = " ".join(str(error).split()) or type(error).__name__
            raise StoreError(
                f"{self.url}/{key}: the store cannot be reached; {reason}. Check address, network and credentials"
                f"{_name_settings(self.url)}."
            ) from None


def open_object_store(place: Path | str, options: tuple[tuple[str, str], ...] = ()) -> ObjectStore:
    """Return the store of a folder, or of a URL ``protocol://...``."""
    if is_url(place):
        store = UrlStore(str(place).rstrip("/"), options)
        _file_system(store.url, options)
        return store
    return FolderStore(Path(str(place).removeprefix("file://")))


def _name_settings(url: str) -> str:
    """Name what holds the address and the credentials of a store, for messages; empty where that depends on its package."""
    if not url.startswith(("s3://", "s3a://")):
        return ""
    return " (AWS_ENDPOINT_URL where the service is not Amazon's, AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY)"


@lru_cache(maxsize=16)
def _file_system(url: str, options: tuple[tuple[str, str], ...]) -> Any:
    """Return the file system of a URL, without a cache of listings, as other programs write too."""
    fsspec = import_extra("fsspec", "cloud", "A store at a URL")
    protocol = url.partition("://")[0]
    settings: dict[str, Any] = {"use_listings_cache": False}
    if protocol in ("s3", "s3a"):
        import_extra("s3fs", "cloud", "A store on S3")
        # To read an object in parts beside each other, its size is asked first: two requests for each of many small objects.
        settings["max_concurrency"] = 1
    if protocol not in fsspec.available_protocols():
        raise ConfigError(f"{url}: expected a folder, or a URL such as s3://bucket/city; fsspec has no '{protocol}'.")
    try:
        return fsspec.filesystem(protocol, **{**settings, **dict(options)})
    except ImportError as error:
        raise ConfigError(f"{url}: {error}.") from None


def _finds_by_prefix(files: Any) -> bool:
    """Return whether a file system lists the objects of one prefix: S3, Google's and Azure's do, those of folders do not."""
    return "prefix" in inspect.signature(getattr(files, "_find", files.find)).parameters


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold a store's lock, which the system takes back from a program that is killed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StoreError(
                f"{path.parent}: another program is writing to this store; try again when it has ended."
            ) from None
        yield
    finally:
        os.close(handle)
