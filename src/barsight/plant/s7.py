"""Exchange bytes with a Siemens PLC by S7 PUT and GET: read the crane's inputs, write state and next lift.

The bytes are those of the cyclic telegram, in the same layout. Here Barsight is the active side: the PLC
only needs data blocks without optimised access, and PUT/GET allowed. S7 PUT/GET has no authentication:
keep it on a separate network. A write longer than one S7 telegram isn't consistent in the PLC at every
moment, so the PLC accepts a lift only if its checksum matches.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from barsight.core.errors import Failed
from barsight.core.extras import extra
from barsight.plant.link_settings import S7Settings

with extra("s7"):
    import snap7
    from snap7.error import S7Error


@dataclass(frozen=True)
class S7Exchange:
    """One exchange. inputs: bytes read. read_s, write_s: durations of reading and writing."""

    inputs: bytes
    read_s: float
    write_s: float


class S7Link:
    """A connection to a PLC, re-established when it is lost."""

    def __init__(self, settings: S7Settings, input_bytes: int) -> None:
        self._settings = settings
        self._input_bytes = input_bytes
        self._client: snap7.Client | None = None

    def read(self) -> S7Exchange | Failed:
        """Read the inputs; return Failed if the PLC can't be reached."""
        return self.exchange(None)

    def exchange(self, outputs: Callable[[], bytes] | None) -> S7Exchange | Failed:
        """Read the inputs, then write the outputs, if any, as they are at that moment.

        Returns Failed if the PLC can't be reached; an error raised by `outputs` passes through.
        """
        one, write_s = self._settings, 0.0
        what = f"{self._input_bytes} bytes from {one.read_start} on of data block {one.read_db} can't be read"
        read = self._tried(
            what, lambda client: client.db_read(one.read_db, one.read_start, self._input_bytes)
        )
        if isinstance(read, Failed):
            return read
        if outputs is not None:
            content = bytearray(outputs())
            size, start = len(content), one.write_start
            what = f"{size} bytes from {start} on of data block {one.write_db} can't be written"
            written = self._tried(
                what, lambda client: client.db_write(one.write_db, one.write_start, content)
            )
            if isinstance(written, Failed):
                return written
            write_s = written[1]
        inputs = bytes(read[0])
        if len(inputs) != self._input_bytes:
            return Failed("s7-short", f"the PLC gave {len(inputs)} bytes of {self._input_bytes}")
        return S7Exchange(inputs, read[1], write_s)

    def _tried(self, what: str, act: Callable[[snap7.Client], Any]) -> tuple[Any, float] | Failed:
        """Ask the PLC for something; return the answer and the time that it took. what: said if it fails."""
        settings, doing = self._settings, "no connection"
        try:
            client, doing = self._connected(), what
            began_s = time.monotonic()
            return act(client), time.monotonic() - began_s
        except (S7Error, RuntimeError, OSError, ValueError) as error:
            self.close()
            reason = f"the PLC at {settings.host}:{settings.port}: {doing}: {error}"
            return Failed("s7-exchange", " ".join(reason.split()))

    def close(self) -> None:
        """Close the connection, if there is one."""
        client, self._client = self._client, None
        if client is not None:
            try:
                client.disconnect()
            except (S7Error, RuntimeError, OSError):
                return

    def _connected(self) -> snap7.Client:
        if self._client is None:
            client = snap7.Client()
            client.connect(self._settings.host, self._settings.rack, self._settings.slot, self._settings.port)
            self._client = client
        return self._client


def run_s7(
    settings: S7Settings, input_bytes: int, outputs: Callable[[], bytes],
    take: Callable[[S7Exchange | Failed], None], stop: threading.Event,
) -> None:  # fmt: skip
    """Exchange in each cycle until `stop` is set.

    outputs: returns the bytes to write; called right before writing, as connecting and reading may take
    seconds. take: called with each exchange, and with each failure.
    """
    link = S7Link(settings, input_bytes)
    wait_s = settings.cycle_s
    due = time.monotonic()
    try:
        while not stop.is_set():
            exchanged = link.exchange(outputs)
            take(exchanged)
            failed = isinstance(exchanged, Failed)
            wait_s = min(2 * wait_s, settings.max_retry_s) if failed else settings.cycle_s
            due = max(due + wait_s, time.monotonic()) if not failed else time.monotonic() + wait_s
            stop.wait(max(0.0, due - time.monotonic()))
    finally:
        link.close()
