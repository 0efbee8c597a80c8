"""Cache a kernel's machine code for as long as everything that it was compiled from stays the same."""

from __future__ import annotations

import functools
import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from llvmlite import binding
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary

_LIBRARIES = ("numba", "numpy", "llvmlite")
"""Libraries that aren't followed, since their versions are part of every cache already."""
_SCALARS = (bool, int, float, complex, str, bytes, type(None), np.generic)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Disk cache of one kernel, keyed to its options and to all sources that it reaches.

    Numba's own key is the kernel's file alone. But the code of the functions that it calls is copied into it,
    and would stay outdated after a change of their files.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        """Find the folder; raises RuntimeError where none may be written."""
        super().__init__(function)
        self._own = (self._cache_file._source_stamp, sorted(options.items()))
        _digest(function.__code__.co_filename)  # of what is imported now, not of what may replace it later

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature, None if there is none or something in it has changed.

        Processes that begin with an empty cache may write the code of two signatures to one file.
        """
        self._stamp()
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # it names a class that is no more, or was torn
            self.flush()
            return None
        if found is None or tuple(found.signature.args) != tuple(sig):
            return None
        _PackedLibrary.pack(found.library)
        return found

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Return whether the code for a signature is there."""
        self._stamp()
        try:
            return self._index_key(sig, target_context.codegen()) in self._cache_file._load_index()
        except Exception:  # as above
            self.flush()
            return False

    def _stamp(self) -> None:
        """Stamp the index. This happens late, since what the kernel calls may be defined after the kernel."""
        self._cache_file._source_stamp = (*self._own, sources_digest(self._py_func))


class _PackedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code whose LLVM module is kept as bitcode, an eighth of its size.

    Only a kernel that is compiled anew and calls this one needs the module.
    """

    @classmethod
    def pack(cls, library: JITCodeLibrary) -> None:
        """Pack a library that was loaded from the cache."""
        library._bitcode = library._shared_module.as_bitcode()
        library._shared_module = None
        library.__class__ = cls

    def _get_module_for_linking(self) -> binding.ModuleRef:
        return binding.parse_bitcode(self._bitcode)


def sources_digest(function: Any) -> str:
    """Hash the files of all functions and classes that a function reaches by its globals, and the values of
    the constants among them.
    """
    waiting, reached, facts = [function], {function}, set()
    for one in waiting:
        facts.add(_digest(one.__code__.co_filename))
        for name, value in named(one):
            inner = inspect.unwrap(value) if callable(value) else value
            if isinstance(inner, FunctionType):
                if inner not in reached and not _is_library(inner):
                    reached.add(inner)
                    waiting.append(inner)
            elif isinstance(inner, type):
                if not _is_library(inner):
                    facts.add(_digest(getattr(sys.modules.get(inner.__module__), "__file__", None) or name))
            else:
                facts.add(f"{name} = {_text(inner)}")
    return hashlib.sha256("\n".join(sorted(facts)).encode()).hexdigest()


def named(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the globals that a function or its annotations name, and what it closes over."""
    names = set(re.findall(r"\w+", " ".join(map(str, function.__annotations__.values()))))
    codes = [function.__code__]
    for code in codes:
        names.update(code.co_names)
        codes += [part for part in code.co_consts if isinstance(part, CodeType)]
    for name in names & function.__globals__.keys():
        value = function.__globals__[name]
        if isinstance(value, ModuleType):
            yield name, value.__name__
            if not _is_library(value):
                yield from ((one, getattr(value, one)) for one in names & vars(value).keys())
        else:
            yield name, value
    yield from inspect.getclosurevars(function).nonlocals.items()


def _is_library(value: Any) -> bool:
    home = value.__name__ if isinstance(value, ModuleType) else value.__module__ or ""
    return home.partition(".")[0] in _LIBRARIES or home == "builtins"


def _text(value: Any) -> str:
    if isinstance(value, _SCALARS):
        return repr(value)
    if isinstance(value, tuple):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    return type(value).__qualname__


@functools.cache
def _digest(path: str) -> str:
    """Hash a source file as it was when first asked for. If it isn't a file, hash its name alone."""
    file = Path(path)
    return f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else path}"
