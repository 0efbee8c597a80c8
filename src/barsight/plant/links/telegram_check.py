"""Check the telegram server from the PLC's end: bytes and their meaning, cycle, answer, life counter."""

from __future__ import annotations

import itertools
import socket
import time
from dataclasses import dataclass, field

import numpy as np

from barsight.core.errors import Failed
from barsight.plant.links.link_check import LinkCheck
from barsight.plant.settings import TelegramSettings
from barsight.plant.telegram import IN_MAGIC, MAX_BEHIND, VERSION, fields_at, layout, pack, unpack, width_of

TOLERANCE_RATIO = 0.2
"""Largest deviation of the cycle's 1st and 99th percentile from the set cycle, as a share of it."""
FAILED, NUMBER = 4, 0x5A5A


@dataclass
class _Exchanged:
    """Telegrams exchanged during a check.

    stamps_s: arrival times. behind: number of telegrams by which each echo of the PLC's life counter was
    late. answered_s: time from the command to its answer.
    """

    sent: bytes = b""
    content: bytes = b""
    stamps_s: list[float] = field(default_factory=list)
    lives: list[int] = field(default_factory=list)
    behind: list[int] = field(default_factory=list)
    answered_s: float | None = None


def check_telegram(one: TelegramSettings, seconds: float) -> LinkCheck | Failed:
    """Exchange telegrams for `seconds` and judge them. The single command is refused, as it names no lift."""
    try:
        seen = _exchange(one, seconds)
    except OSError as error:
        return Failed("telegram-link", f"{one.host}:{one.port}: {error}")
    if isinstance(seen, Failed):
        return seen
    gaps_ms = 1e3 * np.diff(seen.stamps_s[1:])
    low, middle, high = np.percentile(gaps_ms, (1, 50, 99))
    set_ms = 1e3 * one.cycle_s
    is_even = (1 - TOLERANCE_RATIO) * set_ms <= low and high <= (1 + TOLERANCE_RATIO) * set_ms
    is_alive = {(later - before) & 0xFFFF for before, later in itertools.pairwise(seen.lives)} == {1}
    late = max(seen.behind)
    answer = "NOT ANSWERED" if seen.answered_s is None else f"refused after {1e3 * seen.answered_s:.0f} ms"
    lines = (
        *told_fields("in", seen.sent, one.byte_order), *told_fields("out", seen.content, one.byte_order),
        f"cycle of {len(gaps_ms) + 2} telegrams: {low:.1f}, {middle:.1f}, {high:.1f} ms (1, 50, 99 %), "
        f"longest {gaps_ms.max():.1f} ms, set {set_ms:g} ms: {'even' if is_even else 'NOT within 20 %'}",
        f"a command that names no lift: {answer}",
        "life counter: " + ("goes up by one in each telegram" if is_alive else "STANDS OR LEAPS"),
        f"echo of the PLC's life counter: {late} telegrams behind at most"
        + ("" if late <= MAX_BEHIND else f", MORE THAN {MAX_BEHIND}"),
    )  # fmt: skip
    is_in_time = float(gaps_ms.max()) < 1e3 * one.silent_s
    checks = (is_alive, is_even, is_in_time, late <= MAX_BEHIND, seen.answered_s is not None)
    return LinkCheck("telegram", lines, all(checks))


def _exchange(settings: TelegramSettings, seconds: float) -> _Exchanged | Failed:
    seen, size = _Exchanged(), layout("out").size
    asked_s: float | None = None
    with socket.create_connection((settings.host, settings.port), timeout=2) as link:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s or len(seen.lives) < 12:
            values = {
                "magic": IN_MAGIC, "version": VERSION, "life": (len(seen.lives) + 1) & 0xFFFF,
                "clock_ns": time.time_ns(),
            }  # fmt: skip
            if len(seen.lives) >= 5 and seen.answered_s is None:
                values |= {"command": FAILED, "command_number": NUMBER}
                asked_s = asked_s or time.monotonic()
            seen.sent = pack("in", values, settings.byte_order)
            link.sendall(seen.sent)
            seen.content = link.recv(size, socket.MSG_WAITALL)
            seen.stamps_s.append(time.monotonic())
            found = unpack("out", seen.content, settings.byte_order)
            if isinstance(found, Failed):
                return found
            seen.lives.append(found["life"])
            if len(seen.lives) > MAX_BEHIND:
                seen.behind.append((len(seen.lives) - found["life_echo"]) & 0xFFFF)
            if asked_s is not None and seen.answered_s is None and found["answer_number"] == NUMBER:
                seen.answered_s = time.monotonic() - asked_s
    return seen


def told_fields(side: str, content: bytes, byte_order: str) -> list[str]:
    """List a telegram's fields with offset, bytes, value and meaning; only the length of an invalid one."""
    found, head = unpack(side, content, byte_order), f"{side}: {len(content)} bytes"
    if isinstance(found, Failed):
        return [head]
    return [
        head,
        *(
            f"{at:4} {content[at : at + width_of(kind)].hex():16} {name:15} {found[name]}  ({meaning})"
            for at, name, kind, meaning in fields_at(side)
        ),
    ]
