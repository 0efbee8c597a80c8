"""Build the page's API: what may be read and changed, by whom."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import barsight
from barsight.core.errors import BarsightError, ConfigError
from barsight.core.extras import extra
from barsight.core.json_values import json_value
from barsight.page.access import COOKIE, RIGHTS, SESSION_S, Access, AccessError, Caller, Right, expect_csrf
from barsight.page.documents import bundle_history, bundle_records
from barsight.page.guard import Guard
from barsight.page.layers import Kind, PaintedLayers, find_layers
from barsight.page.model import survey_model
from barsight.page.pictures import paint_bundle
from barsight.page.survey_files import find_file
from barsight.page.targets import Pick, fit_targets, paint_photo, picking_record
from barsight.page.watch import StoreWatch
from barsight.store.accounts import Role, add_person, add_token, withdraw
from barsight.store.audit import Entry, entry
from barsight.store.calibrations import approve_calibration, find_calibration, note_calibration
from barsight.store.confirmation import confirm_lift, end_lift, forbid, take_lift, yard_clock_ns
from barsight.store.history import present_yard, yard_changes
from barsight.store.states import alarm_state, raise_alarm, step_alarm
from barsight.store.stock import Decision, decide, listed_bundles
from barsight.yard.inventory.stock_list import stock_text

with extra("page"):
    import asyncio

    from fastapi import Depends, FastAPI, Request
    from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse
    from pydantic import BaseModel, Field

STATIC = files("barsight.page") / "static"
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}
DOCUMENTS = ("state", "bundles", "lifts", "surveys", "alarms", "stock", "layers", "equipment")
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:"
)
"""Of a survey's own files: a report runs its scripts apart from the page and reaches nothing."""


class LogInForm(BaseModel):
    """Name and password."""

    name: str = Field(max_length=60)
    password: str = Field(max_length=1000)


class ConfirmForm(BaseModel):
    """The map that the operator saw, and the operator's name where the store has no accounts."""

    map_id: str = Field(max_length=64)
    name: str = Field("", max_length=60)


class NoteForm(BaseModel):
    """A sentence for the audit log."""

    note: str = Field("", max_length=1000)


class EndForm(NoteForm):
    """End of a lift that was not taken: `expired` (declined, or taken back) or `failed`."""

    state: str


class AlarmForm(BaseModel):
    """An alarm that a program raises."""

    code: str = Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")
    reason: str = Field(min_length=1, max_length=1000)


class VetoForm(BaseModel):
    """A veto against the newest map, by a code of the reference of codes."""

    code: str
    reason: str = Field(min_length=1, max_length=1000)


class DecisionForm(NoteForm):
    """Decision on one difference of the stock list, by its key."""

    map_id: str
    key: str = Field(max_length=200)
    decision: Decision


class ApprovalForm(NoteForm):
    """A calibration and for how long it is approved, from now on."""

    digest: str = Field(max_length=64)
    until_ns: int | None = None


class PickForm(BaseModel):
    """A target's pick in a survey's map, m. is_exact: take the place itself, no disc beside it."""

    name: str = Field(max_length=200)
    x_m: float
    y_m: float
    is_exact: bool = False


class TargetsForm(BaseModel):
    """A list of surveyed places (CSV), the sigma of a coordinate where it says none, and the picks."""

    listed: str = Field(min_length=1, max_length=200_000)
    sigma_m: float
    picks: list[PickForm] = Field(max_length=1000)


class AccountForm(BaseModel):
    """An account to add or change. password: of a person; a token is drawn for a program."""

    name: str
    kind: str = Field(pattern="^(person|token)$")
    role: Role
    password: str = Field("", max_length=1000)


