# SPDX-License-Identifier: Apache-2.0
"""Where a map lies, as commands take it: a map's folder, or a store in a folder or at a URL, of which ``@N`` names a release."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

_RELEASE = re.compile(r"(.+)@(\d{1,9})", re.DOTALL)


def is_url(place: Path | str) -> bool:
    """Return whether a place is a URL and no folder; ``file://`` is a folder."""
    return "://" in str(place) and not str(place).startswith("file://")


@dataclass(frozen=True)
class MapPlace:
    """A map's place.

    location: a folder, or the URL of a store. release: number of a store's release; None: its last, or a map's folder.
    """

    location: str
    release: int | None = None

    @classmethod
    def parse(cls, text: Path | str) -> MapPlace:
        """Parse ``city``, ``s3://bucket/city`` or ``city@2``; a folder whose name ends like a release is that folder."""
        location = str(text).removeprefix("file://")
        named = None if Path(location).exists() else _RELEASE.fullmatch(location)
        location = location if named is None else named[1]
        # Equal places are equal texts.
        location = location.rstrip("/") if is_url(location) else str(Path(location))
        return cls(location) if named is None else cls(location, int(named[2]))

    @property
    def folder(self) -> Path | None:
        """The folder; None at a URL."""
        return None if is_url(self.location) else Path(self.location)

    @property
    def name(self) -> str:
        """The last part of the location, with the release: a title."""
        last = self.location.rpartition("/")[2] if self.folder is None else self.folder.resolve().name
        return last if self.release is None else f"{last}@{self.release}"

    @property
    def output_folder(self) -> Path:
        """Where what is made of the map is written by default: the map's folder; of one at a URL, a folder of ``out/map``."""
        return self.folder or Path("out/map") / self.name

    def beside(self, name: str) -> Path | None:
        """Return the path of this name beside the map's folder; None where there is none, as at a URL."""
        path = None if self.folder is None else self.folder.parent / name
        return path if path is not None and path.exists() else None

    def exists(self) -> bool:
        """Return whether there is such a file or folder; a URL is not asked."""
        return self.folder is None or self.folder.exists()

    def __str__(self) -> str:
        return self.location if self.release is None else f"{self.location}@{self.release}"
