"""Take a lift from offered to executed or failed by what the crane reports, in the store's own states."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from barsight.core.errors import BarsightError, Failed
from barsight.core.extras import extra
from barsight.plant.state import OfferedLift
from barsight.store.audit import entry
from barsight.store.confirmation import confirm_lift, end_lift, take_lift, yard_clock_ns
from barsight.store.opening import Store
from barsight.store.states import raise_alarm
from barsight.store.tables import LIFT_STATES

with extra("store"):
    from sqlalchemy import select

LOAD_SIGMAS = 3.0
"""A load farther from the mass than so many of its standard deviations contradicts it."""


@dataclass(frozen=True)
class LiftClaim:
    """A claim. token: 32 bits that its later steps carry; it tells claims apart and is no secret."""

    lift_id: int
    who: str
    token: int


def claim_lift(store: Store, lift: OfferedLift, who: str) -> LiftClaim | Failed:
    """LiftClaim an offered lift. The same claim again returns the same token; another's is refused."""
    found = claim_of(store, lift.lift_id)
    if found is not None:
        return found if found.who == who else Failed("claimed", f"lift {lift.lift_id} is {found.who}'s")
    try:
        confirm_lift(store, lift.lift_id, lift.map_id, who)
    except BarsightError as error:
        return Failed("refused", str(error))
    return claim_of(store, lift.lift_id) or Failed("refused", f"lift {lift.lift_id} ended meanwhile")


def claim_of(store: Store, lift_id: int) -> LiftClaim | None:
    """Find the claim that a lift stands in; None where its last state is another."""
    with store.reading() as connection:
        row = connection.execute(
            select(LIFT_STATES)
            .where(LIFT_STATES.c.lift_id == lift_id)
            .order_by(LIFT_STATES.c.step.desc())
            .limit(1)
        ).first()
    if row is None or row.state != "claimed":
        return None
    digest = hashlib.sha256(f"{lift_id} {row.who} {row.at_ns}".encode()).digest()
    return LiftClaim(lift_id, row.who, int.from_bytes(digest[:4], "big") or 1)


def report_executed(store: Store, claim: LiftClaim, lift: OfferedLift, load_kg: float | None) -> str | Failed:
    """Report a claimed lift as executed: `confirmed`, `contradicted` by the load cell, or `unweighed`.

    A contradiction raises the alarm `load-contradicts`; the next survey tells what truly moved.
    """
    if claim_of(store, claim.lift_id) != claim:
        return Failed("token", f"lift {claim.lift_id} isn't claimed with this token")
    try:
        take_lift(store, claim.lift_id, claim.who)
    except BarsightError as error:
        told = (
            f"lift {claim.lift_id} was executed and can't be recorded ({error}): survey before the next lift"
        )
        _raise(store, claim.who, "lift-unrecorded", told)
        return Failed("refused", str(error))
    if load_kg is None:
        return "unweighed"
    if abs(load_kg - lift.mass_kg) <= LOAD_SIGMAS * lift.mass_sigma_kg:
        return "confirmed"
    told = f"lift {claim.lift_id}: {load_kg:.0f} kg were weighed, {lift.mass_kg:.0f} kg were told"
    _raise(store, claim.who, "load-contradicts", told)
    return "contradicted"


def _raise(store: Store, who: str, code: str, told: str) -> None:
    """Raise an alarm in the store, at the yard's clock."""
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
    with entry(store, who, code, clock_ns) as opened:
        raise_alarm(opened, code, told)


def report_failed(store: Store, claim: LiftClaim, note: str) -> str | Failed:
    """Report that a claimed lift failed."""
    if claim_of(store, claim.lift_id) != claim:
        return Failed("token", f"lift {claim.lift_id} isn't claimed with this token")
    try:
        end_lift(store, claim.lift_id, "failed", claim.who, note)
    except BarsightError as error:
        return Failed("refused", str(error))
    return "failed"
