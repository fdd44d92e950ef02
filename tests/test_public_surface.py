# SPDX-License-Identifier: Apache-2.0
"""What `import manyeyes` offers, name by name."""

from __future__ import annotations

import subprocess
import sys

import manyeyes


def test_the_public_names_are_these() -> None:
    assert manyeyes.__all__ == [
        "Agent",
        "AgentFrame",
        "Argoverse2Recording",
        "BevGrid",
        "Boxes",
        "DairRecording",
        "Inbox",
        "ManyeyesError",
        "Message",
        "Opv2vRecording",
        "Perception",
        "PointCloud",
        "Snapshot",
        "SparseBev",
        "Transform",
        "load_detector",
    ]
    assert all(callable(getattr(manyeyes, name)) for name in manyeyes.__all__)


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, manyeyes; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
