# SPDX-License-Identifier: Apache-2.0
"""Runs that are compared differ in the network alone."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "preset_steps.py"


@pytest.mark.parametrize("preset", ["costr-opv2v", "costr-dair"])
def test_both_networks_have_the_same_range_and_schedule(preset):
    spec = importlib.util.spec_from_file_location("preset_steps", PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["preset_steps"] = module
    spec.loader.exec_module(module)
    wide, small = (module.make_config(preset, network, 200) for network in module.NETWORKS)
    assert replace(small, detector=wide.detector) == wide and wide.steps == 200
    for name in ("grid", "output_range", "sweeps"):
        assert getattr(small.detector, name) == getattr(wide.detector, name)
    assert small.detector.encoder != wide.detector.encoder
