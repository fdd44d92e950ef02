# SPDX-License-Identifier: Apache-2.0
"""Every tensor that ops, models and training make from nothing names its device: a default would be the CPU beside a GPU."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "manyeyes"
FACTORIES = frozenset(
    (
        "arange",
        "as_tensor",
        "empty",
        "eye",
        "full",
        "linspace",
        "logspace",
        "normal",
        "ones",
        "rand",
        "randint",
        "randn",
        "randperm",
    )
    + ("scalar_tensor", "tensor", "tril_indices", "triu_indices", "zeros")
)


def find_calls_without_device(text: str) -> Iterator[int]:
    """Yield the lines of factory calls of torch that name no device."""
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        owner = node.func.value
        is_factory = isinstance(owner, ast.Name) and owner.id == "torch" and node.func.attr in FACTORIES
        if is_factory and not any(keyword.arg in ("device", None) for keyword in node.keywords):
            yield node.lineno


@pytest.mark.parametrize("package", ["ops", "models", "training"])
def test_every_factory_call_names_a_device(package):
    files = sorted((SOURCE / package).rglob("*.py"))
    assert len(files) > 10
    found = [
        f"{path.relative_to(SOURCE)}:{line}" for path in files for line in find_calls_without_device(path.read_text())
    ]
    assert not found


def test_the_check_finds_a_call_without_device():
    text = "import torch\nx = torch.zeros(3)\ny = torch.zeros(3, device=x.device)\nz = x.new_zeros(3)\nw = torch.arange(\n  4)\n"
    assert list(find_calls_without_device(text)) == [2, 5]
