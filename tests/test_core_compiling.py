"""Machine code on disk: it follows every source that it was compiled from, and is compiled ahead."""

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numba
import numpy as np
import pytest
from numba import types

import barsight
from barsight.core.arrays import Float64, kernel
from barsight.core.compiling import ahead, signatures
from barsight.core.compiling.signatures import Listed, listed
from barsight.core.linalg.skyline import Skyline

SOURCE = Path(barsight.__file__).parents[1]
NUMBERS = {float: ("float32", "float64", "int64"), int: ("int8", "int32", "int64"), bool: ("bool",)}
"""Types that an annotation stands for."""
SKYLINE, FLOATS, INTS = "barsight.core.linalg.skyline:Skyline", ["float64", 1, "C"], ["int64", 1, "C"]
CALLER = """
from barsight.core.arrays import kernel
from yards.called import Rule, through

@kernel()
def answer(rule: Rule, value: float) -> float:
    return later(value) + rule.first

@kernel()
def later(value: float) -> float:
    return through(value)

if __name__ == "__main__":
    print(answer(Rule(100.0, 200.0), 1.0), len(answer.stats.cache_hits))
"""
CALLED = """
from typing import NamedTuple
from barsight.core.arrays import kernel
from yards.constants import STEP

class Rule(NamedTuple):
    first: float
    second: float

@kernel()
def through(value: float) -> float:
    return value + STEP
"""


@pytest.mark.slow
def test_a_change_in_a_called_file_is_compiled_anew(tmp_path: Path) -> None:
    package = tmp_path / "yards"
    package.mkdir()
    texts = {"__init__": "", "caller": CALLER, "called": CALLED, "constants": "STEP = 1.0\nOTHER = 1.0\n"}

    def answer(module: str, old: str, new: str) -> str:
        texts[module] = texts[module].replace(old, new)
        for name, text in texts.items():
            (package / f"{name}.py").write_text(text, encoding="utf-8")
        run = [sys.executable, "-B", "-m", "yards.caller"]
        homes = {"PYTHONPATH": str(SOURCE), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        ran = subprocess.run(
            run, cwd=tmp_path, env={**os.environ, **homes}, capture_output=True, text=True, check=True
        )
        return ran.stdout.strip()

    assert answer("caller", "", "") == "102.0 0"
    assert answer("constants", "OTHER = 1", "OTHER = 2") == "102.0 1"
    assert answer("constants", "STEP = 1", "STEP = 2") == "103.0 0"
    assert answer("called", "value + STEP", "value - STEP") == "99.0 0"
    assert answer("called", "first: float\n    second", "second: float\n    first") == "199.0 0"
    texts["caller"] = texts["caller"].replace("Rule", "Law")
    assert answer("called", "Rule", "Law") == "199.0 0"
    assert answer("called", "", "") == "199.0 1"


@kernel()
def doubled(value: float) -> float:
    return 2 * value


def test_code_of_another_signature_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes that begin with an empty cache may both write to its first file."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    whole, broken = (types.int64,), (types.float64,)
    written = kernel()(doubled.py_func)  # type: ignore[attr-defined]
    for one in (whole, broken):
        written.compile(one)
    first, second = sorted(tmp_path.rglob("*.nbc"))
    second.write_bytes(first.read_bytes())
    found = [written._cache.load_overload(one, written.targetctx) for one in (whole, broken)]
    assert [one is not None for one in found] == [True, False]
    again = kernel()(doubled.py_func)  # type: ignore[attr-defined]
    assert (again(3), again(1.5)) == (6, 3.0)
    assert set(again.overloads) == {whole, broken}


@kernel()
def four_times(value: float) -> float:
    return doubled(doubled(value))


def test_a_loaded_kernel_is_compiled_into_a_new_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel()(doubled.py_func).compile((types.float64,))  # type: ignore[attr-defined]
    loaded = kernel()(doubled.py_func)  # type: ignore[attr-defined]
    loaded.compile((types.float64,))
    assert loaded.stats.cache_hits and not loaded.stats.cache_misses
    monkeypatch.setitem(four_times.py_func.__globals__, "doubled", loaded)  # type: ignore[attr-defined]
    assert kernel()(four_times.py_func)(1.5) == 6.0  # type: ignore[attr-defined]


def fits(value: Any, kind: Any) -> bool:
    """A listed type is one of the annotation: its number, its array's element, its class and members."""
    name, rest = (value, []) if isinstance(value, str) else (value[0], value[1:])
    if kind is Any:
        return True
    if name == "literal":
        return type(rest[0]) is kind or kind is float
    if get_origin(kind) is np.ndarray:
        (element,) = get_args(get_args(kind)[1])
        return len(rest) >= 2 and name == np.dtype(element).name
    if get_origin(kind) is tuple or hasattr(kind, "_fields"):
        is_plain = not hasattr(kind, "_fields")
        members = get_args(kind) if is_plain else tuple(get_type_hints(kind).values())
        wanted = "tuple" if is_plain else f"{kind.__module__}:{kind.__qualname__}"
        return name == wanted and len(rest) == len(members) and all(map(fits, rest, members))
    return not rest and name in NUMBERS.get(kind, (np.dtype(kind).name,))


def test_the_list_names_kernels_with_all_their_arguments_as_annotated() -> None:
    """Run tools/signatures.py where this fails."""
    found = listed("simulate", "measure")
    assert len(found) > 100 and len(listed("simulate")) > 5
    for one in found:
        function = one.kernel().py_func
        hints, names = get_type_hints(function), list(inspect.signature(function).parameters)
        assert len(one.types()) == len(names), one
        assert [n for n, v in zip(names, one.arguments, strict=True) if not fits(v, hints[n])] == [], one


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        ("float64", Float64), (["float32", 2, "C"], Float64), (["float64", 1, "C"], float), ("int64", bool),
        ("float64", int), ("float64", np.float32), (["literal", 1], bool), (["literal", True], int),
        (["tuple", "int64"], tuple[int, int]), (["tuple", "int64", "float64"], tuple[int, int]),
        ([SKYLINE, FLOATS, INTS], Skyline), ([SKYLINE, FLOATS, INTS, FLOATS], Skyline),
        (["barsight.core.linalg.skyline:Renamed", FLOATS, INTS, INTS], Skyline),
    ],
)  # fmt: skip
def test_a_listed_type_of_an_earlier_annotation_is_noticed(value: Any, kind: Any) -> None:
    assert not fits(value, kind)


