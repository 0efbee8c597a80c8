"""Read and write which kernels the demo calls, and with which types: `tools/signatures.py` makes the list."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from numba import types
from numba.core.dispatcher import Dispatcher

from barsight.core.compiling.cache import KernelCache


@dataclass(frozen=True)
class Listed:
    """A kernel by module and name, and the types of its arguments as JSON values."""

    module: str
    name: str
    arguments: Sequence[Any]

    def missing(self) -> bool:
        """Return whether the cache could hold this kernel's machine code but doesn't."""
        kernel = self.kernel()
        cache = kernel._cache
        return isinstance(cache, KernelCache) and not cache.holds(self.types(), kernel.targetctx)

    def compile(self) -> None:
        """Compile into the cache."""
        self.kernel().compile(self.types())

    def kernel(self) -> Any:
        """Return Numba's dispatcher; imports the module."""
        found = getattr(importlib.import_module(self.module), self.name)
        return found if isinstance(found, Dispatcher) else found.__wrapped__

    def types(self) -> tuple[types.Type, ...]:
        """Return the types of the arguments, Numba's."""
        return tuple(map(_read, self.arguments))


def listed(*groups: str) -> list[Listed]:
    """Return the kernels of some groups, "simulate" or "measure"."""
    text = (files(__package__) / "signatures.json").read_text(encoding="utf-8")
    lists = json.loads(text)
    return [Listed(*one) for group in groups for one in lists[group]]


def written(kind: types.Type) -> Any:
    """Convert a type to a JSON value: a number's name, a constant behind "literal", an array's element,
    dimensions and layout, or members behind "tuple" or the class of a named tuple.
    """
    if isinstance(kind, types.Literal):
        return ["literal", kind.literal_value]
    if isinstance(kind, types.Array):
        return [str(kind.dtype), kind.ndim, kind.layout] + ([] if kind.mutable else ["readonly"])
    if isinstance(kind, types.BaseNamedTuple):
        home = kind.instance_class
        return [f"{home.__module__}:{home.__qualname__}", *map(written, kind)]
    if isinstance(kind, types.BaseTuple):
        return ["tuple", *map(written, kind)]
    return str(kind)


def _read(value: Any) -> types.Type:
    if isinstance(value, str):
        return types.boolean if value == "bool" else getattr(types, value)
    head, *rest = value
    if head == "literal":
        return types.literal(*rest)
    if head == "tuple":
        return types.BaseTuple.from_types(tuple(map(_read, rest)))
    if ":" in head:
        module, _, name = head.partition(":")
        home = getattr(importlib.import_module(module), name)
        return types.BaseTuple.from_types(tuple(map(_read, rest)), home)
    dimensions, layout, *flags = rest
    return types.Array(_read(head), dimensions, layout, readonly="readonly" in flags)
