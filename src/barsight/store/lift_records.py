"""Store a survey's lifts and vetoes, settle the lifts that were offered or executed before it, notice when
those in its folder are others, and compute the outlines of what a lift may have moved.
"""

from __future__ import annotations

import json
import math
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
from barsight.store.states import step_lift
from barsight.store.tables import LIFT_BUNDLES, LIFT_STATES, LIFTS, SIGHTINGS, SURVEY_VETOES
from barsight.yard.axes import corners, gap_between
from barsight.yard.events import kept_events
from barsight.yard.inventory.bundle_file import bundle_of
from barsight.yard.lifting.lift_file import read_lifts, unknown_events
from barsight.yard.lifting.load import laid_at

with extra("store"):
    from sqlalchemy import Connection, select


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
    target, hung = record["target"], record["crane_target"]
    off = {name: target[name] - hung[name] for name in ("x_m", "y_m")}
    return {**crane, "x_m": crane["x_m"] + off["x_m"], "y_m": crane["y_m"] + off["y_m"]}


def find_gap(first: list[Float64], second: list[Float64]) -> float:
    """Find the smallest gap between outlines of two lifts."""
    return float(np.min([gap_between(one, other) for one in first for other in second], initial=math.inf))