def test_types_are_read_as_they_were_written() -> None:
    frozen = np.zeros(2)
    frozen.flags.writeable = False
    row = Skyline(np.zeros(1), np.zeros(1, np.int64), np.zeros(1, np.int64))
    for value in (1, 1.5, True, np.float32(1), np.zeros((2, 3)).T, frozen, (1, 2), (1, (2.0, row)), row):
        kind = numba.typeof(value)
        assert Listed("", "", [signatures.written(kind)]).types() == (kind,)


def test_what_the_cache_holds_or_cannot_hold_is_not_compiled_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Listed(__name__, "doubled", ["float32"])
    doubled(1.0)
    assert one.missing() and not Listed(__name__, "doubled", ["float64"]).missing()
    monkeypatch.setattr(doubled, "_cache", numba.core.caching.NullCache())
    assert not one.missing()


def only_the_last_few(monkeypatch: pytest.MonkeyPatch) -> list[Listed]:
    """Let few kernels be missing, those that compile fastest."""
    few = listed("measure")[-3:]
    monkeypatch.setattr(Listed, "missing", lambda self: self in few)
    monkeypatch.setattr(ahead, "MIN_KERNELS", len(few))
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    return few


@pytest.mark.slow
def test_processes_compile_into_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(SOURCE))
    few = only_the_last_few(monkeypatch)
    told: list[tuple[str, int, int]] = []
    ahead.compile_ahead(lambda *one: told.append(one), "measure")
    assert told == [("compile", done, len(few)) for done in range(len(few) + 1)]
    written = {path.name.split("-")[0].split(".")[-1] for path in tmp_path.rglob("*.nbi")}
    assert {one.name for one in few} <= written


def test_an_interrupt_ends_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Kept(subprocess.Popen[bytes]):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(*arguments, **options)  # type: ignore[call-overload]
            started.append(self)

    def interrupt(stage: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    only_the_last_few(monkeypatch)
    monkeypatch.setattr(subprocess, "Popen", Kept)
    with pytest.raises(KeyboardInterrupt):
        ahead.compile_ahead(interrupt, "measure")
    assert len(started) == 2 and all(one.returncode for one in started)


@pytest.mark.slow
def test_every_listed_kernel_compiles() -> None:
    """Types of an earlier version would leave kernels to their first call (run tools/signatures.py)."""
    for one in listed("simulate", "measure"):
        one.compile()
