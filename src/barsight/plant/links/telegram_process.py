"""Serve the telegram in a separate process, so that nothing else delays its cycle.

On a busy computer a thread waits for the interpreter lock while the thread that holds it waits for a core.
So states are sent to the process as they are read, and commands come back. The process dies with its
parent, and a state that is no longer renewed becomes invalid.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, cast

from barsight.core.errors import BarsightError, OutputError
from barsight.plant.feed import StateFeed, with_age
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import TelegramSettings
from barsight.plant.state import PlantState, PlcReading
from barsight.plant.steps import LiftSteps

SEND_EVERY_S = 0.05
START_S = 120.0


async def serve_telegram(
    settings: TelegramSettings, feed: StateFeed, steps: LiftSteps, say: Callable[[str], None]
) -> None:
    """Serve until cancelled. Raises OutputError if the address is unavailable or the process ends."""
    context = multiprocessing.get_context("spawn")
    states, states_there = context.Pipe()
    calls, calls_there = context.Pipe()
    process = context.Process(
        target=_serve, args=(settings, states_there, calls_there), daemon=True, name="telegram"
    )
    await asyncio.to_thread(process.start)
    states_there.close()
    calls_there.close()
    stop, at = threading.Event(), f"telegram at {settings.host}"
    threads = [
        threading.Thread(
            target=_send_states, args=(states, feed, stop, say), name="telegram states", daemon=True
        ),
        threading.Thread(target=_answer_calls, args=(calls, feed, steps), name="telegram calls", daemon=True),
    ]
    try:
        begun = await asyncio.to_thread(_begun, calls)
        if isinstance(begun, str):
            raise OutputError(f"{at}:{settings.port}: {begun}; choose another address")
        say(f"{at}:{begun}")
        for thread in threads:
            thread.start()
        while process.is_alive() and all(thread.is_alive() for thread in threads):
            await asyncio.sleep(0.1)
        raise OutputError(f"{at}: its process or what answers it ended; the lines above say why")
    finally:
        stop.set()
        process.kill()
        await asyncio.to_thread(process.join)
        for thread in threads:
            if thread.ident is not None:
                await asyncio.to_thread(thread.join, 5)
        states.close()
        calls.close()


def _begun(calls: Connection) -> int | str:
    """Wait for the process to start: return the port on which it listens, or why it doesn't."""
    with contextlib.suppress(EOFError, OSError):
        if calls.poll(START_S):
            answer: int | str = calls.recv()
            return answer
    return "its process didn't start"


def _send_states(
    states: Connection, feed: StateFeed, stop: threading.Event, say: Callable[[str], None]
) -> None:
    with contextlib.suppress(EOFError, OSError):
        while not stop.wait(SEND_EVERY_S):
            states.send(feed.read())
            while states.poll():
                came = states.recv()
                if isinstance(came, str):
                    say(came)
                else:
                    feed.take_reading(came)


def _answer_calls(calls: Connection, feed: StateFeed, steps: LiftSteps) -> None:
    with contextlib.suppress(EOFError, OSError):
        while True:
            step, arguments = calls.recv()
            answer: Any
            try:
                answer = getattr(feed if step == "refresh" else steps, step)(*arguments)
            except BarsightError as error:
                answer = _Unreached(str(error))
            calls.send(answer)


class _Unreached(str):
    """Text of the error that kept a step from being carried out."""


class _SentFeed:
    """The newest state that the parent sent; the process ends if no more can come."""

    def __init__(self, states: Connection, calls: _Calls) -> None:
        self._states, self._calls = states, calls
        self._read: tuple[PlantState, float] | None = None
        threading.Thread(target=self._receive, daemon=True).start()

    def newest(self, life_counter: int) -> PlantState:
        """Return the newest state with the telegram's life counter; it is marked invalid if it is too old."""
        if self._read is None:
            reasons = ("starting: no state was read yet",)
            return PlantState("idle", False, reasons, life_counter, time.time_ns(), "none")
        return with_age(*self._read, life_counter)

    def refresh(self) -> None:
        """Make the parent read the state now."""
        self._calls.ask("refresh")

    def take_reading(self, reading: PlcReading) -> None:
        """Pass a PLC's reading of the crane on to the parent."""
        self._pass_on(reading)

    def say(self, text: str) -> None:
        """Have the parent say a line."""
        self._pass_on(text)

    def _pass_on(self, what: PlcReading | str) -> None:
        with contextlib.suppress(OSError):
            self._states.send(what)

    def _receive(self) -> None:
        try:
            while True:
                self._read = self._states.recv()
        except (EOFError, OSError):
            os._exit(1)


class _Calls:
    """The steps of `LiftSteps` by name, each carried out by the parent, one at a time."""

    def __init__(self, calls: Connection) -> None:
        self._calls, self._turn = calls, threading.Lock()

    def __getattr__(self, step: str) -> Callable[..., Any]:
        return partial(self.ask, step)

    def ask(self, step: str, *arguments: Any) -> Any:
        """Ask the parent to carry out a step. Raises BarsightError if it couldn't."""
        with self._turn:
            self._calls.send((step, arguments))
            answer = self._calls.recv()
        if isinstance(answer, _Unreached):
            raise BarsightError(answer)
        return answer


def _serve(settings: TelegramSettings, states: Connection, calls: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    asked = _Calls(calls)
    feed = _SentFeed(states, asked)
    server = TelegramServer(feed, cast(LiftSteps, asked), settings, feed.say)
    try:
        asyncio.run(server.run(calls.send))
    except OSError as error:
        with contextlib.suppress(OSError):
            calls.send(str(error))
