"""Define the state that telegram, OPC UA, MQTT and S7 share, and read it from a store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from barsight.core.json_values import json_value
from barsight.core.reading.live_run import CranePose
from barsight.store.confirmation import OPEN, OpenLift, map_vetoes, newest_survey, open_lifts, yard_clock_ns
from barsight.store.history import why_ahead
from barsight.store.lift_records import ROUNDING_M
from barsight.store.opening import Store
from barsight.store.states import alarm_priority, standing_alarms

MAX_ALARMS = 20
"""Maximum number of alarms in the state: urgent ones, then active ones, then the newest. One of each further
code is added, up to `MAX_CODES`.
"""
MAX_PLACE_M = 10_000.0
"""Readings of a crane in metres from which on they are no place in a yard."""
MIN_FLOAT = 1e-30
"""Numbers up to which a reading in metres is no difference of rounding, but bytes in another order."""
MAX_CODES = 20
"""Maximum number of alarms that are added so that each code is told."""
YAW_SENSE = "of the beam from +Y of the yard frame, counter-clockwise seen from above"


@dataclass(frozen=True)
class PlcReading:
    """A PLC's telegram, received at stamp_ns of this computer's clock.

    clock_offset_s: the PLC's clock minus this computer's. load_kg: None if the load wasn't weighed.
    """

    who: str
    stamp_ns: int
    clock_offset_s: float
    bridge_m: float
    trolley_m: float
    hoist_m: float
    load_kg: float | None
    is_magnet_on: bool
    is_rope_slack: bool
    is_position_reached: bool

    @property
    def place_m(self) -> tuple[float, float, float] | None:
        """Return bridge, trolley and hoist; None if they aren't known."""
        place_m = (self.bridge_m, self.trolley_m, self.hoist_m)
        return place_m if is_place(*place_m) else None

    @property
    def problem(self) -> str:
        """Return why the position can't be right, as of a float or swapped words; empty if it may be."""
        far_m = max((self.bridge_m, self.trolley_m, self.hoist_m), key=abs)
        if abs(far_m) < MAX_PLACE_M:
            return ""
        return f"its position, {far_m:.0f} m, is in no yard: send whole numbers of 0.1 mm, in the byte order"


def is_place(*place_m: float) -> bool:
    """Check whether a crane's readings are known: not all zeros, nor outside any yard, nor with a number that
    only swapped bytes make so small.
    """
    sizes_m = [abs(value) for value in place_m]
    return max(sizes_m) >= ROUNDING_M and all(one == 0 or MIN_FLOAT < one < MAX_PLACE_M for one in sizes_m)


@dataclass(frozen=True)
class OfferedLift:
    """A lift with all data that a crane needs, in the yard frame.

    hoist_height_m: height of the faces' plane at contact. approach_height_m: height at which the magnet's
    faces may travel over any place, None if the plant defines none. magnet_class: current step for the load,
    None if the plant has no table. sha256: of all fields except itself and `handshake`.
    """

    lift_id: int
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    yaw_sense: str
    hoist_height_m: float
    approach_height_m: float | None
    magnet_class: int | None
    tolerance_x_m: float
    tolerance_y_m: float
    tolerance_yaw_deg: float
    mass_kg: float
    mass_sigma_kg: float
    count: int
    set_down_x_m: float | None
    set_down_y_m: float | None
    set_down_z_m: float | None
    set_down_yaw_deg: float | None
    valid_until_ns: int
    map_id: str
    handshake: str
    sha256: str = ""

    def is_at(self, x_m: float, y_m: float) -> bool:
        """Check whether a crane's readings lie within the tolerance of the target."""
        x_off, y_off = abs(x_m - self.x_m), abs(y_m - self.y_m)
        return x_off <= self.tolerance_x_m + ROUNDING_M and y_off <= self.tolerance_y_m + ROUNDING_M

    def digest(self) -> str:
        """Form the checksum: SHA-256 of the fields' JSON without `handshake` and `sha256`."""
        content = {k: v for k, v in asdict(self).items() if k not in ("handshake", "sha256")}
        text = json.dumps(json_value(content), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class PlantAlarm:
    """An alarm that isn't cleared. priority: 1 (highest) to 3. is_active: its cause may still exist."""

    code: str
    priority: int
    text: str
    is_active: bool
    is_acknowledged: bool


@dataclass(frozen=True)
class PlantState:
    """The plant state at `stamp_ns` of the yard's clock. reasons: why it isn't valid; empty if it is."""

    mode: str
    is_valid: bool
    reasons: tuple[str, ...]
    life_counter: int
    stamp_ns: int
    survey: str
    pose: CranePose | None = None
    lift: OfferedLift | None = None
    alarms: tuple[PlantAlarm, ...] = ()
    map_id: str | None = None
    calibration_id: str | None = None
    plc: PlcReading | None = None


def state_of_store(
    store: Store, life_counter: int, *, approach_height_m: float | None = None,
    magnet_steps_kg: tuple[float, ...] = (), allow_simulated: bool = False, now_ns: int | None = None,
) -> PlantState:  # fmt: skip
    """Read the state: the lift that has begun, otherwise the claimed one, otherwise the best offer.

    It is valid if the lift's map is the newest and not too old. A lift that has begun stays until it is
    reported, and nothing else is offered meanwhile. If a bundle has been ordered, the first lift of its order
    is the only offer.
    approach_height_m, magnet_steps_kg, allow_simulated: see `PlantSettings`. now_ns: this computer's clock.
    """
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection, now_ns)
        survey = newest_survey(connection)
        lifts = open_lifts(connection)
        vetoes = [] if survey is None else map_vetoes(connection, survey.id)
        alarms = told_alarms(_alarm(*one) for one in standing_alarms(connection))
    if survey is None:
        empty = ("no-survey: the store holds no survey",)
        return PlantState("idle", False, empty, life_counter, clock_ns, "none", alarms=alarms)
    ahead = why_ahead(survey.captured_to_ns, clock_ns)
    usable = [
        one for one in lifts
        if one.survey_id == survey.id and (one.record["valid_until_ns"] or 0) > clock_ns and not ahead
        and (one.state != "offered" or one.record.get("begins_fetch") is not False)
    ]  # fmt: skip
    begun = next((one for one in lifts if one.state == "executing"), None)
    best = begun or min(
        usable, key=lambda one: (OPEN.index(one.state) == 0, one.record["rank"]), default=None
    )
    lift = None if best is None else offered_lift(best, approach_height_m, magnet_steps_kg)
    reasons = _reasons(lift, survey.is_simulated and not allow_simulated, bool(magnet_steps_kg))
    if ahead:
        reasons = (f"map-from-the-future: {ahead}", *reasons)
    if begun is not None and (vetoes or begun not in usable):
        old = "; ".join(one["reason"] for one in vetoes) or "its map is no longer the newest, or too old"
        reasons = (*reasons, f"unfinished: lift {begun.lift_id} has begun and isn't reported; {old}")
    return PlantState(
        "simulated" if survey.is_simulated else "surveyed", not reasons, reasons, life_counter, clock_ns,
        "done", None, lift, alarms, survey.map_id, survey.calibration_id,
    )  # fmt: skip


