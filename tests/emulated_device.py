# SPDX-License-Identifier: Apache-2.0
"""A second device without a GPU: tensors that are on cuda:0 for Python, computed on the CPU, and refused beside CPU tensors.

Three hooks of torch cooperate. A wrapper subclass holds a CPU tensor and reports cuda:0 to Python; to C++ it reports ``meta``,
since autograd of a CPU build aborts for a tensor on cuda. A dispatch mode executes every operator that meets such a
tensor, or that makes one, on the held tensors; it checks and counts the call before. A function mode turns the device of
factories and ``to`` into ``meta``, and stays active in the backward pass, which torch would otherwise run without it.

    with emulate() as record:
        model.to(DEVICE)(x.to(DEVICE)).sum().backward()
    record.num_calls, record.num_syncs, record.report()

Refused (:class:`DeviceMixError`, with file and line): operators that mix devices, except those that CUDA allows (a copy; a CPU
scalar in a pointwise operator), and reading a device tensor as numpy. Counted as synchronisations are operators whose result
the host has to wait for: values and copies that go to the host, and results whose size depends on values.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("cuda", 0)
_HOST, _REPORTED = torch.device("cpu"), torch.device("meta")
_WAITING = frozenset(
    (
        "_local_scalar_dense",
        "nonzero",
        "masked_select",
        "_unique2",
        "unique_dim",
        "unique_consecutive",
        "bincount",
        "equal",
    )
    + ("repeat_interleave", "is_nonzero", "histc")
)
"""Operators that CUDA cannot return from before the device has caught up."""
_INDEXING = frozenset(("index", "index_put", "index_put_", "_unsafe_index", "_index_put_impl_"))
_COPIES = frozenset(("copy_", "_to_copy"))


_CONTAINERS = (tuple, list, dict)


def _leaves(tree: Any, found: list[Any]) -> list[Any]:
    """Append what a tree of tuples, lists and dictionaries holds, in order; torch's pytree does so ten times slower."""
    if isinstance(tree, dict):
        tree = tree.values()
    for leaf in tree:
        if isinstance(leaf, _CONTAINERS):
            _leaves(leaf, found)
        else:
            found.append(leaf)
    return found


def _map_leaves(function: Callable[[Any], Any], tree: Any) -> Any:
    """Return a tree of tuples, lists and dictionaries with function of each leaf; a tree of which none changes is itself."""
    if isinstance(tree, dict):
        made = {key: _map_leaves(function, value) for key, value in tree.items()}
        changed = any(made[key] is not value for key, value in tree.items())
    elif isinstance(tree, tuple | list):
        made = [_map_leaves(function, value) for value in tree]
        changed = any(new is not old for new, old in zip(made, tree))
    else:
        return function(tree)
    if not changed:
        return tree
    if isinstance(tree, tuple) and hasattr(tree, "_fields"):
        return type(tree)(*made)
    # Results of torch such as those of max(dim) take one sequence.
    return type(tree)(made)


class DeviceMixError(RuntimeError):
    """Tensors of two devices meet in one operator, or a device tensor is read where only the CPU's memory can be."""


@dataclass
class Record:
    """What happened on the device.

    calls: number of operator calls by (file:line of the package, operator). syncs: the same of synchronisations. uploads: the
    same of copies from the host to the device.
    """

    root: str
    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    syncs: Counter[tuple[str, str]] = field(default_factory=Counter)
    uploads: Counter[tuple[str, str]] = field(default_factory=Counter)

    @property
    def num_calls(self) -> int:
        """Number of operator calls on the device."""
        return sum(self.calls.values())

    @property
    def num_syncs(self) -> int:
        """Number of times that the host waited for the device."""
        return sum(self.syncs.values())

    def locate(self) -> str:
        """Return file:line of the innermost frame that lies below root."""
        frame = sys._getframe(1)
        while frame is not None:
            name = frame.f_code.co_filename
            if self.root in name and name != __file__:
                return f"{name.rsplit(self.root, 1)[1]}:{frame.f_lineno}"
            frame = frame.f_back
        return "elsewhere"

    def report(self, largest: int = 25) -> str:
        """Return the places with the most calls and synchronisations, one a line."""
        lines = []
        for name, counts in (
            ("operator calls", self.calls),
            ("synchronisations", self.syncs),
            ("uploads", self.uploads),
        ):
            places: Counter[str] = Counter()
            for (place, _), count in counts.items():
                places[place] += count
            lines.append(f"{name}: {sum(counts.values())}")
            lines += [f"  {count:6d}  {place}" for place, count in places.most_common(largest)]
        return "\n".join(lines)


