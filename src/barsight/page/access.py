"""Identify callers by cookie, token or the loopback, and define the rights of each role."""

from __future__ import annotations

import hmac
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Literal

from barsight.core.errors import BarsightError
from barsight.store.accounts import Account, Role, is_password, token_digest

COOKIE = "barsight_session"
SESSION_S, IDLE_S = 12 * 3600.0, 2 * 3600.0
"""Time after which a log-in ends, and the same without a request."""
MAX_SESSIONS = 200
"""Maximum number of log-ins; the oldest one gives way."""
FREE_TRIES, MAX_WAIT_S = 5, 300.0
"""Number of failed log-ins from which on a wait follows, and the longest wait."""
MAX_THROTTLED = 10_000
"""Maximum number of names and clients whose failures are remembered."""
LOCAL = "local"
"""Name of the user at this computer if the store has no accounts."""

Right = Literal["read", "operate", "report", "administer", "execute"]
RIGHTS: dict[Role, tuple[Right, ...]] = {
    "viewer": ("read",),
    "operator": ("read", "operate", "execute"),
    "engineer": ("read", "operate", "execute", "report", "administer"),
    "service": ("read", "execute", "report"),
}
"""Rights of each role. operate: confirm and decline lifts, acknowledge alarms, decide on stock. execute:
report lifts as taken or failed. report: raise and clear alarms, forbid lifts.
"""


class AccessError(BarsightError):
    """A refused request. status: HTTP status. wait_s: time after which it may be tried again."""

    def __init__(self, status: int, problem: str, wait_s: float = 0.0) -> None:
        self.status, self.wait_s = status, wait_s
        super().__init__(problem)


@dataclass(frozen=True)
class Caller:
    """A person or program that makes a request.

    csrf: token that a change must carry; None for a program's token, which no browser adds.
    """

    name: str
    role: Role
    csrf: str | None

    def may(self, right: Right) -> bool:
        """Check whether the role has a right."""
        return right in RIGHTS[self.role]


@dataclass
class _LogIn:
    name: str
    secret: str
    csrf: str
    began_s: float
    seen_s: float


@dataclass
class Throttle:
    """Counts failed log-ins by key; after FREE_TRIES, each failure doubles the waiting time."""

    clock: Callable[[], float] = time.monotonic
    _failed: dict[str, tuple[int, float]] = field(default_factory=dict)

    def expect_free(self, *keys: str) -> None:
        """Raise AccessError while one of the keys has to wait."""
        wait_s = max(self._failed.get(key, (0, 0.0))[1] - self.clock() for key in keys)
        if wait_s > 0:
            raise AccessError(429, f"too many failed log-ins; wait {wait_s:.0f} s", wait_s)

    def fail(self, *keys: str) -> None:
        """Count a failed log-in."""
        for key in keys:
            count = self._failed.pop(key, (0, 0.0))[0] + 1
            wait_s = min(2.0 ** (count - FREE_TRIES), MAX_WAIT_S) if count >= FREE_TRIES else 0.0
            self._failed[key] = (count, self.clock() + wait_s)
        while len(self._failed) > MAX_THROTTLED:
            self._failed.pop(next(iter(self._failed)))

    def clear(self, *keys: str) -> None:
        """Clear the failures after a successful log-in."""
        for key in keys:
            self._failed.pop(key, None)


class Access:
    """Log-ins of one running server; they end with it. accounts: returns the store's current ones by name."""

    def __init__(
        self, accounts: Callable[[], dict[str, Account]], clock: Callable[[], float] = time.monotonic
    ):
        self._accounts = accounts
        self._clock = clock
        self._sessions: dict[str, _LogIn] = {}
        self._throttle = Throttle(clock)
        self._one_at_a_time = threading.Lock()
        self._local_csrf = secrets.token_urlsafe(24)

    def log_in(self, name: str, password: str, client: str) -> tuple[str, Caller]:
        """Check a password; return the cookie's value and the caller. Raises AccessError."""
        keys = (f"name {name[:60]}", f"client {client}")
        with self._one_at_a_time:  # scrypt takes 32 MiB, so no parallel calls
            self._throttle.expect_free(*keys)
            account = self._accounts().get(name)
            if not is_password(account, password) or account is None:
                self._throttle.fail(*keys)
                raise AccessError(401, "name or password is wrong")
            self._throttle.clear(*keys)
            cookie, now_s = secrets.token_urlsafe(32), self._clock()
            csrf = secrets.token_urlsafe(24)
            while len(self._sessions) >= MAX_SESSIONS:
                self._sessions.pop(next(iter(self._sessions)))
            self._sessions[token_digest(cookie)] = _LogIn(name, account.secret, csrf, now_s, now_s)
        return cookie, Caller(account.name, account.role, csrf)

    def log_out(self, cookies: str) -> None:
        """End a log-in."""
        self._sessions.pop(token_digest(_cookie(cookies)), None)

    def caller(self, cookies: str, authorization: str, *, is_request: bool = True) -> Caller:
        """Identify the caller. Raises AccessError (401) for an unknown one.

        is_request: whether to count it as a request, which a log-in needs now and then.
        """
        accounts = self._accounts()
        if authorization:
            scheme, _, token = authorization.partition(" ")
            found = token_digest(token.strip())
            for one in accounts.values():
                if (
                    scheme.lower() == "bearer"
                    and one.kind == "token"
                    and hmac.compare_digest(one.secret, found)
                ):
                    return Caller(one.name, one.role, None)
            raise AccessError(401, "the token is not known")
        if not accounts:
            return Caller(LOCAL, "engineer", self._local_csrf)
        key = token_digest(_cookie(cookies))
        known, now_s = self._sessions.get(key), self._clock()
        account = accounts.get(known.name) if known else None
        if known is None or account is None or account.secret != known.secret:
            raise AccessError(401, "log in first")
        if now_s - known.began_s > SESSION_S or now_s - known.seen_s > IDLE_S:
            self._sessions.pop(key, None)
            raise AccessError(401, "the log-in has ended; log in again")
        known.seen_s = now_s if is_request else known.seen_s
        return Caller(account.name, account.role, known.csrf)


def expect_csrf(caller: Caller, given: str) -> None:
    """Raise AccessError if a change by a browser lacks its token."""
    if caller.csrf is not None and not hmac.compare_digest(caller.csrf.encode(), given.encode()):
        raise AccessError(403, "the request lacks the page's token: load the page again")


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        found = None
    return found.value if found else ""
