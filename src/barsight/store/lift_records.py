"""Store a survey's lifts and vetoes, settle the lifts that were offered or executed before it, notice when
those in its folder are others, compute the outlines of what a lift may have moved, and find where a crane
made it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.result_folder import file_digest
from barsight.store.audit import Entry
from barsight.store.history import executed_lifts
from barsight.store.states import has_alarm, raise_alarm, step_lift
from barsight.store.tables import LIFT_BUNDLES, LIFT_STATES, LIFTS, SIGHTINGS, SURVEY_VETOES, TOUCHES
from barsight.yard.axes import corners, gap_between
from barsight.yard.events import kept_events
from barsight.yard.inventory.bundle_file import bundle_of
from barsight.yard.lifting.lift_file import read_lifts, unknown_events
from barsight.yard.magnet.description import MagnetOffset
from barsight.yard.placement.load import laid_at

with extra("store"):
    from sqlalchemy import Connection, Row, select


BESIDE = "lift-beside"
"""Code of the alarm after a magnet came down beside the target of its lift."""
ROUNDING_M = 1e-4
"""Maximum difference (m) of a target and a reading beyond the tolerance, as telegrams round both."""


def add_lifts(
    opened: Entry, survey_id: int, content: dict[str, Any], ids: dict[int, int], *, is_newest: bool
) -> None:
    """Add the content of lifts.json. ids: identities by id in bundles.json.

    Lifts are offered only if no later survey is known (is_newest); vetoes are always stored.
    """
    fetch = content.get("fetch")
    for veto in content["vetoes"]:
        opened.add(SURVEY_VETOES, survey_id=survey_id, code=veto["code"], reason=veto["reason"])
    for lift in content["refused"]:
        for number in lift["bundles"]:
            for veto in lift["vetoes"]:
                opened.add(
                    SURVEY_VETOES, survey_id=survey_id, bundle_id=ids[number], code=veto["code"],
                    reason=veto["reason"],
                )  # fmt: skip
    for lift in content["lifts"] if is_newest else ():
        record = {key: value for key, value in lift.items() if key not in ("poles", "checks")}
        record |= {
            "beam": _outline(content.get("magnet") or {}),
            "offset": (content.get("magnet") or {}).get("offset"),
            "disturbed_reach_m": content["settings"]["disturbed_reach_m"],
            "begins_fetch": None if fetch is None else lift["bundles"] == [fetch["steps"][0]["bundle"]],
        }
        lift_id = opened.add(
            LIFTS, survey_id=survey_id, rank=lift["rank"], record=json.dumps(record, sort_keys=True)
        )
        for number in lift["bundles"]:
            opened.add(LIFT_BUNDLES, lift_id=lift_id, bundle_id=ids[number])
        step_lift(opened, lift_id, "offered")


def _outline(magnet: dict[str, Any]) -> dict[str, float] | None:
    """Return width and length of beam and poles together, as `Magnet.size_m`; None if no beam is known."""
    beam, poles = magnet.get("beam"), magnet.get("poles") or ()
    if beam is None:
        return None
    sizes = (("width_m", "across_m"), ("length_m", "along_m"))
    return {
        size: max([beam[size], *(2 * abs(pole[place]) + pole[size] for pole in poles)])
        for size, place in sizes
    }


def settle_lifts(opened: Entry, told: dict[int, str], seen_from_ns: int, *, is_newest: bool) -> None:
    """Judge executed lifts by the state of their bundles in a later survey; let offers of those expire.

    told: change or absence by bundle. A lift is verified if its bundle has moved or is gone, and has failed
    if the bundle is where it was.
    """
    for lift in executed_lifts(opened.connection):
        if lift.state != "executed" or lift.executed_ns > seen_from_ns:
            continue
        found = told.get(lift.bundle_id)
        if found in ("moved", "gone"):
            step_lift(opened, lift.lift_id, "verified", f"the next survey: {found}")
        elif found == "same":
            step_lift(opened, lift.lift_id, "failed", "the next survey found it where it lay")
    if not is_newest:
        return
    for lift_id in _claimed(opened):
        step_lift(opened, lift_id, "expired", "a newer map came")
    offers = select(LIFT_STATES.c.lift_id).distinct().where(LIFT_STATES.c.state == "offered")
    closed = select(LIFT_STATES.c.lift_id).where(LIFT_STATES.c.state != "offered")
    rows = opened.connection.execute(
        select(LIFT_BUNDLES.c.lift_id, LIFT_BUNDLES.c.bundle_id)
        .where(LIFT_BUNDLES.c.lift_id.in_(offers), LIFT_BUNDLES.c.lift_id.not_in(closed))
        .order_by(LIFT_BUNDLES.c.lift_id)
    ).all()
    for lift_id in sorted({row.lift_id for row in rows if row.bundle_id in told}):
        step_lift(opened, lift_id, "expired", "a later survey saw its bundles")


def _claimed(opened: Entry) -> list[int]:
    """List the lifts whose last state is `claimed`."""
    later = select(LIFT_STATES.c.lift_id).where(LIFT_STATES.c.step > 2)
    claimed = (
        select(LIFT_STATES.c.lift_id)
        .where(LIFT_STATES.c.state == "claimed", LIFT_STATES.c.lift_id.not_in(later))
        .order_by(LIFT_STATES.c.lift_id)
    )
    return list(opened.connection.execute(claimed).scalars())


def why_outdated(folder: Path, files: str) -> str:
    """Return why the lifts that were stored with a survey aren't those of its folder any more, because lifts
    or other events were told there since; empty if they are, or if the folder can't be seen from here.

    files: of the survey's row.
    """
    digest = json.loads(files).get("lifts.json")
    try:
        if digest is None or not folder.is_dir():
            return ""
        stats = [
            path.stat() if path.exists() else None for path in (folder / "lifts.json", folder / "events.csv")
        ]
    except OSError:
        return ""
    return _compare(folder, digest, tuple(one and (one.st_mtime_ns, one.st_size) for one in stats))


@lru_cache(maxsize=4)
def _compare(folder: Path, digest: str, stats: tuple[tuple[int, int] | None, ...]) -> str:
    """Compare a folder's lifts with the stored ones. stats: of its files, for which the answer holds."""
    chosen = folder / "lifts.json"
    try:
        if stats[0] is None or file_digest(chosen) != digest:
            return f"{chosen} was written anew since, by what happened or for another magnet"
        if stats[1] is not None and unknown_events(read_lifts(chosen), kept_events(folder)):
            return f"{folder / 'events.csv'} has events since"
    except InputError as error:
        return str(error)
    return ""