_ACTIVE: list[Record] = []


class DeviceTensor(torch.Tensor):
    """A tensor on the emulated device; ``held`` is its content on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> DeviceTensor:
        made = torch.Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            layout=held.layout, device=_REPORTED,
        )  # fmt: skip
        made.held = held
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: DEVICE)  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]
    is_cuda = property(lambda self: True)  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]
    is_cpu = property(lambda self: False)  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]
    is_meta = property(lambda self: False)  # pyright: ignore[reportAssignmentType, reportIncompatibleVariableOverride]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _execute(func, args, kwargs or {})

    def __repr__(self, **_: Any) -> str:
        return f"DeviceTensor({self.held!r})"

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        copied: Tensor = DeviceTensor(self.held.detach().clone())
        if isinstance(self, torch.nn.Parameter):
            copied = torch.nn.Parameter(copied, self.requires_grad)
        memo[id(self)] = copied
        return copied

    def tolist(self) -> Any:
        """Return the values, as of a CPU tensor."""
        _record("tolist").syncs[_record("tolist").locate(), "tolist"] += 1
        return self.held.tolist()

    def numpy(self, **_: Any) -> Any:
        """Refused, as on a GPU."""
        raise DeviceMixError(f"numpy() of a device tensor at {_record('numpy').locate()}.")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise DeviceMixError(f"A device tensor is read by numpy at {_record('numpy').locate()}.")


def is_emulated(device: Any) -> bool:
    """Return whether a device, or its name, is the emulated one."""
    return isinstance(device, str | torch.device) and torch.device(device).type in (DEVICE.type, _REPORTED.type)


def _record(name: str) -> Record:
    if not _ACTIVE:
        raise DeviceMixError(f"{name} of a device tensor outside of emulate().")
    return _ACTIVE[-1]


def _execute(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Check and count an operator call, run it on the held tensors, and wrap what it returns."""
    name: str = func._schema.name.split("::")[1]
    record = _record(name)
    where = record.locate()
    leaves = _leaves((args, kwargs), [])
    ours = [leaf for leaf in leaves if isinstance(leaf, DeviceTensor)]
    strays = [leaf for leaf in leaves if isinstance(leaf, Tensor) and not isinstance(leaf, DeviceTensor)]
    record.calls[where, name] += 1
    if strays and ours and name not in _COPIES:
        _check_mix(func, strays, f"{name} at {where}")
    goes_to_host = False
    if ours and (name in _WAITING or (name in _INDEXING and _has_mask(args[1]))):
        record.syncs[where, name] += 1
    if name == "copy_" and strays:
        goes_to_host = args[0] is strays[0]
    target = kwargs.get("device")
    if is_emulated(target):
        kwargs = {**kwargs, "device": _HOST}
    elif target is not None and ours:
        goes_to_host = True
    if goes_to_host:
        record.syncs[where, f"{name} to the host"] += 1
    elif strays and name in _COPIES:
        record.uploads[where, name] += 1
    held_args, held_kwargs = _map_leaves(
        lambda leaf: leaf.held if isinstance(leaf, DeviceTensor) else leaf, (args, kwargs)
    )
    returned = func(*held_args, **held_kwargs)
    if goes_to_host:
        return args[0] if name == "copy_" else returned
    wrappers = {id(leaf.held): leaf for leaf in ours}

    def wrap(leaf: Any) -> Any:
        if not _is_plain(leaf):
            return leaf
        return wrappers[id(leaf)] if id(leaf) in wrappers else DeviceTensor(leaf)

    result = _map_leaves(wrap, returned)
    for leaf in ours:
        if leaf.held.shape != leaf.shape:
            raise DeviceMixError(f"{name} at {where} changes the shape of a tensor that it is given.")
    return result


