"""Define what the OPC UA server requests from the plant: state, alarms, surveys, handshake answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from barsight.core.errors import Failed


@dataclass(frozen=True)
class Survey:
    """A finished survey. name: its id (that of its map); folder: its result folder."""

    name: str
    folder: Path


@dataclass(frozen=True)
class AlarmLine:
    """A current alarm: its stable code, a sentence, and its level `info`, `warning` or `error`."""

    code: str
    text: str
    level: str = "warning"


@dataclass(frozen=True)
class Told:
    """All data shown at one moment. state: a frozen snapshot. survey: the last finished one."""

    state: Any
    alarms: tuple[AlarmLine, ...] = ()
    survey: Survey | None = None


class PlantSource(Protocol):
    """Interface through which the server requests data from the plant."""

    async def told(self) -> Told | None:
        """Return the current data, or None if it is unknown or out of date."""

    async def handshake(self, step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed | None:
        """Take a step of a lift's handshake: `claim` returns a token. None: there was no answer."""
