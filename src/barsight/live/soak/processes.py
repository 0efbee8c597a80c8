"""Read the resource usage of a run's processes from the system."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import ConfigError

PROC = Path("/proc")
SERVER = "forkserver"
HELPERS = {
    b"multiprocessing.forkserver": SERVER,
    b"multiprocessing.resource_tracker": "resource tracker",
}
"""Helper processes that the command keeps beside those of its run, by a word of their command line."""
COMMAND = "command"


@dataclass(frozen=True)
class Usage:
    """Memory (shared pages in full, and divided among their users), open descriptors and CPU time."""

    rss_mib: float
    pss_mib: float
    descriptors: int
    cpu_s: float


def read_usage(pid: int) -> Usage | None:
    """Read the usage of a process; None if it is gone. Raises ConfigError for another user's process."""
    at = PROC / str(pid)
    try:
        rollup = (at / "smaps_rollup").read_text(encoding="ascii").splitlines()
        kib = {line.split(":")[0]: int(line.split()[1]) for line in rollup[1:]}
        stat = (at / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()
        cpu_s = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
        return Usage(kib["Rss"] / 1024, kib["Pss"] / 1024, sum(1 for _ in (at / "fd").iterdir()), cpu_s)
    except PermissionError as error:
        raise ConfigError(f"process {pid} is another user's: soak as the user that runs live") from error
    except (OSError, KeyError, IndexError):
        return None


def parents() -> dict[int, int]:
    """Read the parent of each process."""
    found = {}
    for entry in PROC.iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text(encoding="utf-8", errors="replace")
            except OSError:
                continue
            found[int(entry.name)] = int(stat.rsplit(")", 1)[1].split()[1])
    return found


def command_of(pid: int) -> int | None:
    """Return the command that a run's process belongs to: the parent of the fork server that started it."""
    above = parents()
    server = above.get(pid, 0)
    if not server or b"multiprocessing.forkserver" not in _command_line(server):
        return None
    return above.get(server)


def family(command: int, roles: dict[int, str]) -> dict[int, str]:
    """List the command and all its descendants with their names; "" for those that aren't the run's.

    roles: of the run's processes.
    """
    above = parents()
    found = {command: COMMAND} if command in above else {}
    for pid in sorted(above):
        line = [pid]
        while (parent := above.get(line[-1], 0)) and parent not in line:
            line.append(parent)
        if command not in line[1:]:
            continue
        found[pid] = roles.get(pid, "")
        if line[1] == command:
            words = _command_line(pid)
            found[pid] = next((name for word, name in HELPERS.items() if word in words), "")
    return found


def _command_line(pid: int) -> bytes:
    try:
        return (PROC / str(pid) / "cmdline").read_bytes()
    except OSError:
        return b""
