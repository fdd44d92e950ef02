# SPDX-License-Identifier: Apache-2.0
"""One torch thread for every test; hypothesis draws the same examples every time; real maps are read where they are."""

import os
from pathlib import Path

import hypothesis
import torch

torch.set_num_threads(1)
hypothesis.settings.register_profile("manyeyes", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("manyeyes")

_MAPS = Path(__file__).resolve().parents[2] / "shared" / "data"
if _MAPS.is_dir():
    os.environ.setdefault("MANYEYES_MAPS", str(_MAPS))
    os.environ.setdefault("MANYEYES_TOWNS", str(_MAPS / "carla_opendrive"))
