"""Write the list of kernels that are compiled ahead: `python tools/signatures.py`.

Runs the demo in a folder of its own, with an empty cache, and lists the kernels that it called: those first
that call no others, so that no process compiles what another is about to, of these the longest first.
"""

from __future__ import annotations

import functools
import inspect
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FOLDER = tempfile.TemporaryDirectory()
os.environ["NUMBA_CACHE_DIR"] = FOLDER.name

import numpy as np  # noqa: E402
from numba.core import event  # noqa: E402
from numba.core.dispatcher import Dispatcher  # noqa: E402

from barsight.core.compiling import ahead, cache, signatures  # noqa: E402


class Durations(event.Listener):  # type: ignore[misc]
    """Seconds that each kernel took to compile, with the kernels that it calls."""

    def __init__(self) -> None:
        self.seconds: dict[tuple[Any, Any], float] = {}
        self._begun: list[float] = []

    def on_start(self, event: Any) -> None:
        """Note when."""
        self._begun.append(time.thread_time())

    def on_end(self, event: Any) -> None:
        """Note how long."""
        key = (event.data["dispatcher"].py_func, event.data["args"])
        self.seconds[key] = time.thread_time() - self._begun.pop()


@functools.cache
def depth(function: Any) -> int:
    """Return the longest chain of kernels below one."""
    called = [inspect.unwrap(value) for _, value in cache.named(function) if callable(value)]
    return max((1 + depth(one) for one in called if inspect.isfunction(one) and one != function), default=0)


def compiled() -> Iterator[tuple[str, str, Any, tuple[Any, ...]]]:
    """Module, name, function and types of all kernels of the package that were compiled so far."""
    for module, loaded in sorted(sys.modules.items()):
        for name, value in vars(loaded).items() if module.startswith("barsight.") else ():
            kernel = getattr(value, "__wrapped__", value) if not isinstance(value, Dispatcher) else value
            if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == module:
                for one in kernel.signatures:
                    yield module, name, kernel.py_func, one


def call_others() -> None:
    """Call the kernels of lifts that are refused for what was not seen, of which the demo has none."""
    from barsight.yard.cameras import Cameras
    from barsight.yard.map_lookup import CellGrid

    flat, place = CellGrid(0.0, 0.0, 1.0, np.zeros((2, 2), np.float32), 0.0), np.ones((1, 3))
    Cameras(np.zeros((2, 3)), np.eye(3), np.zeros((2, 4))).count_views(place, flat, place, 1)


def main() -> None:
    """Run the demo and write the list."""
    from barsight.cli import demo

    durations = Durations()
    event.register("numba:compile", durations)
    ahead.MAX_PROCESSES = 1
    with tempfile.TemporaryDirectory() as folder:
        demo.run(["--out", f"{folder}/demo", "--no-serve"])
    call_others()
    groups: dict[str, list[tuple[int, float, list[Any]]]] = {"simulate": [], "measure": []}
    for module, name, function, arguments in compiled():
        group = "simulate" if module.startswith("barsight.simulation.") else "measure"
        entry = [module, name, [signatures.written(one) for one in arguments]]
        groups[group].append((depth(function), -durations.seconds[function, arguments], entry))
    for found in groups.values():
        found.sort(key=lambda one: one[:2])
    text = {group: [entry for *_, entry in found] for group, found in groups.items()}
    lines = ",\n".join(
        f'"{group}": [\n' + ",\n".join(map(json.dumps, entries)) + "\n]" for group, entries in text.items()
    )
    Path(signatures.__file__).with_suffix(".json").write_text("{" + lines + "}\n", encoding="utf-8")
    for group, found in groups.items():
        for _, seconds, entry in found:
            sys.stdout.write(f"{-seconds:7.2f} s {group} {entry[0]}.{entry[1]}\n")


if __name__ == "__main__":
    main()