def find_outlines(
    connection: Connection, lift_id: int, survey_id: int, record: dict[str, Any]
) -> list[Float64]:
    """Compute the corners (4, 2) of the load and the magnet, at pick-up and at set-down.

    record: the lift's JSON in lifts.json.
    """
    query = select(SIGHTINGS.c.record).join(LIFT_BUNDLES, LIFT_BUNDLES.c.bundle_id == SIGHTINGS.c.bundle_id)
    which = LIFT_BUNDLES.c.lift_id == lift_id, SIGHTINGS.c.survey_id == survey_id
    bundles = [bundle_of(json.loads(row)) for row in connection.execute(query.where(*which)).scalars()]
    beam = record.get("beam") or {"width_m": 0.0, "length_m": 0.0}
    lying, outlines = list(bundles), []
    for place in (record["target"], _magnet_down(record)):
        if place is not None:
            centre, yaw = (place["x_m"], place["y_m"]), math.radians(place["yaw_deg"])
            outlines.append(corners(centre, yaw, beam["width_m"], beam["length_m"]))
    if record["set_down"] and bundles:
        place = record["set_down"]
        lying.append(laid_at(tuple(bundles), place["x_m"], place["y_m"], math.radians(place["yaw_deg"])))
    return outlines + [bundle.corners_m for bundle in lying]


def _magnet_down(record: dict[str, Any]) -> dict[str, float] | None:
    """Return where the magnet hangs at set-down, which the load's middle needn't be; the middle where an
    earlier version recorded nothing else, None without a set-down.
    """
    middle: dict[str, float] | None = record["set_down"]
    crane = record.get("crane_set_down")
    if middle is None or crane is None:
        return middle
    if record.get("offset") is not None:
        off = MagnetOffset(**record["offset"]).place_m(math.radians(crane["yaw_deg"]))
        return {**crane, "x_m": crane["x_m"] + float(off[0]), "y_m": crane["y_m"] + float(off[1])}
    target, hung = record["target"], record["crane_target"]  # of an earlier version, or without an offset
    return {**crane, **{name: crane[name] + target[name] - hung[name] for name in ("x_m", "y_m")}}


def find_gap(first: list[Float64], second: list[Float64]) -> float:
    """Find the smallest gap between outlines of two lifts."""
    return float(np.min([gap_between(one, other) for one in first for other in second], initial=math.inf))


