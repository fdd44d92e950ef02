# SPDX-License-Identifier: Apache-2.0
"""Devices of a run by name, without a GPU: the number that torch finds is set."""

from __future__ import annotations

import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.training.devices import open_device, resolve_device


@pytest.fixture
def gpus(monkeypatch):
    def find(count: int) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)

    return find


@pytest.mark.parametrize(
    ("name", "count", "rank", "expected"),
    [
        ("auto", 0, None, "cpu"),
        ("auto", 0, 1, "cpu"),
        ("auto", 2, None, "cuda:0"),
        ("auto", 2, 1, "cuda:1"),
        ("cpu", 2, None, "cpu"),
        ("cuda", 2, None, "cuda:0"),
        ("cuda", 2, 1, "cuda:1"),
        ("cuda:1", 2, None, "cuda:1"),
    ],
)
def test_a_name_is_a_device(gpus, name, count, rank, expected):
    gpus(count)
    assert resolve_device(name, rank) == torch.device(expected)


@pytest.mark.parametrize(
    ("name", "count", "rank", "error"),
    [
        ("gpu", 2, None, "--device is auto, cpu, cuda or cuda:N; got 'gpu'."),
        ("cuda:", 2, None, "got 'cuda:'"),
        ("cpu:0", 2, None, "got 'cpu:0'"),
        ("cuda", 0, None, "finds no GPU; install a CUDA build of torch .* or give --device cpu"),
        ("cuda:2", 2, None, "torch finds 2 GPUs, and none is number 2"),
        ("cuda", 2, 2, "start fewer processes"),
        ("cuda:1", 2, 0, "give --device cuda."),
    ],
)
def test_a_device_that_is_not_there_is_an_error_that_names_the_remedy(gpus, name, count, rank, error):
    gpus(count)
    with pytest.raises(ConfigError, match=error):
        resolve_device(name, rank)


def test_one_process_has_no_group(gpus):
    gpus(0)
    with open_device("auto") as device:
        assert device.type == "cpu" and not torch.distributed.is_initialized()
