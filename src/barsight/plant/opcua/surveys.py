"""Define what the OPC UA server asks the plant: state, alarms, surveys, answers to the handshake."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from barsight.core.errors import Failed


@dataclass(frozen=True)
class Survey:
    """A survey that ended. name: its id (the map's); folder: its result folder."""

    name: str
    folder: Path


@dataclass(frozen=True)
class AlarmLine:
    """An alarm that stands: its stable code, a sentence, and `info`, `warning` or `error`."""

    code: str
    text: str
    level: str = "warning"


@dataclass(frozen=True)
class Told:
    """All that is shown at one moment. state: a frozen snapshot. survey: the last that ended."""

    state: Any
    alarms: tuple[AlarmLine, ...] = ()
    survey: Survey | None = None


class PlantSource(Protocol):
    """The plant's side, as the server asks it."""

    async def told(self) -> Told | None:
        """Return what is true now, or None where that isn't known (any more)."""

    async def handshake(self, step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed | None:
        """Take a step of the handshake of a lift: `claim` returns a token. None: nobody answers."""