def build_app(watch: StoreWatch, hosts: frozenset[str], origins: frozenset[str], *, is_secure: bool) -> Any:
    """Build the ASGI application. is_secure: whether browsers reach it by TLS, for the cookie."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(watch.judge, with_chain=True)
        watch.start(asyncio.get_running_loop())
        yield
        await asyncio.to_thread(watch.stop)

    app = FastAPI(
        title="Barsight", version=barsight.__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    access = Access(lambda: watch.published.accounts)
    _add_errors(app)
    _add_page(app)
    _add_session(app, access, is_secure=is_secure)
    _add_reading(app, watch, access)
    _add_files(app, watch, access)
    _add_lifts(app, watch, access)
    _add_alarms(app, watch, access)
    _add_accounts(app, watch, access)
    _add_calibrations(app, watch, access)
    _add_targets(app, watch, access)
    return Guard(app, hosts, origins)


def _need(access: Access, right: Right) -> Any:
    """Make the dependency that finds the caller and checks the right; changes by a browser need its token."""

    async def find(request: Request) -> Caller:
        caller = access.caller(request.headers.get("cookie", ""), request.headers.get("authorization", ""))
        if request.method not in ("GET", "HEAD"):
            expect_csrf(caller, request.headers.get("x-barsight-token", ""))
        if not caller.may(right):
            raise AccessError(403, f"the role {caller.role} may not {right}")
        return caller

    return Depends(find)


def _add_errors(app: FastAPI) -> None:
    @app.exception_handler(BarsightError)
    async def tell(_: Request, error: BarsightError) -> JSONResponse:
        headers = {}
        status = 422 if isinstance(error, ConfigError) else 409
        if isinstance(error, AccessError):
            status = error.status
            if error.wait_s:
                headers["Retry-After"] = str(int(error.wait_s) + 1)
        return JSONResponse({"problem": str(error)}, status, headers)


def _add_page(app: FastAPI) -> None:
    contents = {path.name: path.read_bytes() for path in STATIC.iterdir() if Path(path.name).suffix in _TYPES}

    @app.get("/", include_in_schema=False)
    async def page() -> Response:
        return Response(contents["index.html"], media_type="text/html")

    @app.get("/static/{name}", include_in_schema=False)
    async def static(name: str) -> Response:
        if name not in contents:
            raise AccessError(404, "there is no such file")
        return Response(contents[name], media_type=_TYPES[Path(name).suffix])


def _add_session(app: FastAPI, access: Access, *, is_secure: bool) -> None:
    reader = _need(access, "read")

    def told(caller: Caller) -> dict[str, Any]:
        return {
            "name": caller.name, "role": caller.role, "token": caller.csrf, "rights": RIGHTS[caller.role],
            "version": barsight.__version__,
        }  # fmt: skip

    @app.get("/api/session")
    async def session(caller: Caller = reader) -> dict[str, Any]:
        return told(caller)

    @app.post("/api/session")
    def log_in(form: LogInForm, request: Request, response: Response) -> dict[str, Any]:
        client = request.client.host if request.client else ""
        cookie, caller = access.log_in(form.name, form.password, client)
        response.set_cookie(
            COOKIE, cookie, max_age=int(SESSION_S), httponly=True, samesite="strict", secure=is_secure
        )
        return told(caller)

    @app.delete("/api/session")
    async def log_out(request: Request, response: Response, _: Caller = reader) -> dict[str, str]:
        access.log_out(request.headers.get("cookie", ""))
        response.delete_cookie(COOKIE)
        return {"state": "logged out"}


def _add_reading(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    reader = _need(access, "read")

    def add_document(name: str) -> None:
        async def read(request: Request, _: Caller = reader) -> Response:
            body = watch.published.documents[name]
            tag = f'"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
            if request.headers.get("if-none-match") == tag:
                return Response(status_code=304)
            return Response(
                body, media_type="application/json", headers={"etag": tag, "cache-control": "no-cache"}
            )

        app.add_api_route(f"/api/{name}", read, methods=["GET"], name=name, operation_id=name)

    for name in DOCUMENTS:
        add_document(name)

    @app.get("/api/events")
    async def events(_: Caller = reader) -> StreamingResponse:
        return StreamingResponse(watch.events(), media_type="text/event-stream")

    @app.get("/api/bundles/{name}")
    def bundle(name: str, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            found = bundle_history(connection, identity_number(name))
        if found is None:
            raise AccessError(404, f"there is no bundle {name}")
        return json_value(found)

    @app.get("/api/yard")
    def yard(at_ns: int, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            layers = [one.content() for one in find_layers(connection, at_ns)]
            return json_value(
                {"at_ns": at_ns, "bundles": bundle_records(connection, at_ns), "layers": layers}
            )

    @app.get("/api/stock.csv")
    def stock_list(_: Caller = reader, at_ns: int | None = None) -> Response:
        with watch.store.reading() as connection:
            text = stock_text(listed_bundles(present_yard(connection, at_ns)))
        headers = {"content-disposition": "attachment; filename=stock.csv"}
        return Response(text, media_type="text/csv", headers=headers)

    @app.get("/api/compare")
    def compare(before_ns: int, after_ns: int, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            return json_value({"changes": yard_changes(connection, before_ns, after_ns)})


def _add_files(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    painted = PaintedLayers()
    reader = _need(access, "read")

    @app.get("/api/layers/{map_id}.png")
    def layer(map_id: str, _: Caller = reader, kind: Kind = "photo", at_ns: int | None = None) -> Response:
        layers = watch.published.layers
        if at_ns is not None:
            with watch.store.reading() as connection:
                layers = find_layers(connection, at_ns)
        for one in layers:
            if one.map_id == map_id:
                return Response(painted.paint(one, kind), media_type="image/png")
        raise AccessError(404, f"no place is known best by map {map_id}")

    @app.get("/api/bundles/{name}/pictures/{map_id}.png")
    def picture(name: str, map_id: str, _: Caller = reader) -> Response:
        with watch.store.reading() as connection:
            painted = paint_bundle(connection, identity_number(name), map_id)
        if painted is None:
            raise AccessError(404, f"survey {map_id} has no picture of {name}")
        return Response(painted, media_type="image/png")

    @app.get("/api/surveys/{map_id}/model")
    def model(map_id: str, _: Caller = reader, by: str = "height") -> Response:
        with watch.store.reading() as connection:
            return Response(survey_model(connection, map_id, by), media_type="application/octet-stream")

    @app.get("/api/surveys/{map_id}/files/{name}")
    def survey_file(map_id: str, name: str, _: Caller = reader) -> FileResponse:
        with watch.store.reading() as connection:
            path = find_file(connection, map_id, name)
        return FileResponse(path, headers={"content-security-policy": _SANDBOX})

    @app.get("/api/health")
    async def health(_: Caller = reader) -> Any:
        found = watch.health
        return json_value(
            {
                "store": watch.store.name, "revision": watch.published.revision, "problem": watch.problem,
                "live": None if found is None else {"content": found.content, "age_s": found.age_s},
                "trend": [] if watch.live is None else list(watch.live.history),
            }
        )  # fmt: skip


def _add_lifts(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    operate, execute, report = (_need(access, right) for right in ("operate", "execute", "report"))

    def done(change: Callable[[], None]) -> dict[str, int]:
        change()
        watch.refresh()
        return {"revision": watch.published.revision}

    @app.post("/api/lifts/{lift_id}/confirm")
    def confirm(lift_id: int, form: ConfirmForm, caller: Caller = operate) -> dict[str, int]:
        who = signature(caller, form.name)
        watch.judge()
        return done(lambda: confirm_lift(watch.store, lift_id, form.map_id, who))

    @app.post("/api/lifts/{lift_id}/taken")
    def taken(lift_id: int, caller: Caller = execute) -> dict[str, int]:
        return done(lambda: take_lift(watch.store, lift_id, signature(caller)))

    @app.post("/api/lifts/{lift_id}/end")
    def end(lift_id: int, form: EndForm, caller: Caller = execute) -> dict[str, int]:
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


def identity_number(name: str) -> int:
    """Read a bundle's number from its name; 0, which none has, where it is no name."""
    return int(name[1:]) if name[:1] == "B" and name[1:].isdigit() and len(name) < 10 else 0


