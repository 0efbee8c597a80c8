"""Check every link of plant.toml from its other side, and write a protocol of it."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import barsight
from barsight.core.errors import Failed
from barsight.core.files import atomic_path
from barsight.plant.links.telegram_check import check_telegram
from barsight.plant.settings import PlantSettings
from barsight.plant.webhooks import post


@dataclass(frozen=True)
class LinkCheck:
    """Result of a link's check. lines: for people. is_good: whether the link holds."""

    link: str
    lines: tuple[str, ...]
    is_good: bool


Check = Callable[[PlantSettings], LinkCheck | Failed]


def check_links(settings: PlantSettings, seconds: float) -> tuple[LinkCheck, ...]:
    """Check each link that is configured; nothing is claimed, and no data block of the PLC is written.

    seconds: for the telegram's cycle.
    """
    checks: dict[str, Check] = {**_CHECKS, "telegram": partial(_telegram, seconds=seconds)}
    return tuple(_checked(name, checks[name], settings) for name in settings.links)


def _checked(name: str, check: Check, all_of: PlantSettings) -> LinkCheck:
    found = check(all_of)
    if isinstance(found, Failed):
        return LinkCheck(name, (f"{found.reason}; is barsight plant run running?",), False)
    return found


def _telegram(settings: PlantSettings, seconds: float) -> LinkCheck | Failed:
    assert settings.telegram is not None
    found = check_telegram(settings.telegram, seconds)
    return found if isinstance(found, Failed) else LinkCheck("telegram", found.lines, found.is_good)


def _opcua(settings: PlantSettings) -> LinkCheck | Failed:
    from barsight.plant.links.opcua_check import check_opcua  # an extra that other links don't need

    assert settings.opcua is not None
    found = check_opcua(settings.opcua)
    return found if isinstance(found, Failed) else LinkCheck("opcua", *found)


def _mqtt(settings: PlantSettings) -> LinkCheck | Failed:
    from barsight.plant.links.mqtt_check import check_mqtt  # an extra that other links don't need

    assert settings.mqtt is not None
    found = check_mqtt(settings.mqtt)
    return found if isinstance(found, Failed) else LinkCheck("mqtt", *found)


def _s7(settings: PlantSettings) -> LinkCheck | Failed:
    from barsight.plant.links.s7_check import check_s7  # an extra that other links don't need

    assert settings.s7 is not None
    found = check_s7(settings.s7)
    return found if isinstance(found, Failed) else LinkCheck("s7", *found)


def _webhooks(settings: PlantSettings) -> LinkCheck | Failed:
    assert settings.webhooks is not None
    problems = {url: post(url, settings.webhooks, {"event": "check"})[0] for url in settings.webhooks.urls}
    lines = tuple(f"{url}: {problem or 'takes a post'}" for url, problem in problems.items())
    return LinkCheck("webhooks", lines, not any(problems.values()))


_CHECKS: dict[str, Check] = {
    "opcua": _opcua, "mqtt": _mqtt, "s7": _s7, "webhooks": _webhooks,
}  # fmt: skip


def write_protocol(path: Path, config: Path, checks: tuple[LinkCheck, ...]) -> None:
    """Write what was checked, when, with which plant.toml and with what result, as text."""
    digest = hashlib.sha256(config.read_bytes()).hexdigest()
    lines = [
        "Barsight: protocol of the plant's links", f"date: {datetime.now(UTC).isoformat(timespec='seconds')}",
        f"computer: {platform.node()}", f"software: barsight {barsight.__version__}",
        f"configuration: {config.name}, SHA-256 {digest}",
    ]  # fmt: skip
    for one in checks:
        lines += [
            "",
            f"{one.link}: {'holds' if one.is_good else 'DOES NOT HOLD'}",
            *(f"  {line}" for line in one.lines),
        ]
    with atomic_path(path) as made:
        made.write_text("\n".join(lines) + "\n", encoding="utf-8")
