"""Check every link of plant.toml from its other end, and write a record of the checks."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import barsight
from barsight.core.errors import Failed
from barsight.core.files import atomic_path
from barsight.plant.link_settings import WebhookSettings
from barsight.plant.links.link_check import LinkCheck
from barsight.plant.links.telegram_check import check_telegram
from barsight.plant.settings import PlantSettings
from barsight.plant.webhooks import post
from barsight.result_folder import file_digest


def check_links(settings: PlantSettings, seconds: float) -> tuple[LinkCheck, ...]:
    """Check each configured link. No lift is claimed, and no data block of the PLC is written.

    seconds: duration of the telegram check.
    """
    return tuple(
        LinkCheck(name, (f"{found.reason}; is barsight plant run running?",), False)
        if isinstance(found, Failed) else found
        for name, found in _found(settings, seconds)
    )  # fmt: skip


def _found(settings: PlantSettings, seconds: float) -> Iterator[tuple[str, LinkCheck | Failed]]:
    """Check link after link; packages of an extra are imported only if their link is configured."""
    if settings.telegram is not None:
        yield "telegram", check_telegram(settings.telegram, seconds)
    if settings.opcua is not None:
        from barsight.plant.links.opcua_check import check_opcua

        yield "opcua", check_opcua(settings.opcua)
    if settings.mqtt is not None:
        from barsight.plant.links.mqtt_check import check_mqtt

        yield "mqtt", check_mqtt(settings.mqtt)
    if settings.s7 is not None:
        from barsight.plant.links.s7_check import check_s7

        yield "s7", check_s7(settings.s7)
    if settings.webhooks is not None:
        yield "webhooks", _check_webhooks(settings.webhooks)


def _check_webhooks(settings: WebhookSettings) -> LinkCheck:
    problems = {url: post(url, settings, {"event": "check"})[0] for url in settings.urls}
    lines = tuple(f"{url}: {problem or 'takes a post'}" for url, problem in problems.items())
    return LinkCheck("webhooks", lines, not any(problems.values()))


def write_protocol(path: Path, config: Path, checks: tuple[LinkCheck, ...]) -> None:
    """Write a text file with what was checked, when, with which plant.toml and with what result."""
    lines = [
        "Barsight: protocol of the plant's links", f"date: {datetime.now(UTC).isoformat(timespec='seconds')}",
        f"computer: {platform.node()}", f"software: barsight {barsight.__version__}",
        f"configuration: {config.name}, SHA-256 {file_digest(config)}",
    ]  # fmt: skip
    for check in checks:
        lines += [
            "",
            f"{check.link}: {'holds' if check.is_good else 'DOES NOT HOLD'}",
            *(f"  {line}" for line in check.lines),
        ]
    with atomic_path(path) as made:
        made.write_text("\n".join(lines) + "\n", encoding="utf-8")
