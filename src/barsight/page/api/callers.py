"""Identify the callers of the page's API, check their rights, and name them in the audit log."""

from __future__ import annotations

from typing import Any

from barsight.core.extras import extra
from barsight.page.access import LOCAL, Access, AccessError, Caller, Right, expect_csrf

with extra("page"):
    from fastapi import Depends, Request


def need(access: Access, right: Right) -> Any:
    """Make the dependency that identifies the caller and checks the right; browsers' changes need the
    token.
    """

    async def find(request: Request) -> Caller:
        caller = access.caller(*_credentials(request))
        if request.method not in ("GET", "HEAD"):
            expect_csrf(caller, request.headers.get("x-barsight-token", ""))
        if not caller.may(right):
            raise AccessError(403, f"the role {caller.role} may not {right}")
        return caller

    return Depends(find)


def is_known(access: Access, request: Request) -> bool:
    """Check whether the caller of a request that still lasts would be known now."""
    try:
        access.caller(*_credentials(request), is_request=False)
    except AccessError:
        return False
    return True


def _credentials(request: Request) -> tuple[str, str]:
    return request.headers.get("cookie", ""), request.headers.get("authorization", "")


def signature(caller: Caller, name: str = "") -> str:
    """Name the caller for the audit log; a caller without an account gives a name."""
    if caller.csrf is not None and caller.name == LOCAL and name.strip():
        return f"{name.strip()} (no account)"
    return f"{caller.name} ({caller.role})"
