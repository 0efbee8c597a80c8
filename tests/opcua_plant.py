"""A plant for the tests of the OPC UA server, in its own process: commands come in by lines, one a change.

    python opcua_plant.py SETTINGS.json

`survey NAME FOLDER`, `alarm CODE LEVEL`, `quiet`, `memory` (prints resident KiB), `steps` (prints how
many steps of the handshake were asked for).
"""

from __future__ import annotations

import asyncio
import datetime
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import Failed
from barsight.plant.link_settings import OpcUaSettings
from barsight.plant.opcua.recipes import Recipes
from barsight.plant.opcua.server import opcua_server
from barsight.plant.opcua.surveys import AlarmLine, Survey, Told


@dataclass(frozen=True)
class DrawnLift:
    lift: str
    x_m: float
    mass_kg: float | None


@dataclass(frozen=True)
class DrawnState:
    """A snapshot with a field of every kind."""

    mode: str
    is_valid: bool
    life_counter: int
    position_m: tuple[float, float, float]
    lift: DrawnLift | None


class DrawnPlant:
    """Tells a state whose counter goes up at every look, and answers the handshake by a rule of its own."""

    def __init__(self) -> None:
        self.alarms: tuple[AlarmLine, ...] = ()
        self.survey: Survey | None = None
        self.is_quiet = False
        self.looks = self.steps = 0

    async def told(self) -> Told | None:
        self.looks += 1
        lift = DrawnLift("lift-1", 12.5, None)
        state = DrawnState("surveyed", True, self.looks, (1.0, 2.0, 3.0), lift)
        return None if self.is_quiet else Told(state, self.alarms, self.survey)

    async def handshake(self, step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed | None:
        self.steps += 1
        if step == "claim":
            return f"token of {who}" if arguments["lift"] == "lift-1" else Failed("unknown", "no such lift")
        return str(arguments["token"])

    def obey(self, line: str) -> str:
        command, *words = line.split()
        if command == "survey":
            self.survey = Survey(words[0], Path(words[1]))
        elif command == "alarm":
            self.alarms = (AlarmLine(words[0], f"{words[0]} stands", words[1]),) if words[0] != "-" else ()
        elif command == "quiet":
            self.is_quiet = True
        elif command == "steps":
            return str(self.steps)
        elif command == "memory":
            pages = Path("/proc/self/statm").read_text().split()[1]
            return str(int(pages) * 4)
        return "done"


async def main(settings: OpcUaSettings) -> None:
    plant = DrawnPlant()
    at = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    recipes = Recipes(("bars/magnet-1", "bars/magnet-2"), "calibration-1", at)
    loop = asyncio.get_running_loop()
    async with opcua_server(settings, DrawnState, plant, recipes) as following:
        print("up", flush=True)
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            assert not following.done(), following.exception()
            print(plant.obey(line), flush=True)


if __name__ == "__main__":
    given = json.loads(Path(sys.argv[1]).read_text())
    given = {
        name: Path(value) if name in ("folder", "users", "nodesets") else value
        for name, value in given.items()
    }
    asyncio.run(main(OpcUaSettings(**given)))
