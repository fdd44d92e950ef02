# SPDX-License-Identifier: Apache-2.0
"""One torch thread for every test; profiles of hypothesis; real maps are read where they are; a device beside the CPU."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings
from tests.emulated_device import DEVICE, emulate

torch.set_num_threads(1)

# The same examples in every run of "ci" and "fast"; other ones in every run of "nightly".
CI = settings(deadline=None, derandomize=True, max_examples=200, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", CI)
settings.register_profile("fast", CI, max_examples=20)
settings.register_profile("nightly", CI, max_examples=2000, derandomize=False, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

# Golden numbers are those of float32 products; tests of bfloat16 name it.
os.environ["MANYEYES_BFLOAT16"] = "0"

_MAPS = Path(__file__).resolve().parents[2] / "shared" / "data"
if _MAPS.is_dir():
    os.environ.setdefault("MANYEYES_MAPS", str(_MAPS))
    os.environ.setdefault("MANYEYES_TOWNS", str(_MAPS / "carla_opendrive"))


@pytest.fixture(params=["emulated", "cuda"])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """A device beside the CPU: the emulated one everywhere, and a GPU where there is one."""
    if request.param == "emulated":
        with emulate():
            yield DEVICE
    elif torch.cuda.is_available():
        # Convolutions of float32, as those that are compared with.
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            yield torch.device("cuda", 0)
    else:
        pytest.skip("needs a GPU; torch finds none")


@pytest.fixture
def is_gpu(request: pytest.FixtureRequest) -> bool:
    """Whether the fixture device is a GPU, whose operators round otherwise than the CPU's, and not the emulated device."""
    return request.node.callspec.params["device"] == "cuda"
