"""Let every command that writes meet a broken machine: `python -m fuzz.faults --turns 20`.

A full disk is a limit on a file's size, under which the system refuses to write as it does without space. A
killed run is judged twice: what it left, and what the next run of the same command makes of it.
"""

from __future__ import annotations

import argparse
import ctypes
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
from dataclasses import dataclass, replace
from pathlib import Path

from fuzz.__main__ import copied, prepared
from fuzz.judging import Verdict, judge
from fuzz.targets import Call, Target
from fuzz.writers import WRITERS

CLONE_NEWNS, MS_RDONLY, MS_REMOUNT, MS_BIND, MS_REC, MS_PRIVATE = 0x20000, 1, 32, 4096, 16384, 1 << 18
"""Of unshare(2) and mount(2)."""
DONE, FAILED, UNREAD, REFUSED = 0, 1, 3, 4
Content = dict[str, bytes | None]
"""Of the files under a folder by their names; None for a folder."""
IGNORED = ("stdout", "stderr")
"""Names of manifests hold when their recording was written."""


@dataclass(frozen=True)
class Whole:
    """Output of a run that nothing disturbs. content: of all files; names: that two runs share; same: of
    those that two runs write alike; seconds: by the clock.
    """

    content: Content
    names: frozenset[str]
    same: frozenset[str]
    seconds: float


def full_disk(call: Call, draw: random.Random) -> Call:
    """Refuse to let a file grow past a drawn size."""
    most = int(10 ** draw.uniform(2.8, 6.5))  # what is told on standard error fits in

    def run(scratch: Path) -> int:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        return call(scratch)

    return run


def read_only(call: Call, draw: random.Random) -> Call:
    """Take away the right to write anywhere. Root has it always and gets a read-only mount of its own."""

    def run(scratch: Path) -> int:
        if os.geteuid() == 0:
            _mount_read_only(scratch)
        else:
            for path in (scratch, *scratch.rglob("*")):
                path.chmod(0o555 if path.is_dir() else 0o444)
        return call(scratch)

    return run


def _mount_read_only(folder: Path) -> None:
    libc, name = ctypes.CDLL(None, use_errno=True), bytes(folder)
    done = [
        libc.unshare(CLONE_NEWNS),
        libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None),
        libc.mount(name, name, None, MS_BIND, None),
        libc.mount(name, name, None, MS_BIND | MS_REMOUNT | MS_RDONLY, None),
    ]
    if any(done):
        raise SystemExit("root may not mount here: run as another user")


def low_memory(call: Call, draw: random.Random) -> Call:
    """Leave a drawn number of bytes to allocate."""
    left = int(10 ** draw.uniform(6.0, 9.0))

    def run(scratch: Path) -> int:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + left
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        return call(scratch)

    return run


def stepped_clock(call: Call, draw: random.Random) -> Call:
    """Let the clock step to and fro by up to ten years at each look at it."""
    true_ns = time.time_ns

    def stepped_ns() -> int:
        return true_ns() + draw.randrange(-(10**9), 10**9) * 315_576_000

    def run(scratch: Path) -> int:
        time.time_ns, time.time = stepped_ns, lambda: stepped_ns() / 1e9
        return call(scratch)

    return run


def no_home(call: Call, draw: random.Random) -> Call:
    """Take HOME and all that stands for it away."""

    def run(scratch: Path) -> int:
        for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "PATH"):
            os.environ.pop(name, None)
        return call(scratch)

    return run


def closed_stdout(call: Call, draw: random.Random) -> Call:
    """Let nobody read the standard output: a pipe without a reader, or a disk that is full."""
    full = draw.random() < 0.5

    def run(scratch: Path) -> int:
        read, write = os.pipe()
        os.close(read)
        os.dup2(os.open("/dev/full", os.O_WRONLY) if full else write, 1)
        return call(scratch)

    return run


FAULTS: dict[str, tuple[Callable[[Call, random.Random], Call], tuple[int, ...]]] = {
    "full disk": (full_disk, (DONE, REFUSED)),
    "read-only": (read_only, (UNREAD, REFUSED)),
    "low memory": (low_memory, (DONE, FAILED, REFUSED)),
    "clock steps": (stepped_clock, (DONE,)),
    "no HOME": (no_home, (DONE,)),
    "closed stdout": (closed_stdout, (DONE, FAILED)),
}
"""The fault and the exit codes that may follow. What was printed in vain is no reason to undo the files;
a database that can't be opened is an input."""
KILLED = "killed"


def whole(target: Target, seeds: Path, scratch: Path) -> Whole:
    """Run undisturbed, twice."""
    contents = []
    for _ in range(2):
        copied(target, seeds, scratch)
        began = time.monotonic()
        verdict = judge(lambda: target.call(scratch), scratch)
        seconds = time.monotonic() - began
        if verdict.fault or verdict.code:
            raise SystemExit(
                f"{target.name} fails undisturbed: {verdict.fault} {verdict.text.strip()[-300:]}"
            )
        contents.append(content(scratch))
    first, second = contents
    names = frozenset(first.keys() & second.keys())
    return Whole(second, names, frozenset(name for name in first if first[name] == second.get(name)), seconds)


