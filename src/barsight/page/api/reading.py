"""Build the read-only routes: documents, pictures, files, fits of surveyed places."""

from __future__ import annotations

import hashlib
from typing import Any

from barsight.core.extras import extra
from barsight.core.json_values import json_value
from barsight.page.access import Access, AccessError, Caller
from barsight.page.api.callers import is_known, need
from barsight.page.api.forms import Stamp, TargetsForm
from barsight.page.documents import bundle_history, bundle_records
from barsight.page.layers import Kind, PaintedLayers, find_layers
from barsight.page.model import survey_model
from barsight.page.pictures import paint_bundle
from barsight.page.survey_files import find_file
from barsight.page.targets import Pick, fit_targets, paint_photo, picking_record
from barsight.page.watch import StoreWatch
from barsight.store.history import present_yard, yard_changes
from barsight.store.stock import listed_bundles
from barsight.yard.inventory.stock_list import stock_text

with extra("page"):
    from fastapi import FastAPI, Request
    from fastapi.responses import FileResponse, Response, StreamingResponse

DOCUMENTS = ("state", "bundles", "lifts", "surveys", "alarms", "stock", "layers", "equipment")
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:"
)
"""Content security policy of a survey's own files: a report runs its scripts isolated and can reach
nothing.
"""


def add_reading(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes for the documents on yard and store, including events and the yard at a past time."""
    reader = need(access, "read")

    def add_document(name: str) -> None:
        async def read(request: Request, _: Caller = reader) -> Response:
            body = watch.published.document(name)
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
    async def events(request: Request, _: Caller = reader) -> StreamingResponse:
        return StreamingResponse(
            watch.events(lambda: is_known(access, request)), media_type="text/event-stream"
        )

    @app.get("/api/bundles/{name}")
    def bundle(name: str, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            found = bundle_history(connection, identity_number(name))
        if found is None:
            raise AccessError(404, f"there is no bundle {name}")
        return json_value(found)

    @app.get("/api/yard")
    def yard(at_ns: Stamp, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            layers = [one.content() for one in find_layers(connection, at_ns)]
            return json_value(
                {"at_ns": at_ns, "bundles": bundle_records(connection, at_ns), "layers": layers}
            )

    @app.get("/api/stock.csv")
    def stock_list(_: Caller = reader, at_ns: Stamp | None = None) -> Response:
        with watch.store.reading() as connection:
            text = stock_text(listed_bundles(present_yard(connection, at_ns)))
        headers = {"content-disposition": "attachment; filename=stock.csv"}
        return Response(text, media_type="text/csv", headers=headers)

    @app.get("/api/compare")
    def compare(before_ns: Stamp, after_ns: Stamp, _: Caller = reader) -> Any:
        with watch.store.reading() as connection:
            return json_value({"changes": yard_changes(connection, before_ns, after_ns)})


def add_files(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes for layers, pictures, models and files of surveys, and for the health of a live run."""
    painted = PaintedLayers()
    reader = need(access, "read")

    @app.get("/api/layers/{map_id}.png")
    def layer(map_id: str, _: Caller = reader, kind: Kind = "photo", at_ns: Stamp | None = None) -> Response:
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


def add_targets(app: FastAPI, watch: StoreWatch, access: Access) -> None:
    """Add the routes to pick surveyed places in a survey's grid and photo, and to fit the yard frame."""
    reader, engineer = need(access, "read"), need(access, "administer")

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


def identity_number(name: str) -> int:
    """Read a bundle's number from its name; 0, which no bundle has, for an invalid name."""
    return (
        int(name[1:]) if name[:1] == "B" and name[1:].isdigit() and name.isascii() and len(name) < 10 else 0
    )