def _is_plain(leaf: Any) -> bool:
    return isinstance(leaf, Tensor) and not isinstance(leaf, DeviceTensor)


def _check_mix(func: Any, strays: list[Tensor], what: str) -> None:
    """Raise DeviceMixError unless all CPU tensors are scalars of a pointwise operator."""
    if torch.Tag.pointwise in func.tags and all(stray.dim() == 0 for stray in strays):
        return
    shapes = ", ".join(str(tuple(stray.shape)) for stray in strays)
    raise DeviceMixError(f"{what}: device tensors meet CPU tensors of shape {shapes}.")


def _has_mask(indices: Any) -> bool:
    return any(isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8) for index in indices or ())


class _Operators(TorchDispatchMode):
    """Executes what meets a device tensor or makes one; also what C++ makes beside them, such as zeros of a missing gradient."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        leaves = _leaves((args, kwargs), [])
        if is_emulated(kwargs.get("device")) or any(isinstance(leaf, DeviceTensor) for leaf in leaves):
            return _execute(func, args, kwargs)
        return func(*args, **kwargs)


class _Devices(TorchFunctionMode):
    """Turns the emulated device in arguments into the one that C++ knows, and keeps this mode in the backward pass."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        if func is torch.device:
            return func(*args, **kwargs)
        if name == "cuda":
            return args[0].to(_REPORTED)
        if name in ("tensor", "as_tensor") and is_emulated(kwargs.get("device")):
            return func(*args, **{**kwargs, "device": _HOST}).to(_REPORTED)
        if name == "new_tensor" and isinstance(args[0], DeviceTensor):
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(_REPORTED)
        if name == "to" and isinstance(args[-1], DeviceTensor) and len(args) == 2:
            return args[0].to(_REPORTED, args[1].dtype)
        args, kwargs = _map_leaves(lambda leaf: _REPORTED if is_emulated_device(leaf) else leaf, (args, kwargs))
        return func(*args, **kwargs)


def is_emulated_device(leaf: Any) -> bool:
    """Return whether an argument is the emulated device as a torch.device, or its plain name."""
    return (isinstance(leaf, torch.device) and is_emulated(leaf)) or (
        isinstance(leaf, str) and leaf in ("cuda", "cuda:0")
    )


@contextmanager
def emulate(root: str = "/manyeyes/") -> Iterator[Record]:
    """Emulate the device in this block; root: part of a path below which places are named."""
    record, devices = Record(root), _Devices()
    inference_mode, run_backward = torch.inference_mode, torch.autograd._engine_run_backward

    def run_backward_emulated(*args: Any, **kwargs: Any) -> Any:
        # torch calls the engine from a handler of the function mode, where that mode is off.
        with devices:
            return run_backward(*args, **kwargs)

    def disable_gradients(mode: bool = True) -> Any:
        # A wrapper made in inference mode cannot be a view of one made outside.
        return torch.no_grad() if mode else torch.enable_grad()

    _ACTIVE.append(record)
    torch.inference_mode = disable_gradients  # pyright: ignore[reportAttributeAccessIssue]
    torch.autograd._engine_run_backward = run_backward_emulated  # pyright: ignore[reportPrivateImportUsage]
    try:
        with devices, _Operators():
            yield record
    finally:
        _ACTIVE.pop()
        torch.inference_mode = inference_mode  # pyright: ignore[reportAttributeAccessIssue]
        torch.autograd._engine_run_backward = run_backward  # pyright: ignore[reportPrivateImportUsage]
