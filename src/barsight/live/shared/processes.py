"""Keep processes from outliving their parent, and signals from ending the server that starts them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing.connection import wait


def end_with_parent() -> None:
    """End this process when its parent is gone: a killed parent can't stop its processes, and cameras and
    ports would stay occupied.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def end(sentinel: int = parent.sentinel) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


@contextlib.contextmanager
def signals_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM, which a terminal sends to all processes, also for the server of processes."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
