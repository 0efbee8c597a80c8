"""Build the routes that change the store: lifts, alarms, accounts, calibrations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from barsight.core.extras import extra
from barsight.page.access import Access, Caller
from barsight.page.api.callers import need, signature
from barsight.page.api.forms import (
    AccountForm,
    AlarmForm,
    ApprovalForm,
    ConfirmForm,
    DecisionForm,
    EndForm,
    NoteForm,
    Number,
    VetoForm,
)
from barsight.page.watch import StoreWatch
from barsight.store.accounts import add_person, add_token, withdraw
from barsight.store.audit import Entry, entry
from barsight.store.calibrations import approve_calibration, find_calibration, note_calibration
from barsight.store.confirmation import confirm_lift, end_lift, forbid, take_lift, yard_clock_ns
from barsight.store.states import acknowledge_alarm, raise_alarm, step_alarm
from barsight.store.stock import decide

with extra("page"):
    from fastapi import FastAPI


def add_lifts(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes for confirmation and end of lifts, vetoes, and decisions on the stock list."""
    operate, execute, report = (need(access, right) for right in ("operate", "execute", "report"))

    def done(change: Callable[[], None]) -> dict[str, int]:
        change()
        watch.refresh()
        return {"revision": watch.published.revision}

    @app.post("/api/lifts/{lift_id}/confirm")
    def confirm(lift_id: Number, form: ConfirmForm, caller: Caller = operate) -> dict[str, int]:
        who = signature(caller, form.name)
        watch.judge()
        return done(lambda: confirm_lift(watch.store, lift_id, form.map_id, who))

    @app.post("/api/lifts/{lift_id}/taken")
    def taken(lift_id: Number, caller: Caller = execute) -> dict[str, int]:
        return done(lambda: take_lift(watch.store, lift_id, signature(caller)))

    @app.post("/api/lifts/{lift_id}/end")
    def end(lift_id: Number, form: EndForm, caller: Caller = execute) -> dict[str, int]:
        return done(lambda: end_lift(watch.store, lift_id, form.state, signature(caller), form.note))

    @app.post("/api/vetoes")
    def veto(form: VetoForm, caller: Caller = report) -> dict[str, int]:
        return done(lambda: forbid(watch.store, form.code, form.reason, signature(caller)))

    @app.post("/api/stock")
    def stock(form: DecisionForm, caller: Caller = operate) -> dict[str, int]:
        def add() -> None:
            with entry(watch.store, signature(caller), f"stock {form.key}") as opened:
                decide(opened, form.map_id, form.key, form.decision, form.note)

        return done(add)


def add_alarms(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes to raise, acknowledge and clear alarms."""
    operate, report = need(access, "operate"), need(access, "report")

    def change(who: str, what: str, act: Callable[[Entry], object]) -> dict[str, int]:
        with entry(watch.store, who, what) as opened:
            act(opened)
        watch.refresh()
        return {"revision": watch.published.revision}

    @app.post("/api/alarms")
    def raise_one(form: AlarmForm, caller: Caller = report) -> dict[str, int]:
        return change(
            signature(caller),
            f"alarm {form.code}",
            lambda opened: raise_alarm(opened, form.code, form.reason),
        )

    @app.post("/api/alarms/{alarm_id}/acknowledge")
    def acknowledge(alarm_id: Number, form: NoteForm, caller: Caller = operate) -> dict[str, int]:
        return change(
            signature(caller), f"alarm {alarm_id} acknowledged",
            lambda opened: acknowledge_alarm(opened, alarm_id, form.note or None),
        )  # fmt: skip

    @app.post("/api/alarms/{alarm_id}/clear")
    def clear(alarm_id: Number, form: NoteForm, caller: Caller = report) -> dict[str, int]:
        return change(
            signature(caller), f"alarm {alarm_id} cleared",
            lambda opened: step_alarm(opened, alarm_id, "cleared", form.note or None),
        )  # fmt: skip


def add_accounts(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes to list, add and withdraw accounts."""
    engineer = need(access, "administer")

    @app.get("/api/accounts")
    async def accounts(_: Caller = engineer) -> dict[str, Any]:
        known = sorted(watch.published.accounts.values(), key=lambda one: one.name)
        return {"accounts": [{"name": one.name, "kind": one.kind, "role": one.role} for one in known]}

    @app.post("/api/accounts")
    def add(form: AccountForm, caller: Caller = engineer) -> dict[str, str | None]:
        token = None
        with entry(watch.store, signature(caller), f"account {form.name}") as opened:
            if form.kind == "token":
                token = add_token(opened, form.name, form.role)
            else:
                add_person(opened, form.name, form.role, form.password)
        watch.refresh()
        return {"token": token}

    @app.delete("/api/accounts/{name}")
    def remove(name: str, caller: Caller = engineer) -> dict[str, str]:
        with entry(watch.store, signature(caller), f"account {name} withdrawn") as opened:
            withdraw(opened, name)
        watch.refresh()
        return {"state": "withdrawn"}


def add_calibrations(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the route to approve a calibration."""
    engineer = need(access, "administer")

    @app.post("/api/calibrations")
    def approve(form: ApprovalForm, caller: Caller = engineer) -> dict[str, int]:
        who = signature(caller)
        with entry(watch.store, who, f"calibration {form.digest} approved") as opened:
            note_calibration(opened, find_calibration(opened.connection, form.digest))
            clock_ns = yard_clock_ns(opened.connection)
            approve_calibration(opened, form.digest, clock_ns, form.until_ns, form.note)
        watch.judge()
        return {"revision": watch.published.revision}
