"""Poll the plant state from the store, once for all links."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import replace
from types import TracebackType
from typing import Protocol

from barsight.core.errors import BarsightError
from barsight.core.reading.live_run import CranePose
from barsight.plant.crane_names import is_crane
from barsight.plant.handshake import expire_claims
from barsight.plant.link_settings import MAX_AGE_S
from barsight.plant.live_folder import with_live_run
from barsight.plant.settings import PlantSettings
from barsight.plant.state import PlantState, PlcReading, state_of_store
from barsight.store.confirmation import expire_stale
from barsight.store.opening import Store

READ_EVERY_S = 0.1
JUDGE_EVERY_S = 1.0
PLC_SILENT_S = 1.0
"""Maximum age of a PLC reading in seconds for it to be passed on with the state."""
WHO = "barsight plant"


class StateReader(Protocol):
    """Interface from which a link gets the newest state."""

    def newest(self, life_counter: int) -> PlantState:
        """Return the newest state with the link's own life counter."""

    def refresh(self) -> None:
        """Read the state from the store now."""

    def take_reading(self, reading: PlcReading) -> None:
        """Accept a PLC's reading of the crane."""


class StateFeed:
    """Hold the newest state. A thread reads it while the block runs, so that no link waits for the store."""

    def __init__(self, store: Store, settings: PlantSettings) -> None:
        self._store, self._settings = store, settings
        self._plc: tuple[float, PlcReading] | None = None
        began_s = time.monotonic()
        self._read = read_state(store, settings), began_s
        self._stop, self._turn = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._follow, name="plant state", daemon=True)

    def __enter__(self) -> StateFeed:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(5)

    @property
    def is_alive(self) -> bool:
        """Return True while the reading thread runs."""
        return self._thread.is_alive()

    def newest(self, life_counter: int) -> PlantState:
        """Return the newest state with the link's own life counter; it is marked invalid if it is too old."""
        return with_age(*self.read(), life_counter)

    def read(self) -> tuple[PlantState, float]:
        """Return the newest state and when it was read (seconds of the monotonic clock)."""
        return self._read

    def refresh(self) -> None:
        """Read the state now, for example after a step of the handshake."""
        with self._turn:
            began_s = time.monotonic()
            state = read_state(self._store, self._settings, self._read[0])
            self._read = self._with_plc(state), began_s

    def take_reading(self, reading: PlcReading) -> None:
        """Accept a PLC's reading of the crane; it is in the states of the next `PLC_SILENT_S` seconds."""
        self._plc = time.monotonic(), reading

    def _with_plc(self, state: PlantState) -> PlantState:
        known, crane = self._plc, self._settings.crane
        if known is None or time.monotonic() - known[0] > PLC_SILENT_S:
            return state
        plc, pose = known[1], state.pose
        if pose is None and crane is not None and plc.place_m is not None and self._settings.live is None:
            pose = CranePose(*plc.place_m, None, (crane.position_std_m,) * 3, plc.stamp_ns)
        return replace(state, plc=plc, pose=pose)

    def _follow(self) -> None:
        judged_s = time.monotonic()
        while not self._stop.wait(READ_EVERY_S):
            self.refresh()
            if time.monotonic() - judged_s > JUDGE_EVERY_S:
                judged_s = time.monotonic()
                with contextlib.suppress(BarsightError):  # the store may be back later
                    expire_stale(self._store, WHO)  # stored, so that no clock set back revives an offer
                    expire_claims(self._store, WHO, self._settings.store.claim_s, is_crane)


def with_age(state: PlantState, read_s: float, life_counter: int) -> PlantState:
    """Return a link's state with its own life counter; it is marked invalid if it was read too long ago."""
    age_s = time.monotonic() - read_s
    if age_s > MAX_AGE_S:
        reason = f"state-too-old: the store was read {age_s:.1f} s ago"
        state = replace(state, is_valid=False, reasons=(*state.reasons, reason))
    return replace(state, life_counter=life_counter)


def read_state(store: Store, settings: PlantSettings, before: PlantState | None = None) -> PlantState:
    """Read the state; it is invalid if the store or the live run can't be read.

    If the store can't be read, the alarms, map and calibration of the state `before` are kept: no alarm
    counts as ended, and no new survey is reported once the store is back.
    """
    source = settings.store
    try:
        state = state_of_store(
            store, 0, approach_height_m=source.approach_height_m, magnet_steps_kg=source.magnet_steps_kg,
            allow_simulated=source.allow_simulated,
        )  # fmt: skip
    except BarsightError as error:
        state = PlantState("idle", False, (f"store: {error}",), 0, time.time_ns(), "none")
        if before is not None:
            state = replace(
                state, alarms=before.alarms, map_id=before.map_id, calibration_id=before.calibration_id
            )
    return state if settings.live is None else with_live_run(state, settings.live.folder)
