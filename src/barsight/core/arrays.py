"""Define array aliases, shape checks, small sums, and the compile decorator that every kernel uses."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from barsight.core.compiling.cache import KernelCache

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
Int8 = NDArray[np.int8]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]

F = TypeVar("F", bound=Callable[..., Any])

_ALL_CORES = threading.Lock()
# Else OpenMP's idle threads spin after each kernel, on the cores that another frame's work could have.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def kernel(*, parallel: bool = False, inline: bool = False, borrows: bool = False) -> Callable[[F], F]:
    """Compile a function with Numba, cached on disk so that a second run starts at once.

    The cache holds until the kernel or anything that it calls changes (`core.compiling.cache`).
    Where no folder may be written (a read-only installation and home), every run compiles anew.
    No kernel reorders sums (Numba's `fastmath`): their order would follow the processor's vector length and
    whether a function that it calls came from the cache, so that two runs of one recording could differ.
    A division by zero gives inf or NaN as in NumPy: the check for it would keep loops from being vectorised.
    A `parallel` kernel takes all cores, and calls from several threads take turns (Numba's plainest threading
    layer aborts when two enter it); other kernels can't call it. It compiles several times as long as a plain
    one, which `core.parallel.in_bands` spreads over the cores as well.
    `inline` copies a short function into the kernels that call it: a call hands over each array as nine
    numbers and hides from the compiler which of them overlap, which can cost more than the sums inside.
    `borrows` counts no references to the arrays that it is given nor to parts of them, for a kernel that
    makes and returns none: threads that share an array wait for each other at each count.
    """
    options: dict[str, Any] = {
        "parallel": parallel, "nogil": True, "error_model": "numpy",
        "inline": "always" if inline else "never",
    }  # fmt: skip
    if borrows:
        options["_nrt"] = False

    def decorate(function: F) -> F:
        compiled: Any = numba.njit(**options)(function)
        with contextlib.suppress(RuntimeError):
            compiled._cache = KernelCache(function, options)
        if not parallel:
            return cast(F, compiled)
        return cast(F, _in_turn(compiled, numba.njit(**(options | {"parallel": False}))(function)))

    return decorate


def _in_turn(compiled: Any, plain: Any) -> Any:
    """Take all cores in turn; a fork of a process that took them takes one (GNU's OpenMP would end it)."""

    @functools.wraps(compiled)
    def call(*arguments: Any) -> Any:
        if _first_process() != os.getpid():
            return plain(*arguments)
        with _ALL_CORES:
            return compiled(*arguments)

    return call


@functools.cache
def _first_process() -> int:
    """Return the process that was first to take all cores, of this one and those it was forked from."""
    return os.getpid()


def expect_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array.shape` matches `shape`, where None matches any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "x".join("N" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}")


def rows_by_number(numbers: NDArray[Any]) -> dict[int, Int64]:
    """List the rows that hold each number, in their order."""
    if numbers.size == 0:
        return {}
    order = np.argsort(numbers, kind="stable")
    found, first = np.unique(numbers[order], return_index=True)
    return {int(n): rows for n, rows in zip(found, np.split(order, first[1:]), strict=True)}


def rms(vectors: Float64) -> float:
    """Compute the root mean square of the lengths of vectors (N, K)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view: what a frozen dataclass hands out can't be written through."""
    view = array.view()
    view.flags.writeable = False
    return view
