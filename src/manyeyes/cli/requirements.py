# SPDX-License-Identifier: Apache-2.0
"""Optional packages that each command imports: one literal table, checked before it begins."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from operator import attrgetter
from typing import Any

from manyeyes.datatypes.errors import MissingExtraError

EXTRAS = {
    "sim": ("libsumo", "sumo", "shapely", "pyarrow"),
    "map": ("shapely", "pyarrow", "pyogrio", "pyproj"),
    "view": ("matplotlib", "PIL"),
    "av2": ("pyarrow", "shapely"),
    "dask": ("dask", "distributed"),
    "ray": ("ray",),
    "cloud": ("fsspec", "s3fs"),
    "icp": ("small_gicp",),
    "ros": ("rosbags",),
    "train": ("tensorboard", "matplotlib", "PIL"),
    "live": ("cryptography", "zenoh", "mcap"),
    "metrics": ("prometheus_client",),
    "rerun": ("rerun",),
}
"""Modules that each extra installs."""


@dataclass(frozen=True)
class Requirement:
    """Modules that a command imports, and the extra that installs them.

    option: the field of the command's Options that decides whether it imports them, with dots in a nested one; without one it
    always does.
    patterns: the values of that option for which it does, as of fnmatch; an option that is None matches none.
    replaced_by: options that make the command do something else instead: with any of them it imports none.
    """

    extra: str
    modules: tuple[str, ...]
    option: str = ""
    patterns: tuple[str, ...] = ()
    replaced_by: tuple[str, ...] = ()

    def unless(self, *options: str) -> Requirement:
        """Return the same requirement without any of these options only."""
        return replace(self, replaced_by=options)

    def when(self, option: str, *patterns: str) -> Requirement:
        """Return the same requirement for some values of an option only."""
        return replace(self, option=option, patterns=patterns)

    def applies(self, options: Any) -> bool:
        """Return whether a command with these options imports the modules."""
        if any(getattr(options, name) is not None for name in self.replaced_by):
            return False
        if not self.option:
            return True
        value = attrgetter(self.option)(options)
        values = value if isinstance(value, tuple) else (value,)
        return any(fnmatchcase(str(v), pattern) for v in values if v is not None for pattern in self.patterns)

    @property
    def condition(self) -> str:
        """The option and its values, for messages; empty where the modules are always imported."""
        values = ", ".join(pattern for pattern in self.patterns if pattern not in ("*", "True"))
        return f"{self.option.rpartition('.')[2]} {values}".strip()

    @property
    def missing(self) -> tuple[str, ...]:
        """Those of the modules that are not installed."""
        return tuple(module for module in self.modules if not is_installed(module))


_SUMO = Requirement("sim", ("sumo", "libsumo"))
_ARROW = Requirement("map", ("pyarrow",))
_SHAPELY = Requirement("map", ("shapely",))
_GEOPACKAGE = Requirement("map", ("pyogrio", "shapely"))
_PILLOW = Requirement("view", ("PIL",))
_MATPLOTLIB = Requirement("view", ("matplotlib",))


def _require_cloud(*options: str) -> tuple[Requirement, ...]:
    """Return what options need that may be the URL of a store."""
    needs = (("*://*", ("fsspec",)), ("s3://*", EXTRAS["cloud"]))
    return tuple(Requirement("cloud", modules).when(name, url) for name in options for url, modules in needs)


_EXECUTORS = (
    Requirement("dask", EXTRAS["dask"]).when("executor", "dask"),
    Requirement("ray", EXTRAS["ray"]).when("executor", "ray"),
)
_TENSORBOARD = Requirement("train", EXTRAS["train"]).when("compute.tensorboard", "True")
_ZENOH = Requirement("live", ("zenoh",)).when("network.transport", "zenoh")
_MCAP = Requirement("live", ("mcap",))
_CRYPTOGRAPHY = Requirement("live", ("cryptography",))
_GICP = Requirement("icp", EXTRAS["icp"]).when("correctors", "gicp")

REQUIREMENTS: dict[str, tuple[Requirement, ...]] = {
    "demo": (Requirement("sim", EXTRAS["sim"]), Requirement("view", EXTRAS["view"])),
    "check": (),
    "simulate": (_SUMO, _PILLOW.when("cameras", "True"), _PILLOW.when("preset", "*-camera")),
    "train": (_MATPLOTLIB, _SHAPELY.when("preset", "map-*"), _TENSORBOARD),
    "finetune": (_TENSORBOARD,),
    "fit-codebook": (),
    "calibrate": (),
    "evaluate": (),
    "replay": (Requirement("view", EXTRAS["view"]),),
    "export": (),
    "view": (
        _PILLOW.unless("rerun", "mcap"),
        Requirement("rerun", EXTRAS["rerun"]).when("rerun", "*"),
        _MCAP.when("mcap", "*"),
        _ARROW.when("map", "*"),
        _SHAPELY.when("map", "*"),
        *_require_cloud("map"),
    ),
    "pose": (_GICP,),
    "doctor": tuple(Requirement(extra, EXTRAS[extra]).when("compile", "True") for extra in ("sim", "view")),
    "report docs": (_MATPLOTLIB,),
    "report check-cells": (),
    "map build": (_ARROW, _SHAPELY, _MATPLOTLIB),
    "map simulate": (_ARROW, _SHAPELY),
    "map import": (
        _ARROW,
        _SHAPELY.when("sources", "*.osm", "*log_map_archive_*.json"),
        Requirement("map", ("pyogrio", "shapely", "pyproj")).when("sources", "*.gpkg", "*.geojson"),
        *_require_cloud("sources"),
    ),
    "map fuse": (
        _ARROW,
        _SHAPELY.when("method", "polymerge", "global-map-builder", "heatmap-buffer"),
        _SHAPELY.when("store", "*"),
        *_EXECUTORS,
        *_require_cloud("store"),
    ),
    "map retract": (_ARROW, _SHAPELY, *_EXECUTORS, *_require_cloud("store")),
    "map evaluate": (_ARROW, _SHAPELY, *_require_cloud("folder", "truth")),
    "map diff": (_ARROW, *_require_cloud("old", "new")),
    "map export": (
        _ARROW,
        _SHAPELY.when("format", "geoparquet"),
        _SHAPELY.when("file", "*.parquet"),
        _GEOPACKAGE.when("format", "geopackage", "pmtiles"),
        _GEOPACKAGE.when("file", "*.gpkg", "*.pmtiles"),
        Requirement("map", ("pyproj",)).when("crs", "*:*"),
        *_require_cloud("folder"),
    ),
    "map view": (_ARROW, _SHAPELY, _MATPLOTLIB.when("out", "*.png"), *_require_cloud("folder", "truth")),
    "live run": (
        _ZENOH,
        _CRYPTOGRAPHY.when("security.security", "warn", "require"),
        _MCAP.when("record", "*"),
        Requirement("metrics", EXTRAS["metrics"]).when("metrics", "*"),
    ),
    "live demo": (Requirement("live", EXTRAS["live"]), _ARROW.when("map", "True"), _SHAPELY.when("map", "True")),
    "live map": (
        _ZENOH,
        _CRYPTOGRAPHY.when("security.security", "warn", "require"),
        _ARROW,
        _SHAPELY,
    ),
    "live replay": (_MCAP, _CRYPTOGRAPHY),
    "live export": (_MCAP, _CRYPTOGRAPHY),
    "keys anchor": (_CRYPTOGRAPHY,),
    "keys issue": (_CRYPTOGRAPHY,),
    "keys pool": (_CRYPTOGRAPHY,),
    "keys show": (),
    "keys verify": (_CRYPTOGRAPHY,),
    "keys revoke": (_CRYPTOGRAPHY,),
    "keys trust": (_CRYPTOGRAPHY,),
    "keys demo": (_CRYPTOGRAPHY,),
    "study main-table": (),
    "study robustness": (_MATPLOTLIB,),
    "study bandwidth": (_MATPLOTLIB,),
    "study byte-curves": (_MATPLOTLIB,),
    "study shared-bandwidth": (_MATPLOTLIB,),
    "study num-agents": (_MATPLOTLIB,),
    "study sensors": (_MATPLOTLIB,),
    "study attacks": (_MATPLOTLIB,),
    "study false-accusations": (_SUMO,),
    "study strata": (),
    "study ablation": (_MATPLOTLIB,),
    "study qualitative": (_PILLOW,),
    "study pose-noise-ap": (_MATPLOTLIB,),
    "study pose-estimation": (_MATPLOTLIB, _GICP),
    "study feakm": (_MATPLOTLIB,),
    "study local": (_SHAPELY, _MATPLOTLIB),
    "study semi-global": (_SHAPELY, _MATPLOTLIB),
    "study full-map": (_SHAPELY, _MATPLOTLIB),
    "study map-pose-noise": (_SHAPELY, _MATPLOTLIB),
    "study fusion": (_SHAPELY,),
    "study fleet-pose-noise": (_SHAPELY,),
    "study crowdmap-table3": (_SHAPELY,),
    "study adversarial": (_SHAPELY,),
    "study malicious-agents": (_SHAPELY, _MATPLOTLIB),
    "study tuning": (_SHAPELY,),
}
"""Requirements of every command, studies included."""


def is_installed(module: str) -> bool:
    """Return whether a module is found, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a finder that refuses it, or None in sys.modules
        return False


def check_requirements(command: str, options: Any) -> None:
    """Check that what a command imports with these options is installed.

    Raises:
        MissingExtraError: something is not installed; the text names the extras that install it.
    """
    unmet = [r for r in REQUIREMENTS[command] if r.applies(options) and r.missing]
    if unmet:
        conditions = [f"with {r.condition}" for r in unmet if r.condition]
        extras = ",".join(dict.fromkeys(r.extra for r in unmet))
        raise MissingExtraError(extras, " ".join((command, *dict.fromkeys(conditions))))
