"""Let the disk fill at random byte counts, and kill at random moments: `python -m fuzz.faults --turns 20`.

A full disk is a limit on a file's size, under which the system refuses to write as it does without space.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from fuzz.__main__ import import_commands, make_seeds_apart
from fuzz.judging import judge
from fuzz.targets import Target, run_words

FULL, KILLED = "full disk", "killed"
WRITERS = (
    *(
        Target(
            f"convert {to}", ("euroc",), (),
            run_words("convert", "FOLDER/euroc", "-o", "FOLDER/made", "--to", to), ("made",),
        ) for to in ("euroc", "ros1", "ros2-mcap", "ros2-sqlite3")
    ),
    *(
        Target(
            f"export {kind}", ("out",), (), run_words("export", "FOLDER/out", f"FOLDER/made.{kind}"),
            (f"made.{kind}",),
        ) for kind in ("ply", "pcd", "las", "laz", "e57", "csv", "tif")
    ),
    Target("report", ("out",), (), run_words("report", "FOLDER/out"), ("out",)),
    Target(
        "lifts", ("out", "magnet.toml"), (),
        run_words("lifts", "FOLDER/out", "--magnet", "FOLDER/magnet.toml", "--at", "end"), ("out",),
    ),
    Target(
        "calibrate yard", ("targets.csv",), (),
        run_words("calibrate", "yard", "FOLDER/targets.csv", "-o", "FOLDER/made.yaml"),
        ("made.yaml", "made.html", "made.json"),
    ),
    Target(
        "calibrate export", ("rig.yaml",), (),
        run_words("calibrate", "export", "FOLDER/rig.yaml", "-o", "FOLDER/made.yaml", "--to", "opencv"),
        ("made.yaml",),
    ),
)  # fmt: skip


def limited(call: Callable[[], int], most: int) -> int:
    """Call under a limit on a file's bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    return call()


def full_disk(target: Target, scratch: Path, draw: random.Random) -> str:
    """Run under a drawn limit; what it did that it must not."""
    most = int(10 ** draw.uniform(2.0, 6.5))
    outputs = tuple(scratch / name for name in target.outputs)
    verdict = judge(lambda: limited(lambda: target.call(scratch), most), scratch, outputs)
    if not verdict.fault and verdict.code not in (0, 4):
        return f"exit code {verdict.code} at {most} bytes: {verdict.text.strip()[-200:]}"
    return f"{verdict.fault} at {most} bytes: {verdict.text.strip()[-200:]}" if verdict.fault else ""


def killed(target: Target, scratch: Path, draw: random.Random) -> str:
    """Kill a run at a drawn moment, run again; what is left that must not be."""
    pid = os.fork()
    if pid == 0:
        with open(os.devnull, "w") as nothing:  # noqa: PTH123
            sys.stdout = sys.stderr = nothing
            target.call(scratch)
        os._exit(0)
    time.sleep(draw.uniform(0.0, 1.5))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    for name in target.outputs:  # one that appeared is whole; a folder that is there can't be written again
        if name == "made":
            shutil.rmtree(scratch / name, ignore_errors=True)
    verdict = judge(lambda: target.call(scratch), scratch)
    return verdict.fault or (
        f"exit code {verdict.code}: {verdict.text.strip()[-200:]}" if verdict.code else ""
    )


def main() -> int:
    """Parse, inject, print a table; 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.faults", description=__doc__)
    parser.add_argument("--turns", type=int, default=5, help="for each writer and fault")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--seeds", type=Path)
    given = parser.parse_args()
    import_commands()
    found: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as place:
        seeds = given.seeds or Path(place) / "seeds"
        if not seeds.exists():
            make_seeds_apart(seeds)
        for turn in range(given.turns):
            for target in WRITERS:
                for fault, inject in ((FULL, full_disk), (KILLED, killed)):
                    scratch = Path(place) / "scratch"
                    shutil.rmtree(scratch, ignore_errors=True)
                    scratch.mkdir()
                    target.copy(seeds, scratch)
                    wrong = inject(
                        target, scratch, random.Random(f"{given.seed}:{turn}:{target.name}:{fault}")
                    )
                    if wrong:
                        found[target.name, fault] += 1
                        print(f"{target.name}, {fault}: {wrong}", flush=True)
    total = given.turns * len(WRITERS)
    print(f"seed {given.seed}: {total} full disks and {total} kills over {len(WRITERS)} writers, "
          f"{sum(found.values())} findings")  # fmt: skip
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
