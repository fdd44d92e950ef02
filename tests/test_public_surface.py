# SPDX-License-Identifier: Apache-2.0
"""What `import manyeyes` and its packages offer, name by name."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from importlib import import_module

import pytest

import manyeyes

PACKAGES = [
    module.name
    for module in pkgutil.walk_packages(manyeyes.__path__, "manyeyes.")
    if module.ispkg and hasattr(import_module(module.name), "attach")
]
NAMES = """
Agent AgentFrame Argoverse2Recording BenchmarkConfig BenchmarkResult BevGrid BoxDetector Boxes DairRecording
FusionStrategy Inbox ManyeyesError MapElements Message Observation Opv2vRecording Perception PointCloud
PoseEstimate PosePrior Recording RecordingReader Snapshot SparseBev TokenDetector Transform VectorMap
benchmark correct_pose fuse_maps get_strategy list_correctors list_detectors list_fusion_modules
list_map_fusions list_strategies load_detector open_recording read_observations register_dataset
register_detector register_fusion register_map_fusion register_pose_corrector register_strategy run_benchmark
"""


def test_the_public_names_are_these() -> None:
    assert manyeyes.__all__ == NAMES.split()


@pytest.mark.parametrize("package", ["manyeyes", *PACKAGES])
def test_every_public_name_exists_has_a_docstring_and_is_in_dir(package: str) -> None:
    module = import_module(package)
    assert module.__all__
    for name in module.__all__:
        value = getattr(module, name)
        assert name in dir(module)
        assert name.isupper() or len((value.__doc__ or "").split()) >= 3, f"{package}.{name} has no docstring"


@pytest.mark.parametrize("package", ["manyeyes", *PACKAGES])
def test_no_public_name_hides_a_module(package: str) -> None:
    """The import system binds a submodule to its name in the package, in place of what was there."""
    module = import_module(package)
    assert not set(module.__all__) & {submodule.name for submodule in pkgutil.iter_modules(module.__path__)}


def test_packages_offer_their_names_at_first_use() -> None:
    assert {"manyeyes.agents", "manyeyes.datatypes", "manyeyes.maps", "manyeyes.pose"} <= set(PACKAGES)
    code = f"import sys, manyeyes, {', '.join(PACKAGES)}; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_star_import_binds_the_public_names() -> None:
    names: dict[str, object] = {}
    exec("from manyeyes.datatypes import *", names)
    assert set(import_module("manyeyes.datatypes").__all__) == set(names) - {"__builtins__"}
