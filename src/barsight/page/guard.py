"""Refuse requests from other pages in the same browser, and restrict browsers by response headers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
MAX_BODY_BYTES = 1 << 20
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-store",
    b"content-security-policy": POLICY.encode(),
}


class Guard:
    """ASGI middleware that passes only requests that name one of `hosts` and come from one of `origins` or
    from no page at all.
    """

    def __init__(self, app: Any, hosts: frozenset[str], origins: frozenset[str]) -> None:
        self._app, self._hosts, self._origins = app, hosts, origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse or pass on; add our headers to the answer unless it has its own."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                given = list(message.get("headers", []))
                names = {name.lower() for name, _ in given}
                given += [(name, value) for name, value in _HEADERS.items() if name not in names]
                message["headers"] = given
            await send(message)

        problem = self._problem(scope)
        if problem is None:
            await self._app(scope, receive, send_with_headers)
            return
        headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
        await send_with_headers({"type": "http.response.start", "status": 403, "headers": headers})
        await send({"type": "http.response.body", "body": f"{problem}\n".encode()})

    def _problem(self, scope: Scope) -> str | None:
        def given(name: bytes) -> list[str]:
            return [value.decode("latin-1").lower() for key, value in scope["headers"] if key == name]

        if len(hosts := given(b"host")) != 1 or hosts[0] not in self._hosts:
            return "this server is not called that"
        if not set(given(b"origin")) <= self._origins:
            return "another page's request is refused"
        if "\0" in scope["path"]:
            return "no name has the character NUL"  # which PostgreSQL doesn't take
        lengths = given(b"content-length")
        if lengths and not (lengths[0].isdigit() and int(lengths[0]) <= MAX_BODY_BYTES):
            return "the request is too long"
        if scope["method"] not in ("GET", "HEAD") and given(b"transfer-encoding"):
            return "a request's length must be said"
        return None
