"""Pass the state to the process of the OPC UA server, and carry out the handshake steps that it passes on."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import itertools
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from barsight.core.errors import BarsightError, Failed, OutputError
from barsight.measure_settings import MeasureSettings
from barsight.plant.crane_names import opcua_name
from barsight.plant.feed import READ_EVERY_S, StateFeed
from barsight.plant.link_settings import OpcUaSettings
from barsight.plant.state import PlantState
from barsight.plant.steps import LiftSteps, take_named_step
from barsight.store.history import survey_folder
from barsight.store.opening import Store
from barsight.store.states import MISMATCHES


async def serve_opcua(
    store: Store, settings: OpcUaSettings, feed: StateFeed, steps: LiftSteps, say: Callable[[str], None]
) -> None:
    """Serve until cancelled. Raises ConfigError for a wrong folder of NodeSets, OutputError if the server's
    process ends.
    """
    from barsight.plant.opcua.process import OpcUaProcess  # needs an extra; the other links don't
    from barsight.plant.opcua.recipes import Recipes
    from barsight.plant.opcua.surveys import AlarmLine, Survey, Told

    def handshake(step: str, who: str, arguments: Mapping[str, Any]) -> str | Failed:
        taken = take_named_step(steps, step, opcua_name(who), arguments)
        feed.refresh()
        return taken

    folders: dict[str, Path] = {}

    def told(state: PlantState) -> Told:
        alarms = tuple(
            AlarmLine(alarm.code, alarm.text, "error" if alarm.code in MISMATCHES else "warning")
            for alarm in state.alarms if alarm.is_active
        )  # fmt: skip
        if state.map_id is not None and state.map_id not in folders:
            folders.clear()
            # The store may be back later; the survey is then reported.
            with contextlib.suppress(BarsightError), store.reading() as connection:
                folders[state.map_id] = survey_folder(connection, state.map_id)
        survey = None
        if state.map_id is not None and state.map_id in folders:
            survey = Survey(state.map_id, folders[state.map_id])
        return Told(state, alarms, survey)

    _ = settings.nodeset  # told here by one line, and not as the process dies
    presets = typing.get_args(typing.get_type_hints(MeasureSettings)["preset"])
    state = feed.newest(0)
    captured = datetime.datetime.fromtimestamp(state.stamp_ns / 1e9, datetime.UTC)
    recipes = Recipes(presets, state.calibration_id or "", captured)
    process = await asyncio.to_thread(OpcUaProcess, settings, PlantState, recipes, handshake)
    is_said = False
    try:
        for counter in itertools.count(1):
            if not process.is_alive:
                raise OutputError("OPC UA: its process or what answers it ended; the lines above say why")
            process.show(told(feed.newest(counter)))
            if process.is_serving and not is_said:
                say(f"OPC UA at {settings.url}")
                is_said = True
            await asyncio.sleep(READ_EVERY_S)
    finally:
        await asyncio.to_thread(process.stop)
