"""Check the telegram's server from the PLC's side: bytes and their meaning, cycle, life counter."""

from __future__ import annotations

import itertools
import socket
import time
from dataclasses import dataclass

from barsight.core.errors import Failed
from barsight.plant.settings import TelegramSettings
from barsight.plant.telegram import IN_MAGIC, VERSION, layout, pack, table_of, unpack

CYCLES = 20


@dataclass(frozen=True)
class TelegramCheck:
    """Record what a check saw. lines: for people. is_good: whether cycle and life counter hold."""

    lines: tuple[str, ...]
    is_good: bool


def check_telegram(one: TelegramSettings) -> TelegramCheck | Failed:
    """Exchange telegrams without a command, and judge them; nothing is claimed."""
    size, stamps, lives = layout("out").size, [], []
    content = sent = b""
    try:
        with socket.create_connection((one.host, one.port), timeout=2) as link:
            for number in range(CYCLES):
                values = {
                    "magic": IN_MAGIC, "version": VERSION, "life": number, "clock_ns": time.time_ns()
                }  # fmt: skip
                sent = pack("in", values, one.byte_order)
                link.sendall(sent)
                content = link.recv(size, socket.MSG_WAITALL)
                stamps.append(time.monotonic())
                found = unpack("out", content, one.byte_order)
                if isinstance(found, Failed):
                    return found
                lives.append(found["life"])
    except OSError as error:
        return Failed("telegram-link", f"{one.host}:{one.port}: {error}")
    gaps_s = [later - before for before, later in itertools.pairwise(stamps[1:])]
    counts = [(later - before) & 0xFFFF for before, later in itertools.pairwise(lives)]
    is_alive = all(0 < each < 1000 for each in counts)
    cycle = f"cycle {min(gaps_s) * 1e3:.1f}...{max(gaps_s) * 1e3:.1f} ms, set {one.cycle_s * 1e3:g} ms"
    lines = [*told_fields("in", sent, one.byte_order), *told_fields("out", content, one.byte_order), cycle]
    lines.append("life counter: " + ("goes up in each telegram" if is_alive else "stands still"))
    return TelegramCheck(tuple(lines), is_alive and max(gaps_s) < one.silent_s)


def told_fields(side: str, content: bytes, byte_order: str) -> list[str]:
    """List the fields of a telegram with offset, bytes, value and meaning; of another its length alone."""
    found = unpack(side, content, byte_order)
    at, lines = 0, [f"{side}: {len(content)} bytes"]
    for name, kind, meaning in table_of(side) if not isinstance(found, Failed) else ():
        width = int(kind[1:]) // 8
        value = found[name] if not isinstance(found, Failed) else 0
        lines.append(f"{at:4} {content[at : at + width].hex():16} {name:15} {value}  ({meaning})")
        at += width
    return lines