def told_alarms(standing: Iterable[PlantAlarm]) -> tuple[PlantAlarm, ...]:
    """Choose the alarms that the plant is told. standing: the newest first."""
    ranked = sorted(standing, key=lambda alarm: (alarm.priority, not alarm.is_active))
    chosen = ranked[:MAX_ALARMS]
    codes = {alarm.code for alarm in chosen}
    for alarm in ranked[MAX_ALARMS:]:
        if alarm.code not in codes and len(chosen) < MAX_ALARMS + MAX_CODES:
            codes.add(alarm.code)
            chosen.append(alarm)
    return tuple(chosen)


def _alarm(code: str, reason: str, state: str) -> PlantAlarm:
    return PlantAlarm(code, alarm_priority(code), reason, state != "returned", state == "acknowledged")


def _reasons(lift: OfferedLift | None, is_simulated: bool, has_steps: bool) -> tuple[str, ...]:
    """List the reasons why a crane must not act on the state."""
    if lift is None:
        return ("no-lift: no lift is offered that is still valid",)
    found = ["simulated: the yard was never measured"] if is_simulated else []
    if has_steps and lift.magnet_class is None:
        found.append("too-heavy: no step of the magnet surely carries the load")
    return tuple(found)


def offered_lift(
    lift: OpenLift, approach_height_m: float | None, magnet_steps_kg: tuple[float, ...]
) -> OfferedLift:
    """Form the offer to the crane from a lift of the store.

    The magnet class is the first current step, counted from 1, that carries the mass plus two of its standard
    deviations.
    """
    record: dict[str, Any] = lift.record
    tolerance = record["tolerance"]
    # Records of an earlier version have no offset between the crane's readings and its magnet.
    target = record.get("crane_target", record["target"])
    place = record.get("crane_set_down", record["set_down"]) or {}
    heaviest_kg = record["mass_kg"] + 2 * record["mass_sigma_kg"]
    steps = [number for number, most in enumerate(magnet_steps_kg, 1) if most >= heaviest_kg]
    one = OfferedLift(
        lift.lift_id, target["x_m"], target["y_m"], target["z_m"], target["yaw_deg"], YAW_SENSE,
        target["z_m"], approach_height_m, steps[0] if steps else None, tolerance["x_m"], tolerance["y_m"],
        tolerance["yaw_deg"], record["mass_kg"], record["mass_sigma_kg"], record["count"], place.get("x_m"),
        place.get("y_m"), place.get("z_m"), place.get("yaw_deg"), int(record["valid_until_ns"]), lift.map_id,
        lift.state,
    )  # fmt: skip
    return replace(one, sha256=one.digest())
