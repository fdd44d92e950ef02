# SPDX-License-Identifier: Apache-2.0
"""How loops are compiled: numba's njit, whose results are kept on disk by one process at a time.

numba numbers the cache files of a function's variants: two processes that compile two variants at the same time use one file name
for both, and later processes load the wrong variant without an error. Workers that start together on a fresh installation are such
processes.

numba distinguishes functions of one name, such as closures of one definition, by a number that each process counts for itself.
Code of two processes can have equal names for different functions, and a process that loads both from disk runs the first for
both: wrong results, or memory written out of bounds. Here the number follows from what the function is.

numba makes machine code of every loop that another one calls, and optimises it again in each caller. Here a loop that a compiled
one calls is only linked into it, and optimised there, and so is what numba itself has of numpy's functions, so that a fresh
installation compiles in about half the time. It has one form for all constants of a type that callers pass. A loop that Python
calls is compiled and kept as numba does it. Every compiled loop of the package takes njit from here.
"""

from __future__ import annotations

import gc
import hashlib
import pickle
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Literal, TypeVar, cast

import numpy as np
from filelock import FileLock
from numba import jit
from numba.core import caching, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering
from numba.core.typing.templates import _OverloadFunctionTemplate

__all__ = [
    "Boolx1",
    "Boolx2",
    "F32x1",
    "F32x2",
    "F32x3",
    "F32x4",
    "F32x5",
    "F64x1",
    "F64x2",
    "F64x3",
    "I8x2",
    "I32x1",
    "I32x2",
    "I64x1",
    "I64x2",
    "I64x3",
    "U8x1",
    "U8x2",
    "Uintpx1",
    "add_row",
    "find_cache_folder",
    "njit",
    "set_row",
    "set_rows",
]


_Function = TypeVar("_Function", bound=Callable[..., Any])


_NAMES = "names by content"
"""Of the code on disk; code with other names is compiled anew."""
_PROCESS = uuid.uuid4().hex
"""Part of the number of functions whose content is unknown, so that no other process has it."""


class _LockedIndexFile(caching.IndexDataCacheFile):
    """numba's index of a function's variants and of their files, locked while it is read or written."""

    def __init__(self, cache_path: str, filename_base: str, source_stamp: Any) -> None:
        super().__init__(cache_path, filename_base, (source_stamp, _NAMES))

    def load(self, key: Any) -> Any:
        with self._lock():
            return super().load(key)

    def save(self, key: Any, data: Any) -> None:
        with self._lock():
            super().save(key, data)

    def _load_index(self) -> Any:
        """Return the variants; none where the index is damaged or names classes of other code, so that they are compiled anew."""
        try:
            return super()._load_index()
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}

    def _lock(self) -> FileLock:
        return FileLock(f"{self._index_path}.lock")


caching.IndexDataCacheFile = _LockedIndexFile


class _LinkedLibrary(JITCodeLibrary):
    """The intermediate code of a loop, for the libraries of its callers: neither optimised nor made machine code by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


def _describe(value: Any, around: tuple[int, ...] = ()) -> Any:
    """Return what a function, code, or value of a closure is, equal in all processes, or of this process alone.

    around: of the values that it is a part of, by id.
    """
    if id(value) in around:
        return "recursion", around.index(id(value))
    describe = partial(_describe, around=(*around, id(value)))
    if isinstance(value, CPUDispatcher):
        return describe(value.py_func)
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        return value.__module__, value.__qualname__, describe(value.__code__), [*map(describe, cells)]
    if isinstance(value, CodeType):
        return value.co_code.hex(), value.co_names, [*map(describe, value.co_consts)]
    if isinstance(value, tuple):
        return "tuple", [*map(describe, value)]
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic | types.Type):
        return type(value).__name__, repr(value)
    return _PROCESS, id(value)


def _number_by_content(identity: Any, form: str) -> None:
    """Name a function after its content before it is compiled; form: of its code, as one function has several."""
    digest = hashlib.sha256(repr((form, _describe(identity.func))).encode()).digest()
    identity.unique_id = int.from_bytes(digest[:8], "big")
    identity.unique_name = f"{identity.func_qualname}${identity.unique_id}"


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(NativeLowering):
    """numba's last pass, ending with a _LinkedLibrary."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> Literal[True]:
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        # Callers find the loop by its entry point, which must be a builtin; this one is never called.
        entry_point = object().__reduce__
        state.targetctx.insert_user_function(entry_point, state["cr"].fndesc, [state.library])
        state["cr"] = state["cr"]._replace(cfunc=entry_point)
        return True


class _LoopCompiler(CompilerBase):
    """numba's compiler, of functions that are named after their content."""

    lowering: type[NativeLowering] = NativeLowering

    def define_pipelines(self) -> list[Any]:
        _number_by_content(self.state.func_id, type(self).__name__)
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [(self.lowering if step is NativeLowering else step, why) for step, why in manager.passes]
        manager.finalize()
        return [manager]


class _LinkedCompiler(_LoopCompiler):
    """The same, ending with a _LinkedLibrary."""

    lowering = _LinkedLowering


