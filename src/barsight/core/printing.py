"""Print text: names and texts from files that others made can't give a terminal orders, and a terminal that
takes no more lines holds nobody up.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Full, Queue
from threading import Thread

_HARMLESS = "\n\t"
_ORDERS = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
"""Unicode's categories of control and format characters, surrogates, private ones and line breaks."""

_ROOM = 1000
"""Lines that may wait for a terminal; later ones are dropped."""
_LAST_S = 1.0
"""The terminal may take so long for the lines that wait at the end."""


def printable(text: str) -> str:
    """Replace control characters, and bytes of names that are no text, by a question mark."""
    if text.isprintable():
        return text
    return "".join(
        "?" if sign not in _HARMLESS and unicodedata.category(sign) in _ORDERS else sign for sign in text
    )


@contextmanager
def printed_aside(tell: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Print lines from a thread of their own: whoever tells one doesn't wait for a terminal or a pipe."""
    lines: Queue[str | None] = Queue(_ROOM)

    def work() -> None:
        while (line := lines.get()) is not None:
            with suppress(OSError):
                tell(line)

    def put(line: str | None) -> None:
        with suppress(Full):
            lines.put_nowait(line)

    thread = Thread(target=work, daemon=True)
    thread.start()
    try:
        yield put
    finally:
        put(None)
        thread.join(_LAST_S)
