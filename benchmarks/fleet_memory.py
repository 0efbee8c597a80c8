"""Drive thousands of tasks that do nothing, and print the memory of driver, scheduler and workers as they go.

    python benchmarks/fleet_memory.py [--tasks 10000] [--workers 2]

Each task claims its key and publishes an empty result, so that all but the measurement is as in a fleet's
run. The scheduler runs in a process of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.fleet.cluster import connect
from barsight.fleet.driver import count_states, drive
from barsight.fleet.ledger import HeldRecording, claim, publish
from barsight.fleet.objects import open_objects
from barsight.fleet.records import note_plan
from barsight.fleet.task import TaskSettings
from barsight.fleet.versions import FleetTask, Version
from barsight.fleet.window import RunWindow
from barsight.store.opening import open_store
from fleet_rounds import dask_commands
from opcua_servers import free_port

CONTENT = {"measured_s": 0.0, "whole_s": 0.0, "fetched_s": 0.0, "peak_bytes": 0, "files": {}}
MIB = 1 << 20


def do_nothing(task: FleetTask, settings: Any) -> str:
    """Claim a key and publish an empty result."""
    results = open_objects(settings.results)
    mine = claim(results, task.key, settings.limits.lease_s)
    assert isinstance(mine, HeldRecording)
    publish(results, mine, CONTENT | {"recording": task.name, "version": task.version.name})
    return task.key


def main() -> None:
    """Plan, drive and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    version = Version("nothing", "", "", "", "")
    tasks = [FleetTask(f"{k:064x}", f"r{k:05d}", (".",), version, "", "nowhere") for k in range(given.tasks)]
    port = free_port()
    processes = {
        name: subprocess.Popen(command, stderr=subprocess.DEVNULL)
        for name, command in dask_commands(port, given.workers).items()
    }
    watched = {"driver": psutil.Process()}
    watched |= {name: psutil.Process(one.pid) for name, one in processes.items()}
    started, told = time.monotonic(), -1

    def advance(done: int, total: int) -> None:
        nonlocal told
        if done * 10 // total > told:
            told = done * 10 // total
            sizes = ", ".join(f"{name} {one.memory_info().rss / MIB:.0f}" for name, one in watched.items())
            print(f"{done:6d} of {total}, {time.monotonic() - started:6.1f} s, MiB: {sizes}", flush=True)

    try:
        with (
            tempfile.TemporaryDirectory() as place,
            open_store(f"sqlite:///{place}/s.db", create=True) as store,
        ):
            results = open_objects(f"{place}/results", create=True)
            note_plan(store, tasks, "bench")
            with connect(0, f"tcp://127.0.0.1:{port}") as client:
                client.wait_for_workers(given.workers)
                drive(
                    client,
                    tasks,
                    TaskSettings(results.url, None),
                    store,
                    results,
                    RunWindow(),
                    advance,
                    do_nothing,
                )
            print(count_states(results, tasks))
    finally:
        for process in processes.values():
            process.kill()


if __name__ == "__main__":
    main()
