"""Post each change of the state to addresses of the yard management system, in order, until accepted."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import json
import threading
import urllib.error
import urllib.request
from collections import deque
from pathlib import Path
from typing import Any

from barsight.core.errors import BarsightError, InputError
from barsight.core.json_values import json_value
from barsight.core.reading.bounded_reading import read_text
from barsight.plant.link_settings import WebhookSettings

FIRST_RETRY_S = 0.2
SIGNATURE = "X-Barsight-Signature"


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> None:
        return None


class Webhook:
    """One address, with the changes queued for it and the thread that posts them.

    A change is posted until the address answers with 2xx, so it may arrive twice. A
    change answered with 4xx other than 408 and 429 is dropped, as it would be refused again. `lost` is the
    number of changes dropped before a post.
    """

    def __init__(self, url: str, settings: WebhookSettings) -> None:
        self.url = url
        self._settings = settings
        self._waiting: deque[dict[str, Any]] = deque()
        self._lock = threading.Lock()
        self._lost = 0
        self._problem: str | None = None
        self._changed, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhook", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Count the queued changes."""
        return len(self._waiting)

    @property
    def problem(self) -> str | None:
        """Return why the last post was not accepted, None if it was."""
        return self._problem

    def tell(self, change: dict[str, Any]) -> None:
        """Queue a change; if the queue is full, the oldest is dropped."""
        with self._lock:
            if len(self._waiting) >= self._settings.max_waiting:
                self._waiting.popleft()
                self._lost += 1
            self._waiting.append(change)
        self._changed.set()

    def stop(self) -> None:
        """Stop the thread; queued changes are dropped."""
        self._stop.set()
        self._changed.set()
        self._thread.join(self._settings.timeout_s + 1)

    def _run(self) -> None:
        wait_s = FIRST_RETRY_S
        while not self._stop.is_set():
            with self._lock:
                first = self._waiting[0] if self._waiting else None
                lost = self._lost
                if first is None:
                    self._changed.clear()
            if first is None:
                self._changed.wait()
                continue
            problem, is_final = post(self.url, self._settings, {"lost": lost, **first})
            self._problem = problem
            if problem is None or is_final:
                wait_s = FIRST_RETRY_S
                with self._lock:
                    if problem is None:
                        self._lost -= lost
                    if self._waiting and self._waiting[0] is first:
                        self._waiting.popleft()
                continue
            self._stop.wait(wait_s)
            wait_s = min(2 * wait_s, self._settings.max_retry_s)


def read_secret(path: Path) -> bytes:
    """Read the secret, the first line of a file. Raises InputError if there is none: anybody could sign."""
    secret = read_text(path, remedy="give the file with the secret").partition("\n")[0].rstrip("\r")
    if not secret.strip():
        raise InputError(path, "its first line is empty", "write the secret into it")
    return secret.encode()


def post(url: str, settings: WebhookSettings, body: dict[str, Any]) -> tuple[str | None, bool]:
    """Post a body once; return the problem (None if accepted) and whether a retry would be pointless."""
    content = json.dumps(json_value(body), allow_nan=False).encode()
    headers = {"Content-Type": "application/json"}
    opener = urllib.request.build_opener(_NoRedirect)
    try:
        if settings.secret_file is not None:
            secret = read_secret(settings.secret_file)
            headers[SIGNATURE] = "sha256=" + hmac.new(secret, content, hashlib.sha256).hexdigest()
        request = urllib.request.Request(url, content, headers, method="POST")
        with opener.open(request, timeout=settings.timeout_s):
            return None, False
    except urllib.error.HTTPError as error:
        error.close()
        return f"answered with {error.code}", 400 <= error.code < 500 and error.code not in (408, 429)
    except (BarsightError, OSError, ValueError, http.client.HTTPException) as error:
        return str(error), False
