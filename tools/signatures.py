"""Write the list of kernels that are compiled ahead: `python tools/signatures.py`.

Runs the demo in a folder of its own, with an empty cache, and lists the kernels that it called, those first
that took longest to compile with all that they call.
"""

from __future__ import annotations

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

from numba.core import event  # noqa: E402
from numba.core.dispatcher import Dispatcher  # noqa: E402

from barsight.core.compiling import ahead, signatures  # noqa: E402


class Durations(event.Listener):  # type: ignore[misc]
    """Seconds that each kernel took to compile, with the kernels that it calls."""

    def __init__(self) -> None:
        self.seconds: dict[tuple[Any, Any], float] = {}
        self._begun: list[float] = []

    def on_start(self, event: Any) -> None:
        """Note when."""
        self._begun.append(time.perf_counter())

    def on_end(self, event: Any) -> None:
        """Note how long."""
        key = (event.data["dispatcher"].py_func, event.data["args"])
        self.seconds[key] = time.perf_counter() - self._begun.pop()


def compiled() -> Iterator[tuple[str, str, Any, tuple[Any, ...]]]:
    """Module, name, function and types of all kernels of the package that were compiled so far."""
    for module, loaded in sorted(sys.modules.items()):
        for name, value in vars(loaded).items() if module.startswith("barsight.") else ():
            kernel = getattr(value, "__wrapped__", value) if not isinstance(value, Dispatcher) else value
            if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == module:
                for one in kernel.signatures:
                    yield module, name, kernel.py_func, one


def main() -> None:
    """Run the demo and write the list."""
    from barsight.cli import demo

    durations = Durations()
    event.register("numba:compile", durations)
    ahead.MOST_PROCESSES = 1
    with tempfile.TemporaryDirectory() as folder:
        demo.run(["--out", f"{folder}/demo"])
    groups: dict[str, list[tuple[float, list[Any]]]] = {"simulate": [], "measure": []}
    for module, name, function, arguments in compiled():
        group = "simulate" if module.startswith("barsight.simulation.") else "measure"
        entry = [module, name, [signatures.written(one) for one in arguments]]
        groups[group].append((-durations.seconds.get((function, arguments), 0), entry))
    text = {
        group: [entry for _, entry in sorted(found, key=lambda one: one[0])]
        for group, found in groups.items()
    }
    lines = ",\n".join(
        f'"{group}": [\n' + ",\n".join(map(json.dumps, entries)) + "\n]" for group, entries in text.items()
    )
    Path(signatures.__file__).with_suffix(".json").write_text("{" + lines + "}\n", encoding="utf-8")
    for group, found in groups.items():
        for seconds, entry in sorted(found, key=lambda one: one[0]):
            sys.stdout.write(f"{-seconds:7.2f} s {group} {entry[0]}.{entry[1]}\n")


if __name__ == "__main__":
    main()
