"""Build the page's application: its errors, its static files, and all routes."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import barsight
from barsight.core.errors import BarsightError, ConfigError
from barsight.core.extras import extra
from barsight.page.access import Access, AccessError
from barsight.page.api.changing import add_accounts, add_alarms, add_calibrations, add_lifts
from barsight.page.api.reading import add_files, add_reading, add_targets
from barsight.page.api.sessions import add_sessions
from barsight.page.guard import Guard
from barsight.page.watch import StoreWatch

with extra("page"):
    import asyncio

    from fastapi import FastAPI, Request
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import JSONResponse, Response

STATIC = files("barsight.page") / "static"
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}


def build_app(watch: StoreWatch, hosts: frozenset[str], origins: frozenset[str], *, is_secure: bool) -> Any:
    """Build the ASGI application. is_secure: whether browsers reach it by TLS, for the cookie."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(watch.verify)
        await asyncio.to_thread(watch.judge)
        watch.start(asyncio.get_running_loop())
        yield
        await asyncio.to_thread(watch.stop)

    app = FastAPI(
        title="Barsight", version=barsight.__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    access = Access(lambda: watch.published.accounts)
    _add_errors(app)
    _add_page(app)
    add_sessions(app, access, is_secure=is_secure)
    add_reading(app, watch, access)
    add_files(app, watch, access)
    add_lifts(app, watch, access)
    add_alarms(app, watch, access)
    add_accounts(app, watch, access)
    add_calibrations(app, watch, access)
    add_targets(app, watch, access)
    return Guard(app, hosts, origins)


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

    @app.exception_handler(RequestValidationError)
    async def tell_form(_: Request, error: RequestValidationError) -> JSONResponse:
        """Name the wrong value without repeating it."""
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return JSONResponse({"problem": ascii(f"{place}: {first['msg']}")[1:-1]}, 422)


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
