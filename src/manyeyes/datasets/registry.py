# SPDX-License-Identifier: Apache-2.0
"""Readers of recordings by name, and a recording opened by the reader that recognises its folder.

A reader is one class in a module of its own, ours and third parties' alike (entry points of the group ``manyeyes.dataset``)::

    @register_dataset("npz", matches=lambda path: any(path.glob("*/poses.csv")), layout="folders <scenario>/poses.csv")
    class NpzRecording(RecordingReader): ...
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from manyeyes.datasets.base import RecordingReader
from manyeyes.datatypes import ConfigError, RecordingError
from manyeyes.datatypes.registry import Registry

DATASETS: Registry[type[RecordingReader]] = Registry("dataset", "manyeyes.dataset", "manyeyes.datasets")
_Reader = TypeVar("_Reader", bound=type[RecordingReader])


def register_dataset(name: str, *, matches: Callable[[Path], bool], layout: str) -> Callable[[_Reader], _Reader]:
    """Return a decorator that registers a reader; :func:`open_recording` and all commands find it.

    Args:
        name: such as "opv2v".
        matches: whether a folder is in the reader's layout, by a few names of files and folders: no file is read.
        layout: what is recognised, for error texts, such as "folders <scenario>/poses.csv".

    Raises:
        ConfigError: another reader has the name.
    """

    def decorate(reader: _Reader) -> _Reader:
        reader.matches, reader.layout = staticmethod(matches), layout
        return DATASETS.register(name)(reader)

    return decorate


def open_recording(path: Path | str, split: str | None = None, *, images: bool = False) -> RecordingReader:
    """Open a recording with the registered reader that recognises its folder.

    Args:
        path: a data set, a folder of scenarios, or one scenario.
        split: the name of a part, such as "test", if the data set has several.
        images: read the pictures of cameras, too.

    Raises:
        RecordingError: no reader or several recognise the folder, or its reader refuses it.
        ConfigError: the reader reads no pictures, or that of a third party cannot be imported.
    """
    root = Path(path)
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder, expected a recording; check the path.")
    readers = DATASETS.load_all()
    found = [name for name, reader in readers.items() if reader.matches(root)]
    if len(found) != 1:
        layouts = "; ".join(f"{name}: {readers[name].layout}" for name in found or readers)
        what, remedy = (
            ("the layouts of several data sets", "keep one of them")
            if found
            else ("no recording in a known layout", "check the path, or register a reader")
        )
        raise RecordingError(f"{root}: {what} ({layouts}); {remedy}.")
    reader = readers[found[0]]
    if images and not reader.reads_images:
        raise ConfigError(f"{root}: the reader of {found[0]} reads no pictures; choose a model of agents with LiDAR.")
    return reader(root, split, images=True) if images else reader(root, split)
