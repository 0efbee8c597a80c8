"""Check the OPC UA server as one of its clients."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from barsight.core.errors import Failed
from barsight.core.files import atomic_path
from barsight.plant.link_settings import OpcUaSettings
from barsight.plant.links.link_check import LinkCheck
from barsight.plant.opcua.security.binding import Client, SecurityPolicyBasic256Sha256, ua
from barsight.plant.opcua.security.certificates import make_certificate

URI = "urn:barsight:check"
LOOKS, EVERY_S = 10, 0.15
SHOWN = ("mode", "is_valid", "reasons", "life_counter", "survey", "lift.lift_id", "lift.valid_until_ns")


def check_opcua(settings: OpcUaSettings) -> LinkCheck | Failed:
    """Connect and poll the state; return readable lines and whether the link passed.

    With encryption the check makes a certificate, which the server trusts until the check ends.
    """
    try:
        return asyncio.run(_read(settings))
    except (OSError, TimeoutError, ua.UaError, asyncio.CancelledError) as error:
        return Failed("opcua-link", f"{settings.url}: {error or type(error).__name__}")


async def _read(settings: OpcUaSettings) -> LinkCheck:
    async with _client(settings) as client:
        modes = [
            f"{point.SecurityPolicyUri.rsplit('#')[-1]}, {point.SecurityMode.name.rstrip('_')}"
            for point in await client.get_endpoints()
        ]  # fmt: skip
        index = await client.get_namespace_index("urn:barsight:crane")
        node = client.get_node(f"ns={index};s=State.life_counter")
        lives, took_s = [], []
        for _ in range(LOOKS):
            began = time.monotonic()
            lives.append((await node.read_data_value(raise_on_bad_status=False)).Value.Value)
            took_s.append(time.monotonic() - began)
            await asyncio.sleep(EVERY_S)
        lines = ["offers " + "; ".join(sorted(set(modes)))]
        for name in SHOWN:
            value = await client.get_node(f"ns={index};s=State.{name}").read_data_value(False)
            lines.append(f"State.{name}: {value.Value.Value} ({value.StatusCode.name})")
    moved = len({one for one in lives if one is not None})
    is_alive = None not in lives and moved > LOOKS // 2
    lines.append(
        f"read in {sorted(took_s)[LOOKS // 2] * 1e3:.1f} ms (median), {max(took_s) * 1e3:.1f} ms at most"
    )
    lines.append("life counter: " + ("moves" if is_alive else "STANDS STILL"))
    if settings.allow_unsecured:
        lines.append("NOT SECURED: opcua.allow_unsecured lets clients in without a certificate")
        return LinkCheck("opcua", tuple(lines), is_alive)
    is_open = await _lets_in_unsecured(settings)
    lines.append("a client without certificate and encryption: " + ("LET IN" if is_open else "refused"))
    return LinkCheck("opcua", tuple(lines), is_alive and not is_open)


async def _lets_in_unsecured(settings: OpcUaSettings) -> bool:
    try:
        async with Client(settings.url, timeout=10):
            return True
    except (OSError, TimeoutError, ua.UaError):
        return False


@contextlib.asynccontextmanager
async def _client(settings: OpcUaSettings) -> AsyncIterator[Any]:
    client = Client(settings.url, timeout=10)
    client.application_uri = URI
    with contextlib.ExitStack() as kept:
        if not settings.allow_unsecured:
            certificate, key = _identity(settings.folder, kept)
            await client.set_security(
                SecurityPolicyBasic256Sha256, certificate, key, mode=ua.MessageSecurityMode.SignAndEncrypt
            )
        async with client:
            yield client


def _identity(folder: Path, kept: contextlib.ExitStack) -> tuple[Path, Path]:
    """Make a certificate that is valid for an hour and that the server trusts while `kept` is open."""
    content, key = make_certificate(URI, "barsight plant check", ["localhost"], 1 / 24)
    paths = folder / "trusted" / "barsight-plant-check.der", folder / "check.key.pem"
    for path, data in zip(paths, (content, key), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        kept.callback(path.unlink, missing_ok=True)
        with atomic_path(path) as made:
            made.write_bytes(data)
    return paths
