"""Serve telegram, OPC UA, MQTT, S7 and webhooks from one state, until stopped or until one of them ends."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from barsight.core.errors import BarsightError, OutputError
from barsight.plant.feed import READ_EVERY_S, StateFeed
from barsight.plant.link_settings import MqttSettings, WebhookSettings
from barsight.plant.links.changes import changes_between
from barsight.plant.links.opcua_link import serve_opcua
from barsight.plant.links.s7_link import serve_s7
from barsight.plant.links.telegram_process import serve_telegram
from barsight.plant.settings import PlantSettings
from barsight.plant.state import PlantState
from barsight.plant.steps import LiftSteps
from barsight.plant.webhooks import Webhook, read_secret
from barsight.store.opening import Store

Say = Callable[[str], None]


async def serve_plant(store: Store, settings: PlantSettings, say: Say) -> None:
    """Serve all links until cancelled. say: called with the address of each link and with any problem of one.

    Raises OutputError if a link can't be served, or if the state is no longer being read.
    """
    steps = LiftSteps(store, settings)
    with StateFeed(store, settings) as feed:
        links = {"state": _watch(feed, steps), **_links(store, settings, feed, steps, say)}
        tasks = [asyncio.create_task(_named(name, link), name=name) for name, link in links.items()]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def _links(
    store: Store, settings: PlantSettings, feed: StateFeed, steps: LiftSteps, say: Say
) -> dict[str, Awaitable[None]]:
    links: dict[str, Awaitable[None]] = {}
    if settings.telegram is not None:
        at = f"telegram at {settings.telegram.host}:{settings.telegram.port}"
        links[at] = serve_telegram(settings.telegram, feed, steps, say)
    if settings.opcua is not None:
        links[f"OPC UA at {settings.opcua.url}"] = serve_opcua(store, settings.opcua, feed, steps, say)
    if settings.mqtt is not None:
        links[f"MQTT at {settings.mqtt.host}:{settings.mqtt.port}"] = _serve_mqtt(settings.mqtt, feed, say)
    if settings.s7 is not None:
        links[f"S7 at {settings.s7.host}:{settings.s7.port}"] = serve_s7(settings.s7, feed, steps, say)
    if settings.webhooks is not None:
        links["webhooks"] = _serve_webhooks(settings.webhooks, feed, say)
    return links


async def _watch(feed: StateFeed, steps: LiftSteps) -> None:
    """Raise OutputError if the state is no longer being read: no link would ever offer a lift again.

    Touches that the store couldn't take are noted meanwhile: the offers near them stand until then.
    """
    while feed.is_alive:
        with contextlib.suppress(BarsightError):
            await asyncio.to_thread(steps.note_touches)
        await asyncio.sleep(1.0)
    raise OutputError("the state is read no more; the lines above say why")


async def _followed(feed: StateFeed) -> AsyncIterator[tuple[PlantState, list[dict[str, Any]]]]:
    """Yield the newest state repeatedly, with the changes since the previous one.

    A change may arrive twice: its `id` tells. Ids rise from the time in ms at which this began, so that none
    of an earlier process comes again.
    """
    last: PlantState | None = None
    ids = itertools.count(time.time_ns() // 1_000_000)
    for counter in itertools.count(1):
        state = feed.newest(counter)
        yield state, [{"id": next(ids), **change} for change in changes_between(last, state)]
        last = state
        await asyncio.sleep(READ_EVERY_S)


async def _serve_webhooks(settings: WebhookSettings, feed: StateFeed, say: Say) -> None:
    if settings.secret_file is not None:
        read_secret(settings.secret_file)
    hooks = [Webhook(url, settings) for url in settings.urls]
    reported: dict[str, str | None] = {hook.url: None for hook in hooks}
    for hook in hooks:
        say(f"webhook {hook.url}: each change is posted")
    try:
        async for _, changes in _followed(feed):
            for hook in hooks:
                for change in changes:
                    hook.tell(change)
                if (now := hook.problem) != reported[hook.url]:
                    say(f"webhook {hook.url}: {now or 'takes posts again'}")
                reported[hook.url] = now
    finally:
        for hook in hooks:
            await asyncio.to_thread(hook.stop)


async def _serve_mqtt(settings: MqttSettings, feed: StateFeed, say: Say) -> None:
    from barsight.plant.mqtt import MqttPublisher  # needs an extra; the other links don't

    publisher = MqttPublisher(settings)
    running = asyncio.create_task(publisher.run())
    at, reported = f"{settings.host}:{settings.port}", None
    say(f"MQTT to {at}, topics {settings.prefix}/...")
    try:
        async for state, changes in _followed(feed):
            publisher.show(state)
            for change in changes:
                publisher.tell(change)
            if (now := publisher.problem) != reported:
                say(f"MQTT to {at}: {now or 'connected'}")
            reported = now
            if running.done():
                running.result()
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def _named(name: str, link: Awaitable[None]) -> None:
    try:
        await link
    except OSError as error:
        raise OutputError(f"{name}: {error}; choose another address") from error
