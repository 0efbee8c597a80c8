"""Watch the store for additions by any process, and keep the documents of its current state."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

from barsight.core.errors import BarsightError
from barsight.core.extras import extra
from barsight.core.json_values import json_value
from barsight.page.conditions import (
    ALARM_CODES,
    WHO,
    Condition,
    find_chain_condition,
    find_conditions,
    settle_alarms,
)  # fmt: skip
from barsight.page.documents import (
    alarm_records,
    bundle_records,
    equipment_record,
    lift_records,
    state_document,
    stock_record,
    survey_records,
)  # fmt: skip
from barsight.page.layers import SurveyLayer, find_layers, newest_at
from barsight.page.live import LiveFolder, LiveHealth
from barsight.store.accounts import Account, list_accounts
from barsight.store.confirmation import expire_stale, forbid, map_vetoes, newest_survey
from barsight.store.opening import Store
from barsight.store.tables import AUDIT

with extra("store"):
    from sqlalchemy import func, select

LOOK_S, JUDGE_S, VERIFY_S = 0.2, 2.0, 600.0
"""Intervals at which the store is looked at, its alarms are settled, and its audit log is verified."""
BEAT_S, FRESH_S = 2.0, 10.0
"""Interval of an event stream's beats, and maximum age of the last judgement for one to be sent: a page that
hears none shows no offer.
"""


@dataclass(frozen=True, eq=False)
class Published:
    """Documents for the page at one revision of the store.

    revision: number of rows of the audit log. documents: JSON by name. at_ns: time by this computer's clock.
    """

    revision: int = -1
    at_ns: int = 0
    documents: dict[str, bytes] = field(default_factory=dict)
    accounts: dict[str, Account] = field(default_factory=dict)
    layers: tuple[SurveyLayer, ...] = ()

    def document(self, name: str) -> bytes:
        """Return a document; the yard's clock in `state` has gone on since it was published."""
        body = self.documents[name]
        if name != "state":
            return body
        content = json.loads(body)
        return json.dumps(content | {"clock_ns": content["clock_ns"] + time.time_ns() - self.at_ns}).encode()


