# SPDX-License-Identifier: Apache-2.0
"""The guides of the published data sets: their tables of hours are those of the stored estimate, and they name what exists."""

import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

from manyeyes.evaluation.detection.average_precision import PROTOCOLS
from manyeyes.training.presets import TRAINING_PRESETS

ROOT = Path(__file__).resolve().parents[2]


def load_estimate():
    spec = importlib.util.spec_from_file_location("train_flops", ROOT / "benchmarks" / "train_flops.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


ESTIMATE = load_estimate()


@pytest.mark.parametrize("dataset", ESTIMATE.DATASETS, ids=lambda dataset: dataset.preset)
def test_the_table_is_that_of_the_stored_estimate(dataset):
    page = (ESTIMATE.GUIDES / dataset.page).read_text(encoding="utf-8")
    table = ESTIMATE.format_table(ESTIMATE.find_works()[dataset.preset])
    assert "H100" in table and page.count(table) == 1
    assert page == ESTIMATE.replace_table(page, table)


@pytest.mark.parametrize("dataset", ESTIMATE.DATASETS, ids=lambda dataset: dataset.preset)
def test_a_page_names_presets_and_protocols_that_exist(dataset):
    page = (ESTIMATE.GUIDES / dataset.page).read_text(encoding="utf-8")
    assert set(re.findall(r"--preset (\S+)", page)) == {dataset.preset}
    assert dataset.preset in TRAINING_PRESETS
    protocols = set(re.findall(r"--protocol (\S+)", page))
    assert protocols and protocols <= set(PROTOCOLS)


def test_hours_follow_the_slower_of_host_and_device():
    work = {"frames": 4000, "gflop": {"encoder": 2000.0}, "gigabytes": 8.0, "views": 2.0}
    gpu = ESTIMATE.Gpu("card", 100.0, 1.0)
    # 2 TFLOP at 35 TFLOP/s, and 8 GB at 0.8 TB/s.
    assert ESTIMATE.device_ms(work, gpu) == pytest.approx(1000 * 2 / 35 + 10)
    rows = [line.split("|") for line in ESTIMATE.format_table(work).splitlines() if line.startswith("| H100")]
    assert [float(cell) for cell in rows[0][3:6]] == [4.1, 2.2, 2.2]


def test_the_table_of_steps_is_that_of_the_stored_runs():
    spec = importlib.util.spec_from_file_location("preset_steps", ROOT / "benchmarks" / "preset_steps.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    rows = json.loads((ROOT / "benchmarks" / "results" / "preset_steps.json").read_text(encoding="utf-8"))["result"]
    pages = {dataset.preset: dataset.page for dataset in ESTIMATE.DATASETS}
    for preset in {row["preset"] for row in rows}:
        page = (ESTIMATE.GUIDES / pages[preset]).read_text(encoding="utf-8")
        assert page.count(module.format_table([row for row in rows if row["preset"] == preset])) == 1
