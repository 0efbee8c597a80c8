"""Print text safely: names and texts from other people's files can't control the terminal, and a terminal
that accepts no more lines blocks nobody.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Full, Queue
from threading import Thread

_HARMLESS = "\n\t"
_ORDERS = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
"""Unicode categories that aren't printed: control and format characters, surrogates, private use, line
breaks.
"""

_ROOM = 1000
"""Maximum number of lines waiting for the terminal; later ones are dropped."""
_LAST_S = 1.0
"""Maximum time for the terminal to take the waiting lines at the end."""


def printable(text: str) -> str:
    """Replace control characters and undecodable bytes by a question mark."""
    if text.isprintable():
        return text
    return "".join(
        "?" if sign not in _HARMLESS and unicodedata.category(sign) in _ORDERS else sign for sign in text
    )


@contextmanager
def printed_aside(tell: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Print lines from a thread of its own, so that nobody waits for a terminal or a pipe."""
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