def signature(caller: Caller, name: str = "") -> str:
    """Name the caller for the audit log; who has no account says a name."""
    if caller.csrf is not None and caller.name == "local" and name.strip():
        return f"{name.strip()} (no account)"
    return f"{caller.name} ({caller.role})"


def _add_alarms(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    operate, report = _need(access, "operate"), _need(access, "report")

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
    def acknowledge(alarm_id: int, form: NoteForm, caller: Caller = operate) -> dict[str, int]:
        def act(opened: Entry) -> None:
            is_returned = alarm_state(opened.connection, alarm_id) == "returned"
            step_alarm(opened, alarm_id, "cleared" if is_returned else "acknowledged", form.note or None)

        return change(signature(caller), f"alarm {alarm_id} acknowledged", act)

    @app.post("/api/alarms/{alarm_id}/clear")
    def clear(alarm_id: int, form: NoteForm, caller: Caller = report) -> dict[str, int]:
        return change(
            signature(caller), f"alarm {alarm_id} cleared",
            lambda opened: step_alarm(opened, alarm_id, "cleared", form.note or None),
        )  # fmt: skip


def _add_accounts(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    engineer = _need(access, "administer")

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


def _add_calibrations(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    engineer = _need(access, "administer")

    @app.post("/api/calibrations")
    def approve(form: ApprovalForm, caller: Caller = engineer) -> dict[str, int]:
        who = signature(caller)
        with entry(watch.store, who, f"calibration {form.digest} approved") as opened:
            note_calibration(opened, find_calibration(opened.connection, form.digest))
            clock_ns = yard_clock_ns(opened.connection)
            approve_calibration(opened, form.digest, clock_ns, form.until_ns, form.note)
        watch.judge()
        return {"revision": watch.published.revision}


def _add_targets(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    reader, engineer = _need(access, "read"), _need(access, "administer")

    @app.get("/api/surveys/{map_id}/targets")
    def grid(map_id: str, _: Caller = engineer) -> Any:
        with watch.store.reading() as connection:
            return json_value(picking_record(connection, map_id))

    @app.get("/api/surveys/{map_id}/photo.png")
    def photo(map_id: str, left: int, right: int, low: int, high: int, _: Caller = reader) -> Response:
        with watch.store.reading() as connection:
            painted = paint_photo(connection, map_id, (left, right), (low, high))
        return Response(painted, media_type="image/png")

    @app.post("/api/surveys/{map_id}/targets")
    def fit(map_id: str, form: TargetsForm, _: Caller = engineer) -> Any:
        picks = [Pick(one.name, one.x_m, one.y_m, one.is_exact) for one in form.picks]
        with watch.store.reading() as connection:
            return json_value(fit_targets(connection, map_id, form.listed, form.sigma_m, picks))
