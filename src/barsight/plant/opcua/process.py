"""Run the OPC UA server in a separate process, which polls the state and dies with its parent.

The server's process sends requests, and a thread here answers them, at most one at a time, so that nothing
piles up if either side stalls. A state older than `max_age_s`, or a request not answered within that time,
sets all variables Bad.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from barsight.core.errors import Failed
from barsight.plant.link_settings import MAX_AGE_S, OpcUaSettings
from barsight.plant.opcua.recipes import Recipes
from barsight.plant.opcua.server import opcua_server
from barsight.plant.opcua.surveys import Told

Handshake = Callable[[str, str, Mapping[str, Any]], "str | Failed"]
"""Callable that takes a step of the handshake: its name, the caller and the arguments; returns the token."""

BEGINNINGS = ("claim", "executing")
"""Steps that a client takes before it lifts; the others tell what it did."""


class OpcUaProcess:
    """The server's process, and the thread that answers its requests."""

    def __init__(
        self, settings: OpcUaSettings, kind: type, recipes: Recipes, handshake: Handshake,
        max_age_s: float = MAX_AGE_S,
    ) -> None:  # fmt: skip
        context = multiprocessing.get_context("spawn")
        self._here, far_end = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(settings, kind, recipes, far_end, max_age_s), daemon=True, name="opcua"
        )  # fmt: skip
        self._handshake = handshake
        self._max_age_s = max_age_s
        self._told: tuple[float, Told] | None = None
        self._is_serving = False
        self._stop = threading.Event()
        self._process.start()
        far_end.close()
        self._thread = threading.Thread(target=self._answer, name="opcua answers", daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Return True while the process runs and its thread answers."""
        return self._process.is_alive() and self._thread.is_alive()

    @property
    def is_serving(self) -> bool:
        """Return True once the server listens: its first request for data comes after that."""
        return self._is_serving

    @property
    def pid(self) -> int | None:
        """Return the process id."""
        return self._process.pid

    def show(self, told: Told) -> None:
        """Set the data that is current now."""
        self._told = (time.monotonic(), told)

    def stop(self) -> None:
        """Stop the process and the thread."""
        self._stop.set()
        self._process.terminate()
        self._process.join(5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._thread.join(5)
        self._here.close()

    def _answer(self) -> None:
        while not self._stop.is_set():
            try:
                if self._here.poll(0.1):
                    number, question, until_s = self._here.recv()
                    self._is_serving = True
                    self._here.send((number, self._answer_one(question, until_s)))
            except (EOFError, OSError):
                return

    def _answer_one(self, question: tuple[str, str, Mapping[str, Any]] | None, until_s: float) -> Any:
        """Answer a request. One that the server's process has given up begins no lift any more."""
        if question is not None:
            is_late = question[0] in BEGINNINGS and time.monotonic() > until_s
            return None if is_late else self._handshake(*question)
        known = self._told
        return known[1] if known is not None and time.monotonic() - known[0] <= self._max_age_s else None


class _AskedPlant:
    """The plant's side as the server's process sees it, through the pipe."""

    def __init__(self, connection: Connection, max_age_s: float) -> None:
        self._connection = connection
        self._max_age_s = max_age_s
        self._pool = ThreadPoolExecutor(1)
        self._asked = 0
        self._turn = asyncio.Lock()

    async def told(self) -> Told | None:
        """Request the current data; the data already shown expires even while a handshake step is waiting."""
        try:
            async with asyncio.timeout(self._max_age_s):
                answer = await self._ask(None, self._max_age_s)
        except TimeoutError:
            return None
        return answer if isinstance(answer, Told) else None

    async def handshake(self, step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed | None:
        """Request a step of the handshake."""
        answer = await self._ask((step, who, dict(arguments)), 1.0)
        return answer if isinstance(answer, str | Failed) else None

    async def _ask(self, question: Any, timeout_s: float) -> Any:
        async with self._turn:
            return await asyncio.get_running_loop().run_in_executor(
                self._pool, self._wait, question, timeout_s
            )

    def _wait(self, question: Any, timeout_s: float) -> Any:
        """Wait for the answer to this request; late answers to earlier requests are discarded."""
        self._asked += 1
        end = time.monotonic() + timeout_s
        try:
            self._connection.send((self._asked, question, end))
            while (left := end - time.monotonic()) > 0 and self._connection.poll(left):
                number, answer = self._connection.recv()
                if number == self._asked:
                    return answer
        except (EOFError, OSError) as error:
            raise SystemExit(0) from error
        return None


def _serve(
    settings: OpcUaSettings, kind: type, recipes: Recipes, connection: Connection, max_age_s: float
) -> None:
    async def serve() -> None:
        source = _AskedPlant(connection, max_age_s)
        async with opcua_server(settings, kind, source, recipes) as following:
            await following

    asyncio.run(serve())
