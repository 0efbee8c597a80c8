"""Machine code on disk: it follows every source that it was compiled from, and is compiled ahead."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import typeof, types

import barsight
from barsight.core.compiling import ahead, signatures
from barsight.core.compiling.cache import KernelCache

SOURCE = Path(barsight.__file__).parents[1]
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
