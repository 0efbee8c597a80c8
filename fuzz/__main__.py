"""Attack for so many minutes or inputs and print a table of what was found."""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

import cv2

from barsight.cli.main import COMMANDS, home
from barsight.core.compiling.ahead import load_kernels
from fuzz.judging import Verdict, judge
from fuzz.mutators import MARK, SECRET, mutate, reseal_folder
from fuzz.seeds import make_seeds
from fuzz.targets import TARGETS, Target

Runs = dict[str, list[Verdict]]
"""Verdicts by target."""
Finding = tuple[int, str, str, Verdict]
"""Number of the input, target, what was damaged, verdict."""


def main() -> int:
    """Parse, attack, print; 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--inputs", type=int, default=10**9, help="stop after so many")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--first", type=int, default=0, help="number of the first input, to repeat a finding")
    parser.add_argument("--seeds", type=Path, help="folder that keeps the whole files between runs")
    parser.add_argument("--only", default="", help="targets whose names hold this")
    parser.add_argument("--show", action="store_true", help="print each finding with its last lines")
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background job ignores the first
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as place:
        chosen = [target for target in TARGETS if given.only in target.name]
        seeds = prepared(given.seeds or Path(place) / "seeds", Path(place), chosen)
        runs: Runs = defaultdict(list)
        found: list[Finding] = []
        with contextlib.suppress(KeyboardInterrupt):  # what was found till then is told
            attack(chosen, seeds, Path(place), given, runs, found)
    print(table(runs, found, given.seed))
    return 1 if found else 0


def prepared(seeds: Path, place: Path, targets: Iterable[Target]) -> Path:
    """Make the seeds where they aren't yet, and load here once what every fork for these targets needs;
    return the seeds.
    """
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # as a command does before it loads it
    for name in COMMANDS:
        importlib.import_module(home(name))
    if not seeds.exists():
        make_seeds_apart(seeds)
    if SECRET.is_symlink() or not SECRET.is_file() or SECRET.read_bytes() != MARK:
        SECRET.unlink(missing_ok=True)
        with SECRET.open("xb") as file:
            file.write(MARK)
    load_kernels("simulate", "measure")
    with Path(os.devnull).open("w") as nothing, contextlib.redirect_stdout(nothing):
        for target in targets:
            if target.warm:
                with contextlib.redirect_stderr(nothing):
                    target.call(copied(target, seeds, place / "scratch"))
    if len(list(Path("/proc/self/task").iterdir())) > 1:
        raise SystemExit("a command left a thread behind, which a fork would lose")
    gc.collect()
    gc.freeze()  # a collection in a fork would copy all pages
    return seeds


def make_seeds_apart(seeds: Path) -> None:
    """Make the seeds in a process of its own: this one forks, so it must not start threads."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            make_seeds(seeds)
            code = 0
        finally:
            os._exit(code)
    if os.waitpid(pid, 0)[1]:
        raise SystemExit("the seeds could not be made")


def copied(target: Target, seeds: Path, scratch: Path) -> Path:
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    target.copy(seeds, scratch)
    return scratch


def attack(
    targets: list[Target], seeds: Path, place: Path, given: argparse.Namespace, runs: Runs,
    found: list[Finding],
) -> None:  # fmt: skip
    """Run inputs until time or count is up, and add verdicts to `runs` and findings to `found`.

    Input k of a seed is the same whatever ran before it.
    """
    end = time.monotonic() + 60 * given.minutes
    number = given.first
    while number < given.first + given.inputs and time.monotonic() < end:
        draw = random.Random(f"{given.seed}:{number}")
        target = draw.choices(targets, [each.weight for each in targets])[0]
        how, verdict = one(target, seeds, place / "scratch", draw)
        runs[target.name].append(verdict)
        if verdict.fault:
            found.append((number, target.name, how, verdict))
            if given.show:
                tail = "\n    ".join(verdict.text.strip().splitlines()[-6:])
                print(f"{number} {target.name}: {verdict.fault} ({how})\n    {tail}", flush=True)
        number += 1
        if given.show and number % 1000 == 0:
            print(f"{number - given.first} inputs, {len(found)} findings", flush=True)


def one(target: Target, seeds: Path, scratch: Path, draw: random.Random) -> tuple[str, Verdict]:
    """Copy, damage, run and judge."""
    copied(target, seeds, scratch)
    files = target.files(scratch)
    # Folders of many pictures must not take all the turns.
    by_folder = defaultdict(list)
    for path in files:
        by_folder[path.parent, path.suffix].append(path)
    how = []
    for _ in range(draw.choice((1, 1, 1, 2))):
        path = draw.choice(by_folder[draw.choice(sorted(by_folder))])
        how.append(mutate(path, draw))
    if (scratch / "out").is_dir() and draw.random() < 0.7:
        reseal_folder(scratch / "out")
    outputs = tuple(scratch / name for name in target.outputs)
    return "; ".join(how), judge(lambda: target.call(scratch), scratch, outputs)


def table(runs: Runs, found: list[Finding], seed: int) -> str:
    """Format counts by target."""
    kinds = Counter((name, verdict.fault.partition(":")[0]) for _, name, _, verdict in found)
    lines = ["| target | inputs | findings | slowest s | exit codes |", "|---|---:|---|---:|---|"]
    for name in sorted(runs):
        told = ", ".join(f"{count} {kind}" for (of, kind), count in sorted(kinds.items()) if of == name)
        codes = Counter(verdict.code for verdict in runs[name])
        ends = ", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))
        slowest = max(verdict.seconds for verdict in runs[name])
        lines.append(f"| {name} | {len(runs[name])} | {told or 0} | {slowest:.1f} | {ends} |")
    total = sum(map(len, runs.values()))
    return "\n".join([*lines, f"\nseed {seed}: {total} inputs, {len(found)} findings"])


if __name__ == "__main__":
    sys.exit(main())
