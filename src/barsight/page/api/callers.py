"""Find who calls the page's API, check the right to it, and name the caller in the audit log."""

from __future__ import annotations

from typing import Any

from barsight.core.extras import extra
from barsight.page.access import Access, AccessError, Caller, Right, expect_csrf

with extra("page"):
    from fastapi import Depends, Request


def need(access: Access, right: Right) -> Any:
    """Make the dependency that finds the caller and checks the right; changes by a browser need its token."""

    async def find(request: Request) -> Caller:
        caller = access.caller(request.headers.get("cookie", ""), request.headers.get("authorization", ""))
        if request.method not in ("GET", "HEAD"):
            expect_csrf(caller, request.headers.get("x-barsight-token", ""))
        if not caller.may(right):
            raise AccessError(403, f"the role {caller.role} may not {right}")
        return caller

    return Depends(find)


def signature(caller: Caller, name: str = "") -> str:
    """Name the caller for the audit log; who has no account says a name."""
    if caller.csrf is not None and caller.name == "local" and name.strip():
        return f"{name.strip()} (no account)"
    return f"{caller.name} ({caller.role})"