def find_beside(connection: Connection, lift_id: int, *, is_reported: bool) -> str | None:
    """Return where a lift's load was taken if it wasn't at its target, else None.

    The magnet must be there whenever it takes something, until it has put a load down elsewhere. is_reported:
    the lift is over, so that it must also have come down there, if it came down anywhere. None also if a load
    was put down that nobody saw taken. Of a lift that never begins this can be told only as it is reported.
    """
    rows = _touches_of(connection, lift_id)
    if not rows:
        return None
    record = lift_record(connection, lift_id)
    is_holding, elsewhere = False, None
    for row in rows:
        is_there = is_at(record, row.x_m, row.y_m)
        if row.kind == "release" and not is_there:
            return None
        if row.kind == "release":
            is_holding = False  # nothing was taken away
        elif row.kind == "grip" and not is_there and not is_holding:
            return _words(record, row)
        elif is_there:
            is_holding, is_reported = is_holding or row.kind != "contact", False
        elif row.kind != "on":
            elsewhere = row
    return _words(record, elsewhere) if is_reported and elsewhere is not None else None


def was_at_target(connection: Connection, lift_id: int) -> bool:
    """Check whether a crane's readings tell that a lift's load was taken at its target."""
    record = lift_record(connection, lift_id)
    return any(
        row.kind != "release" and is_at(record, row.x_m, row.y_m) for row in _touches_of(connection, lift_id)
    )


def is_at(record: dict[str, Any], x_m: float, y_m: float, place: str = "target") -> bool:
    """Check whether a crane's readings lie within the tolerance of a lift's target, or of its set-down."""
    if record[place] is None:
        return False
    off_m, tolerance = off_target(record, x_m, y_m, place), record["tolerance"]
    return all(abs(off_m[k]) <= tolerance[name] + ROUNDING_M for k, name in enumerate(("x_m", "y_m")))


def off_target(record: dict[str, Any], x_m: float, y_m: float, place: str = "target") -> tuple[float, float]:
    """Compute how far a crane's readings (m) are from those at a lift's target or set-down."""
    # Records of an earlier version have no offset between the crane's readings and its magnet.
    wanted = record.get(f"crane_{place}") or record[place]
    return x_m - wanted["x_m"], y_m - wanted["y_m"]


def _words(record: dict[str, Any], row: Row[Any]) -> str:
    off_m = math.hypot(*off_target(record, row.x_m, row.y_m))
    what = "took a load" if row.kind == "grip" else "came down"
    return (
        f"by the crane's readings the magnet {what} at x {row.x_m:.3f}, y {row.y_m:.3f} m, "
        f"{1e3 * off_m:.0f} mm beside the target: see what was moved; the offers near have ended"
    )


def raise_beside(opened: Entry, lift_id: int, beside: str) -> None:
    """Raise the alarm `lift-beside`, once for a lift and place."""
    reason = f"lift {lift_id}: {beside}"
    if not has_alarm(opened.connection, BESIDE, reason):
        raise_alarm(opened, BESIDE, reason)


def lift_record(connection: Connection, lift_id: int) -> dict[str, Any]:
    """Read a lift's record."""
    found: dict[str, Any] = json.loads(
        connection.execute(select(LIFTS.c.record).where(LIFTS.c.id == lift_id)).scalar_one()
    )
    return found


def _touches_of(connection: Connection, lift_id: int) -> Sequence[Row[Any]]:
    """List the touches of a lift; of one that never began also those of its crane since the claim that belong
    to no lift, without the end of what the crane held before.
    """
    which = TOUCHES.c.lift_id == lift_id
    steps = {
        row.state: row
        for row in connection.execute(select(LIFT_STATES).where(LIFT_STATES.c.lift_id == lift_id)).all()
    }
    if "claimed" in steps and "executing" not in steps:
        claim = steps["claimed"]
        own = (TOUCHES.c.who == claim.who) & TOUCHES.c.lift_id.is_(None)
        before = select(TOUCHES.c.kind).where(own, TOUCHES.c.at_ns < claim.at_ns)
        newest = before.order_by(TOUCHES.c.id.desc()).limit(1)
        held = connection.execute(newest).scalar() in ("grip", "on")
        rows = connection.execute(
            select(TOUCHES).where(which | (own & (TOUCHES.c.at_ns >= claim.at_ns))).order_by(TOUCHES.c.id)
        ).all()
        return rows[1:] if held and rows and rows[0].kind == "release" else rows
    return connection.execute(select(TOUCHES).where(which).order_by(TOUCHES.c.id)).all()
