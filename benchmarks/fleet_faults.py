"""Measure simulated recordings by `barsight fleet` while workers, driver, scheduler and S3 server fail.

    python benchmarks/fleet_faults.py FOLDER [--recordings 60] [--seed 7] [--workers 3]

Each recording is drawn and measured once by `barsight measure` (kept in FOLDER), then all by a scheduler,
workers without nannies and moto's S3 server, with kills at random moments drawn from the seed. What counts
is read from the server and the store: each key published once, each file that tells no time equal to the
local one. Ends with exit code 1 where it isn't so.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.fleet.ledger import parked_keys, published_keys
from barsight.fleet.objects import Objects, open_objects
from fleet_rounds import BARSIGHT, SMALL, call, dask_commands, moto_server
from opcua_servers import free_port

TIMED = {"result.json", "report.html"}
"""Files that hold times of the clock; all others must be the same to the byte."""
WORKER_KILLS, STOPPED_S, LEASE_S = 10, 30.0, 20.0
SILENT_S = 600.0
LAST = 6
"""Recordings before whose publication all faults are due."""


def draw(folder: Path, count: int) -> None:
    """Draw the archive and measure it locally, unless that is done."""
    (folder / "config.toml").write_text('preset = "fast"\n')
    for number in range(1, count + 1):
        recording, out = folder / "archive" / f"r{number:02d}", folder / "local" / f"r{number:02d}"
        if not recording.exists():
            call(folder, "simulate", recording, "--seed", number, *SMALL)
        if not out.exists():
            call(folder, "measure", recording, "-o", out, "--config", "config.toml", "--at", "end")


@dataclass
class Cluster:
    """Scheduler, workers and driver as processes of their own. deaths: what was killed, in order."""

    folder: Path
    port: int
    workers: int
    store: str
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    deaths: list[str] = field(default_factory=list)
    driver_starts: int = 0

    def keep_up(self) -> None:
        """Start whatever does not run; the driver unless it ended well."""
        for name, command in dask_commands(self.port, self.workers).items():
            self._start(name, command)
        drive = ["fleet", "run", "--results", "s3://yard/results", "--store", self.store, "--threads", "1"]
        drive += ["--scheduler", f"tcp://127.0.0.1:{self.port}", "--lease-s", str(LEASE_S)]
        if self._start("driver", [*BARSIGHT, *drive]):
            self.driver_starts += 1

    def _start(self, name: str, command: list[str]) -> bool:
        running = self.processes.get(name)
        ended_well = running is not None and name == "driver" and running.poll() == 0
        if ended_well or (running is not None and running.poll() is None):
            return False
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)
        return True

    def kill(self, name: str) -> None:
        """Kill a process as a machine that loses its power does."""
        self.processes[name].kill()
        self.processes[name].wait()
        self.deaths.append(name)

    @property
    def is_done(self) -> bool:
        """Tell whether the driver ended well."""
        return self.processes["driver"].poll() == 0

    def end(self) -> None:
        """End all processes."""
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()


def run_with_faults(
    cluster: Cluster, server: subprocess.Popen[bytes], results: Objects, seed: int, count: int
) -> dict[str, str]:
    """Drive to the end, with faults spread over the run by how much is published; the token that each key
    had when it was first seen.
    """
    chance = random.Random(seed)
    names = [f"worker {chance.randrange(cluster.workers)}" for _ in range(WORKER_KILLS)]
    names += ["driver", "scheduler", "server"]
    chance.shuffle(names)
    due = sorted(chance.uniform(0, count - LAST) for _ in names)  # published keys
    faults = list(zip(due, names, strict=True))
    seen: dict[str, str] = {}
    at = changed = time.monotonic()
    while True:
        cluster.keep_up()
        time.sleep(1.0)
        for key in published_keys(results) - seen.keys():
            seen[key] = token(results, key)
            changed = time.monotonic()
        if cluster.is_done:
            return seen
        if time.monotonic() - changed > SILENT_S:
            raise SystemExit(f"nothing was published for {SILENT_S:.0f} s; {len(seen)} were")
        if faults and len(seen) >= faults[0][0] and time.monotonic() >= at:
            _, fault = faults.pop(0)
            if fault == "server":
                server.send_signal(signal.SIGSTOP)
                time.sleep(STOPPED_S)
                server.send_signal(signal.SIGCONT)
                cluster.deaths.append(f"server for {STOPPED_S:.0f} s")
            else:
                cluster.kill(fault)
            print(f"{len(seen):3d} published: {cluster.deaths[-1]} failed", flush=True)
            at = time.monotonic() + chance.uniform(5, 25)


def token(results: Objects, key: str) -> str:
    """Read the token of the try that a key was published by."""
    return str(results.read_json(f"results/{key}/result.json")["token"])


def differing(results: Objects, folder: Path) -> list[str]:
    """List what a published result and the local one don't share, but for files that tell times."""
    told = []
    for key in sorted(published_keys(results)):
        note = results.read_json(f"results/{key}/result.json")
        local = folder / "local" / note["recording"]
        files = {name: file["sha256"] for name, file in note["files"].items() if name not in TIMED}
        own = {p.name: digest(p.read_bytes()) for p in local.iterdir() if p.name not in TIMED}
        for name in sorted(files.keys() | own.keys()):
            stored = results.read(f"files/{key}/{note['token']}/{name}")
            if stored is None or not digest(stored) == files.get(name) == own.get(name):
                told.append(f"{note['recording']}/{name}")
    return told