def _get_jit_decorator(self: _OverloadFunctionTemplate) -> Any:
    """Return numba's decorator for its implementations of numpy's and Python's functions; on the CPU they end as linked loops."""
    assert _get_decorator is not None
    decorator = _get_decorator(self)
    return partial(decorator, pipeline_class=_LinkedCompiler, no_cfunc_wrapper=True) if decorator is jit else decorator


# A version of numba without the method compiles its own functions as they are, which takes longer.
_get_decorator = getattr(_OverloadFunctionTemplate, "_get_jit_decorator", None)
if _get_decorator is not None:
    _OverloadFunctionTemplate._get_jit_decorator = _get_jit_decorator


class _CompiledLoop(CPUDispatcher):
    """A loop to be called from Python, and its form for callers that are compiled."""

    def __init__(
        self,
        py_func: Any,
        locals: Any = None,
        targetoptions: Any = None,
        pipeline_class: type[CompilerBase] = _LoopCompiler,
    ) -> None:
        # Some versions of numba take no None.
        locals, targetoptions = locals or {}, {**(targetoptions or {}), "no_cfunc_wrapper": True}
        super().__init__(py_func, locals, targetoptions, pipeline_class)
        self._linked = CPUDispatcher(py_func, locals, {**targetoptions, "no_cpython_wrapper": True}, _LinkedCompiler)

    def compile(self, sig: Any) -> Any:
        with _without_garbage_collection():
            return super().compile(sig)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Find the form for a compiled caller's types; one for all constants of a type, where numba compiles one for each."""
        general = tuple(map(types.unliteral, args)), {name: types.unliteral(kind) for name, kind in kws.items()}
        return self._linked.get_call_template(*general)

    def get_overload(self, sig: Any) -> Any:
        return self._linked.get_overload(sig)

    @property
    def is_compiling(self) -> Any:
        return super().is_compiling or self._linked.is_compiling


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Leave garbage for later: a compiler makes so many objects that all those of torch would be searched again and again."""
    is_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_enabled:
            gc.enable()


def njit(*, cache: bool = False, **options: Any) -> Callable[[_Function], _Function]:
    """Return numba's decorator of the same name, for functions without signatures; options: its other options.

    A loop is compiled at its first call, for the types of the arguments; cache: keep it on disk, where a folder can be written.
    """

    def decorate(function: _Function) -> _Function:
        loop = _CompiledLoop(function, targetoptions={"nopython": True, "boundscheck": None, **options})
        if cache:
            # numba finds neither the package's folder nor that of the user writable.
            with suppress(RuntimeError):
                loop.enable_caching()
        return cast(_Function, loop)

    return decorate


def find_cache_folder() -> Path | None:
    """Return the folder where the loops of this module are kept on disk; None where they are not, as no folder can be written."""
    path = cast(Any, set_row)._cache.cache_path
    return None if path is None else Path(path)


Int64 = int | np.int64
"""Integer of a compiled loop."""

# Arrays of compiled loops: element type and number of dimensions.
Boolx1 = np.ndarray[tuple[int], np.dtype[np.bool_]]
Boolx2 = np.ndarray[tuple[int, int], np.dtype[np.bool_]]
F32x1 = np.ndarray[tuple[int], np.dtype[np.float32]]
F32x2 = np.ndarray[tuple[int, int], np.dtype[np.float32]]
F32x3 = np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
F32x4 = np.ndarray[tuple[int, int, int, int], np.dtype[np.float32]]
F32x5 = np.ndarray[tuple[int, int, int, int, int], np.dtype[np.float32]]
F64x1 = np.ndarray[tuple[int], np.dtype[np.float64]]
F64x2 = np.ndarray[tuple[int, int], np.dtype[np.float64]]
F64x3 = np.ndarray[tuple[int, int, int], np.dtype[np.float64]]
I8x2 = np.ndarray[tuple[int, int], np.dtype[np.int8]]
I32x1 = np.ndarray[tuple[int], np.dtype[np.int32]]
I32x2 = np.ndarray[tuple[int, int], np.dtype[np.int32]]
I64x1 = np.ndarray[tuple[int], np.dtype[np.int64]]
I64x2 = np.ndarray[tuple[int, int], np.dtype[np.int64]]
I64x3 = np.ndarray[tuple[int, int, int], np.dtype[np.int64]]
U8x1 = np.ndarray[tuple[int], np.dtype[np.uint8]]
U8x2 = np.ndarray[tuple[int, int], np.dtype[np.uint8]]
Uintpx1 = np.ndarray[tuple[int], np.dtype[np.uintp]]


@njit(cache=True, nogil=True)
def set_row(out: Any, values: Any) -> None:  # pragma: no cover
    """out (N,) = the first N of values (N or more).

    An assignment to a slice would check how many there are; numba takes seconds to compile the error message of that.
    """
    for i in range(out.shape[0]):
        out[i] = values[i]


@njit(cache=True, nogil=True)
def set_rows(out: Any, values: Any) -> None:  # pragma: no cover
    """out (M, N) = values (M, N), as ``set_row`` does."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = values[i, j]


@njit(cache=True, nogil=True)
def add_row(out: Any, values: Any) -> None:  # pragma: no cover
    """out (N,) += the first N of values, as ``set_row`` does."""
    for i in range(out.shape[0]):
        out[i] += values[i]
