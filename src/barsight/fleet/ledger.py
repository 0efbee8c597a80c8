"""Record in the results who works on a key, its failures, and its completion: the authority on a run."""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

from barsight.fleet.objects import Objects

TRIES = 3
"""Number of failures after which a recording is parked."""
MAX_LOST = 12
"""Number of claims whose worker died silently, possibly through the fault of others, before parking."""
REMEDY = "promote nothing of it; measure the recording again"
"""Remedy for a published result that isn't as it was written."""
Held = Literal["published", "parked", "claimed"]
_TEXT, _NUMBER = {"type": "string"}, {"type": "number"}
_FILE = {
    "type": "object", "required": ["bytes", "sha256"],
    "properties": {"bytes": {"type": "integer"}, "sha256": _TEXT},
}  # fmt: skip
_RESULT = {
    "type": "object",
    "required": ["key", "token", "measured_s", "whole_s", "peak_bytes", "files"],
    "properties": {
        "key": _TEXT, "token": _TEXT, "measured_s": _NUMBER, "whole_s": _NUMBER,
        "peak_bytes": {"type": "integer"}, "files": {"type": "object", "additionalProperties": _FILE},
    },
}  # fmt: skip
_CLAIM = {"type": "object", "required": ["expires"], "properties": {"expires": _NUMBER}}
PARKED = {"type": "object", "required": ["reason"], "properties": {"reason": _TEXT}}
"""Schemas of the objects kept here."""


@dataclass(frozen=True)
class HeldRecording:
    """A key claimed by this worker. token: of this try. number: counts the claims of the key from 1."""

    key: str
    number: int
    token: str


def claim(results: Objects, key: str, lease_s: float) -> HeldRecording | Held:
    """Claim a key by put-if-absent, or report its state. A claim whose lease has expired is taken over.

    The machines' clocks must agree to within a small part of the lease.
    """
    if results.read(f"results/{key}/result.json") is not None:
        return "published"
    if results.read(f"parked/{key}.json") is not None:
        return "parked"
    number = 0
    for one in results.list(f"claims/{key}/"):
        stem = PurePosixPath(one.path).stem
        number = max(number, int(stem) if stem.isdecimal() else 0)
    if number:
        last = results.read_json(f"claims/{key}/{number:04d}.json", _CLAIM)
        if last is not None and last["expires"] > time.time():
            return "claimed"
    if number >= MAX_LOST:
        park(results, key, f"its worker ended {number} times without a word", number)
        return "parked"
    mine = HeldRecording(key, number + 1, secrets.token_hex(8))
    return mine if results.write_new(_path(mine), _claim_text(mine, lease_s)) else "claimed"


@contextmanager
def held(results: Objects, mine: HeldRecording, lease_s: float) -> Iterator[None]:
    """Renew a claim from a separate thread while the block runs, and let it expire right after it."""
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(lease_s / 4):
            try:
                results.write(_path(mine), _claim_text(mine, lease_s))
            except Exception:  # the next renewal may succeed; if none does, another worker takes over
                continue

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        results.write(_path(mine), _claim_text(mine, 0.0))


def publish(results: Objects, mine: HeldRecording, content: dict[str, Any]) -> bool:
    """Write the key's result.json, its last object, if there is none; return whether it is this worker's."""
    text = json.dumps({"key": mine.key, "token": mine.token, **content}, indent=1)
    return results.write_new(f"results/{mine.key}/result.json", text.encode())


def discard(results: Objects, mine: HeldRecording, *, is_ours: bool) -> None:
    """Remove the files of a key's other tries if this one was published, otherwise those of this one."""
    prefix = f"files/{mine.key}/{mine.token}/"
    for one in list(results.list(f"files/{mine.key}/")):
        if one.path.startswith(prefix) is not is_ours:
            results.remove(one.path)


def result_note(results: Objects, key: str) -> dict[str, Any] | None:
    """Read the published result of a key; None if there is none. Raises InputError."""
    note: dict[str, Any] | None = results.read_json(f"results/{key}/result.json", _RESULT)
    return note


def fail(results: Objects, mine: HeldRecording, reason: str) -> bool:
    """Record a failure; return True if it parks the recording."""
    note = {"token": mine.token, "reason": reason, "host": socket.gethostname(), "at": time.time()}
    results.write_new(f"failures/{mine.key}/{mine.number:04d}.json", json.dumps(note).encode())
    count = sum(1 for _ in results.list(f"failures/{mine.key}/"))
    if count >= TRIES:
        park(results, mine.key, reason, count)
    return count >= TRIES


def park(results: Objects, key: str, reason: str, tries: int) -> None:
    """Park a key with its reason."""
    results.write_new(f"parked/{key}.json", json.dumps({"reason": reason, "tries": tries}).encode())


def forgive(results: Objects, key: str) -> None:
    """Delete a key's failures, so that it is tried again."""
    for prefix in (f"failures/{key}/", f"claims/{key}/"):
        for one in list(results.list(prefix)):
            results.remove(one.path)
    results.remove(f"parked/{key}.json")


def published_keys(results: Objects) -> set[str]:
    """List the published keys."""
    return {PurePosixPath(one.path).parent.name for one in results.list("results/")}


def parked_keys(results: Objects) -> set[str]:
    """List the parked keys."""
    return {PurePosixPath(one.path).stem for one in results.list("parked/")}


def running_keys(results: Objects, among: set[str]) -> set[str]:
    """List the keys of `among` that a worker currently holds."""
    newest: dict[str, str] = {}
    for one in results.list("claims/"):
        key = PurePosixPath(one.path).parent.name
        if key in among:
            newest[key] = max(newest.get(key, ""), one.path)
    now = time.time()
    return {
        key
        for key, path in newest.items()
        if (results.read_json(path, _CLAIM) or {"expires": 0})["expires"] > now
    }


def _path(mine: HeldRecording) -> str:
    return f"claims/{mine.key}/{mine.number:04d}.json"


def _claim_text(mine: HeldRecording, lease_s: float) -> bytes:
    owner = {"host": socket.gethostname(), "pid": os.getpid(), "token": mine.token}
    return json.dumps({**owner, "at": time.time(), "expires": time.time() + lease_s}).encode()