def digest(data: bytes) -> str:
    """Compute SHA-256."""
    return hashlib.sha256(data).hexdigest()


def verdict(folder: Path, store: Path, results: Objects, seen: dict[str, str], count: int) -> list[str]:
    """List all that is not as it must be, read from server and store."""
    with contextlib.closing(sqlite3.connect(store)) as opened:
        rows = [row[0] for row in opened.execute("select key from fleet_results")]
    keys, parked = published_keys(results), parked_keys(results)
    checks: list[tuple[Callable[[], bool], str]] = [
        (lambda: len(keys) == count, f"{len(keys)} of {count} keys are published"),
        (lambda: not parked, f"{len(parked)} are parked"),
        (lambda: sorted(rows) == sorted(keys), f"the store has {len(rows)} rows of {len(set(rows))} keys"),
        (lambda: all(token(results, k) == t for k, t in seen.items()), "a key was published twice"),
    ]
    told = [text for is_right, text in checks if not is_right()]
    return told + [f"differs from the local measurement: {one}" for one in differing(results, folder)]


def main() -> None:
    """Draw, run, check, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=int, default=60)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--workers", type=int, default=3)
    given = parser.parse_args()
    folder = given.folder.absolute()
    (folder / "archive").mkdir(parents=True, exist_ok=True)
    draw(folder, given.recordings)
    os.environ |= {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "y", "AWS_REGION": "us-east-1"}
    store = folder / f"run{given.seed}-{int(time.time())}.db"
    url = f"sqlite:///{store}"
    with moto_server() as (endpoint, server):
        os.environ["AWS_ENDPOINT_URL"] = endpoint
        results = open_objects("s3://yard/results", create=True)
        words = ("fleet", "plan", "archive", "--results", results.url, "--store", url)
        print(call(folder, *words, "--config", "config.toml"), flush=True)
        cluster = Cluster(folder, free_port(), given.workers, url)
        started = time.monotonic()
        try:
            seen = run_with_faults(cluster, server, results, given.seed, given.recordings)
        finally:
            cluster.end()
        took = time.monotonic() - started
        claims = sum(1 for _ in results.list("claims/"))
        told = verdict(folder, store, results, seen, given.recordings)
    if len(cluster.deaths) < WORKER_KILLS + 3:
        told.append(f"the run ended after {len(cluster.deaths)} faults")
    print(json.dumps({
        "recordings": given.recordings, "seed": given.seed, "faults": cluster.deaths,
        "driver starts": cluster.driver_starts, "claims": claims, "seconds": round(took), "wrong": told,
    }, indent=1))  # fmt: skip
    raise SystemExit(1 if told else 0)


if __name__ == "__main__":
    main()
