"""Take a lift from offered to executed or failed as the crane reports it, using the states of the store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass

from barsight.core.errors import BarsightError, Failed, InputError
from barsight.core.extras import extra
from barsight.plant.state import OfferedLift
from barsight.store.audit import entry
from barsight.store.confirmation import (
    BesideError,
    LateReportError,
    begin_lift,
    confirm_lift,
    end_lift,
    open_lifts,
    take_lift,
    yard_clock_ns,
)  # fmt: skip
from barsight.store.lift_records import was_at_target
from barsight.store.opening import Store
from barsight.store.states import step_lift
from barsight.store.tables import LIFT_STATES, LIFTS, MAX_ID

with extra("store"):
    from sqlalchemy import Connection, Row, select

LOAD_SIGMAS = 3.0
"""Largest difference between the weighed load and the predicted mass, in standard deviations of that mass;
a larger one contradicts the prediction.
"""
MAX_CLAIMS = 1000
"""Number of newest claims that are searched for a token given without its lift."""


@dataclass(frozen=True)
class LiftClaim:
    """A crane's claim on a lift.

    token: 32-bit number that the later steps carry; it identifies the claim and is not a secret.
    """

    lift_id: int
    who: str
    token: int


def claim_lift(store: Store, lift: OfferedLift, who: str) -> LiftClaim | Failed:
    """Claim an offered lift. The same claim again returns the same token; anyone else's is refused."""
    found = claim_of(store, lift.lift_id)
    if found is None:
        try:
            confirm_lift(store, lift.lift_id, lift.map_id, who)
        except InputError as error:
            return Failed("refused", str(error))
        found = claim_of(store, lift.lift_id)
    if found is None or states_of(store, lift.lift_id)[-1] not in ("claimed", "executing"):
        return Failed("refused", f"lift {lift.lift_id} ended meanwhile")
    return found if found.who == who else Failed("claimed", f"lift {lift.lift_id} is {found.who}'s")


def claim_of(store: Store, lift_id: int) -> LiftClaim | None:
    """Find the claim of a lift, whatever state followed it; a lift is claimed only once."""
    if lift_id > MAX_ID:
        return None
    with store.reading() as connection:
        query = select(LIFT_STATES).where(LIFT_STATES.c.lift_id == lift_id, LIFT_STATES.c.state == "claimed")
        row = connection.execute(query).first()
    return None if row is None else _claim(row)


def claim_by_token(store: Store, token: int) -> LiftClaim | None:
    """Find a claim by its token alone, among the newest `MAX_CLAIMS`."""
    newest = select(LIFT_STATES).where(LIFT_STATES.c.state == "claimed").order_by(LIFT_STATES.c.id.desc())
    with store.reading() as connection:
        rows = connection.execute(newest.limit(MAX_CLAIMS)).all()
    return next((found for row in rows if (found := _claim(row)).token == token), None)


def _claim(row: Row[tuple[object, ...]]) -> LiftClaim:
    digest = hashlib.sha256(f"{row.lift_id} {row.who} {row.at_ns}".encode()).digest()
    return LiftClaim(row.lift_id, row.who, int.from_bytes(digest[:4], "big") or 1)


def states_of(store: Store, lift_id: int) -> list[str]:
    """List the states that a lift has been in, the current one last."""
    steps = select(LIFT_STATES.c.state).where(LIFT_STATES.c.lift_id == lift_id).order_by(LIFT_STATES.c.step)
    with store.reading() as connection:
        return list(connection.execute(steps).scalars())


def begin_claimed(store: Store, claim: LiftClaim) -> LiftClaim | Failed:
    """Begin a claimed lift, once only: a crane that lost track of it must not lift again."""
    try:
        begin_lift(store, claim.lift_id, claim.who)
    except InputError as error:
        return Failed("refused", str(error))
    return claim


def report_executed(store: Store, claim: LiftClaim, load_kg: float | None) -> str | Failed:
    """Report a claimed lift as executed: `confirmed`, `contradicted` by the load cell, or `unweighed`.

    A contradiction raises the alarm `load-contradicts`; the next survey shows what was really moved. A lift
    that the crane's own readings place beside its target is recorded as failed and the report refused. A
    repeated report gets the same answer and changes nothing. A lift that has already ended in another way
    can't be recorded: this raises the alarm `lift-unrecorded` and withdraws all offers. Raises BarsightError
    if the store can't be written; the report must then be repeated.
    """
    with store.reading() as connection:
        query = select(LIFTS.c.record).where(LIFTS.c.id == claim.lift_id)
        record = json.loads(connection.execute(query).scalar_one())
    verdict, alarm = "unweighed", None
    if load_kg is not None:
        verdict = "confirmed"
        if abs(load_kg - record["mass_kg"]) > LOAD_SIGMAS * record["mass_sigma_kg"]:
            weighed = f"{load_kg:.0f} kg were weighed, {record['mass_kg']:.0f} kg were stated"
            verdict, alarm = "contradicted", ("load-contradicts", f"lift {claim.lift_id}: {weighed}")
    if "executed" in states_of(store, claim.lift_id):
        return verdict
    with store.reading() as connection:
        is_known = was_at_target(connection, claim.lift_id)
    place = "at its target, by the crane's readings" if is_known else "no reading of the crane told where"
    try:
        take_lift(store, claim.lift_id, claim.who, alarm, place)
    except BesideError as error:
        return Failed("beside", str(error))
    except LateReportError as error:
        return Failed("refused", str(error))
    return verdict


def report_failed(store: Store, claim: LiftClaim, note: str) -> str | Failed:
    """Report that a claimed lift failed; a repeated report changes nothing."""
    states = states_of(store, claim.lift_id)
    if states[-1] == "failed" and "executed" not in states:
        return "failed"
    try:
        end_lift(store, claim.lift_id, "failed", claim.who, note, tells_begin=True)
    except BarsightError as error:
        if states_of(store, claim.lift_id)[-1] in ("claimed", "executing"):
            raise
        return Failed("refused", str(error))
    return "failed"


def expire_claims(store: Store, who: str, claim_s: float, is_of: Callable[[str], bool]) -> int:
    """End overdue claims by those for whose names `is_of` returns True; return their number."""
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
        before_ns = clock_ns - round(claim_s * 1e9)
        if not _overdue(connection, before_ns, is_of):
            return 0
    with entry(store, who, "claims expired", clock_ns) as opened:
        overdue = _overdue(opened.connection, before_ns, is_of)
        for lift_id in overdue:
            step_lift(opened, lift_id, "expired", f"it was claimed and not begun within {claim_s:g} s")
    return len(overdue)


def _overdue(connection: Connection, before_ns: int, is_of: Callable[[str], bool]) -> list[int]:
    claimed = [lift.lift_id for lift in open_lifts(connection) if lift.state == "claimed"]
    rows = connection.execute(
        select(LIFT_STATES).where(LIFT_STATES.c.lift_id.in_(claimed), LIFT_STATES.c.state == "claimed")
    ).all()
    return [row.lift_id for row in rows if row.at_ns < before_ns and is_of(row.who)]