class StoreWatch:
    """Runs in a separate thread; requests read its last publication.

    crane: JSON of the live run's crane, empty without a live run.
    """

    def __init__(self, store: Store, live: LiveFolder | None = None) -> None:
        self.store, self.live = store, live
        self.published = Published()
        self.health: LiveHealth | None = None
        self.problem: str | None = None
        self.crane = b""
        self._seen: dict[str, set[str]] = {}
        self._lock, self._judging = threading.Lock(), threading.Lock()
        self._stop = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._changed: asyncio.Event | None = None
        self._judged_s = float("-inf")
        self._threads = [
            threading.Thread(target=self._run, name="store watch", daemon=True),
            threading.Thread(target=self._run_chain, name="audit watch", daemon=True),
        ]

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Start watching; clients that wait for events do so in this loop."""
        self._loop, self._changed = loop, asyncio.Event()
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop watching, and end all event streams."""
        self._stop.set()
        for thread in self._threads:
            thread.join(10.0)
        if self._changed is not None:
            self._changed.set()

    def refresh(self) -> None:
        """Publish again if rows were added to the store."""
        with self._lock:
            with self.store.reading() as connection:
                at_ns = time.time_ns()
                revision = connection.execute(select(func.coalesce(func.max(AUDIT.c.id), 0))).scalar_one()
                if revision == self.published.revision:
                    return
                content = {
                    "state": state_document(connection),
                    "bundles": {"bundles": bundle_records(connection)},
                    "lifts": {"lifts": lift_records(connection)},
                    "surveys": {"surveys": survey_records(connection)},
                    "alarms": {"alarms": alarm_records(connection)},
                    "stock": stock_record(connection),
                    "equipment": equipment_record(connection),
                }
                layers = find_layers(connection)
                content["layers"] = {"layers": [one.content() for one in layers]}
                accounts = list_accounts(connection)
            documents = {
                name: json.dumps(json_value({"revision": revision, **one}), allow_nan=False).encode()
                for name, one in content.items()
            }
            self.published = Published(int(revision), at_ns, documents, accounts, layers)
        self._wake()

    def look_at_crane(self) -> None:
        """Read the live crane's position, and report it if it has moved."""
        if self.live is None:
            return
        layers = self.published.layers
        if (crane := self.live.crane(lambda at_m: newest_at(layers, at_m))) != self.crane:
            self.crane = crane
            self._wake()

    def judge(self) -> None:
        """Settle alarms, and end offers that have expired or whose calibration was changed."""
        with self._judging:
            self._judge()
        self.refresh()
        self._judged_s = time.monotonic()

    def verify(self) -> None:
        """Verify the audit log and settle its alarm; in a long log it takes longer than offers may wait."""
        with self.store.reading() as connection:
            present = find_chain_condition(connection)
        with self._judging:
            self._settle(present, {"store-broken"})
        self.refresh()

    def _judge(self) -> None:
        self.health = None if self.live is None else self.live.look()
        with self.store.reading() as connection:
            present = find_conditions(connection, self.health)
            newest = newest_survey(connection)
            changed = [reason for code, reason in present if code == "calibration-changed"]
            vetoes = [] if newest is None else map_vetoes(connection, newest.id)
        if changed and not any(veto["code"] == "calibration-changed" for veto in vetoes):
            forbid(self.store, "calibration-changed", changed[0], WHO)
        self._settle(present, set(ALARM_CODES) - {"store-broken"})

    def _settle(self, present: set[Condition], judged: set[str]) -> None:
        # What another server sees may not be seen from here: after the start only what was seen here ends.
        settle_alarms(self.store, present, judged, self._seen)
        self._seen |= {code: {reason for other, reason in present if other == code} for code in judged}
        expire_stale(self.store, WHO)

    async def events(self, may_read: Callable[[], bool]) -> AsyncIterator[bytes]:
        """Stream server-sent events: new revisions and crane positions, and beats while offers are judged. A
        slow reader skips those in between.

        may_read: whether the reader's log-in lasts; the stream ends with it, by an event after which the page
        asks and reads that it must log in.
        """
        sent, shown, beat_s = -1, b"", float("-inf")
        while not self._stop.is_set():
            changed = self._changed
            assert changed is not None
            if not may_read():
                yield b"event: revision\ndata: 0\n\n"
                return
            if self.published.revision != sent:
                sent = self.published.revision
                yield f"event: revision\nid: {sent}\ndata: {sent}\n\n".encode()
                continue
            now_s = time.monotonic()
            if now_s - beat_s >= BEAT_S:
                beat_s = now_s
                is_fresh = now_s - self._judged_s <= FRESH_S
                yield b"event: beat\ndata: fresh\n\n" if is_fresh else b": still there\n\n"
            if self.crane != shown:
                shown = self.crane
                yield b"event: crane\ndata: " + shown + b"\n\n"
                continue
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), BEAT_S)

    def _wake(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._tell)

    def _tell(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        if changed is not None:
            changed.set()

    def _run(self) -> None:
        judged_s = float("-inf")
        while not self._stop.is_set():
            try:
                self.look_at_crane()
                now_s = time.monotonic()
                if now_s - judged_s >= JUDGE_S:
                    self.judge()
                    judged_s = now_s
                self.refresh()
                self.problem = None
            except (BarsightError, OSError) as error:  # a database or a disk may be back later
                self.problem = str(error)
            except Exception as error:  # a watch that has ended would show an old yard
                self.problem = f"{type(error).__name__}: {error}"
            self._stop.wait(LOOK_S)

    def _run_chain(self) -> None:
        wait_s = VERIFY_S
        while not self._stop.wait(wait_s):
            wait_s = JUDGE_S
            with contextlib.suppress(Exception):  # the other thread meets it too, and tells of it
                self.verify()
                wait_s = VERIFY_S
