"""Log in and out of the page, and report who is logged in."""

from __future__ import annotations

from typing import Any

import barsight
from barsight.core.extras import extra
from barsight.page.access import COOKIE, RIGHTS, SESSION_S, Access, Caller
from barsight.page.api.callers import need
from barsight.page.api.forms import LogInForm

with extra("page"):
    from fastapi import FastAPI, Request
    from fastapi.responses import Response


def add_sessions(app: FastAPI, access: Access, *, is_secure: bool) -> None:
    """Add the routes of a session. is_secure: whether browsers reach the page by TLS, for the cookie."""
    reader = need(access, "read")

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
