"""Exchange telegrams with a PLC's data blocks by S7 PUT and GET, in a separate thread."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from barsight.core.errors import BarsightError, Failed
from barsight.plant.crane_names import plc_name
from barsight.plant.feed import StateFeed
from barsight.plant.link_settings import S7Settings
from barsight.plant.partner import PlcPartner
from barsight.plant.state import PlcReading
from barsight.plant.steps import LiftSteps
from barsight.plant.telegram import layout, out_values, pack, unpack


async def serve_s7(
    settings: S7Settings, feed: StateFeed, steps: LiftSteps, say: Callable[[str], None]
) -> None:
    """Exchange until cancelled. say: called once when the PLC can't be reached or its data is no telegram,
    and once when it has recovered.

    Steps are carried out by a thread of their own: the PLC is read, and life counts, while the store is slow.
    """
    from barsight.plant.s7 import S7Exchange, run_s7  # needs an extra; the other links don't

    at = f"{settings.host}:{settings.port}"
    partner = PlcPartner(plc_name(f"{at} by S7"), steps, settings.silent_s)
    counter, stop = 0, threading.Event()
    wrong: str | None = None
    worker = ThreadPoolExecutor(1, "S7 steps")
    step: Future[None] | None = None

    def outputs() -> bytes:
        nonlocal counter
        counter += 1
        return pack("out", out_values(partner.seen(feed.newest(counter)), partner.answer))

    def watch(reading: PlcReading) -> str:
        feed.take_reading(reading)
        return partner.watch(reading)

    def take(exchanged: S7Exchange | Failed) -> None:
        nonlocal wrong, step
        found = exchanged if isinstance(exchanged, Failed) else unpack("in", exchanged.inputs)
        now = found.reason if isinstance(found, Failed) else watch(partner.reading(found))
        if wrong is None or bool(now) != bool(wrong):
            say(f"S7 with {at}: {now or 'exchanging'}")
        wrong = now
        if isinstance(found, Failed):
            return
        is_busy = step is not None and not step.done()
        if step is not None and not is_busy:
            step.result()  # what isn't a refusal ends the link
        if partner.receive(found, is_busy=is_busy):
            step = worker.submit(carry_out)

    def carry_out() -> None:
        partner.execute()
        feed.refresh()

    thread = asyncio.create_task(asyncio.to_thread(run_s7, settings, layout("in").size, outputs, take, stop))
    try:
        await asyncio.shield(thread)
    finally:
        stop.set()
        await asyncio.gather(thread, return_exceptions=True)
        await asyncio.to_thread(worker.shutdown)
        with contextlib.suppress(BarsightError):
            await asyncio.to_thread(partner.note_touches)