def content(scratch: Path) -> Content:
    """Read all that lies in the scratch folder."""
    return {
        str(path.relative_to(scratch)): path.read_bytes() if path.is_file() else None
        for path in scratch.rglob("*") if path.name not in IGNORED and path.parent.name != "manifests"
    }  # fmt: skip


def disturbed(target: Target, fault: str, scratch: Path, draw: random.Random, expected: Whole) -> str:
    """Run under a fault; what it did that it must not."""
    inject, codes = FAULTS[fault]
    call = inject(target.call, draw)
    outputs = () if fault == "closed stdout" else tuple(scratch / name for name in target.outputs)
    verdict = judge(lambda: call(scratch), scratch, outputs)
    silent = fault == "closed stdout" and verdict.fault == "0 lines"  # as all programs before a closed pipe
    if (verdict.fault and not silent) or verdict.code not in codes:
        return told(verdict)
    if fault == "clock steps":  # the files hold dates
        expected = replace(expected, same=frozenset())
    if verdict.code == 0 and (wrong := unlike(content(scratch), expected)):
        return f"exit code 0, but {wrong}"
    return ""


def told(verdict: Verdict) -> str:
    """Tell how a run ended."""
    return f"{verdict.fault or 'exit code'} {verdict.code}: {' '.join(verdict.text.split())[-300:]}"


def unlike(found: Content, expected: Whole) -> str:
    """Name what is there too much, lacks, or has another content than an undisturbed run writes."""
    varies = len(found.keys() - expected.names) == len(expected.content.keys() - expected.names)
    for name in sorted(expected.names - found.keys() if varies else found.keys() ^ expected.content.keys()):
        return f"{name} is {'left' if name in found else 'not there'}"
    changed = sorted(name for name in expected.same if found[name] != expected.content[name])
    return f"{changed[0]} differs" if changed else ""


def killed(target: Target, scratch: Path, draw: random.Random, expected: Whole) -> str:
    """Kill a run at a drawn moment, look, and run again; what is wrong then."""
    before = content(scratch)
    pid = os.fork()
    if pid == 0:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.chdir(scratch)
        target.call(scratch)
        os._exit(0)
    time.sleep(draw.uniform(0.0, 1.1 * expected.seconds))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    if wrong := half_made(target, before, content(scratch), expected):
        return f"half result: {wrong}"
    for path in scratch.glob("made*"):  # a folder that is there can't be written again, nor a survey recorded
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    verdict = judge(lambda: target.call(scratch), scratch)
    if verdict.fault or verdict.code:
        return f"the next run: {told(verdict)}"
    wrong = unlike(content(scratch), expected)
    return f"after the next run {wrong}" if wrong else ""


def half_made(target: Target, before: Content, after: Content, expected: Whole) -> str:
    """Name an output that is neither as before nor as an undisturbed run writes it."""
    names = {
        name for name in after.keys() | before.keys() | expected.content.keys()
        if any(name == output or name.startswith(f"{output}/") for output in target.outputs)
    }  # fmt: skip
    if all(before.get(name, b"") == after.get(name, b"") for name in names):
        return ""
    for name in sorted(names):
        if (name in after) != (name in expected.content):
            return f"{name} is {'left' if name in after else 'not there'}"
        if name in expected.same and after[name] != expected.content[name]:
            return f"{name} differs"
    return ""


def main() -> int:
    """Parse, inject, print a table; 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.faults", description=__doc__)
    parser.add_argument("--turns", type=int, default=5, help="for each writer and fault")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--seeds", type=Path, help="folder that keeps the whole files between runs")
    parser.add_argument("--only", default="", help="writers whose names hold this")
    parser.add_argument("--faults", nargs="+", choices=(*FAULTS, KILLED), default=(*FAULTS, KILLED))
    given = parser.parse_args()
    writers = [writer for writer in WRITERS if given.only in writer.name]
    found: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as place:
        scratch = Path(place) / "scratch"
        seeds = prepared(given.seeds or Path(place) / "seeds", Path(place), writers)
        for target in writers:
            expected = whole(target, seeds, scratch)
            for fault in given.faults:
                for turn in range(given.turns):
                    copied(target, seeds, scratch)
                    draw = random.Random(f"{given.seed}:{turn}:{target.name}:{fault}")
                    wrong = (
                        killed(target, scratch, draw, expected) if fault == KILLED
                        else disturbed(target, fault, scratch, draw, expected)
                    )  # fmt: skip
                    if wrong:
                        found[target.name, fault] += 1
                        print(f"{target.name}, {fault} {turn}: {wrong}", flush=True)
            print(f"{target.name}: done", file=sys.stderr, flush=True)
    print(table(given.faults, [writer.name for writer in writers], found, given.turns))
    print(
        f"\nseed {given.seed}: {given.turns} turns of {len(given.faults)} faults over {len(writers)} "
        f"writers, {sum(found.values())} findings"
    )
    return 1 if found else 0


def table(faults: tuple[str, ...], writers: list[str], found: Counter[tuple[str, str]], turns: int) -> str:
    """Format findings by writer and fault."""
    head = [f"| writer | {' | '.join(faults)} |", f"|---|{'---:|' * len(faults)}"]
    rows = [
        f"| {writer} | {' | '.join(f'{found[writer, fault]}/{turns}' for fault in faults)} |"
        for writer in writers
    ]
    return "\n".join([*head, *rows])


if __name__ == "__main__":
    sys.exit(main())
