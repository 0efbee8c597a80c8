"""A plant for the tests of the handshake: a store with lifts, a server that dies, cranes that forget, and a
network that delays, repeats and reorders. All of it runs on one clock that the test moves."""

from __future__ import annotations

import shutil
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from barsight.core.errors import Failed, InputError
from barsight.plant import feed, partner
from barsight.plant.feed import read_state
from barsight.plant.handshake import states_of
from barsight.plant.partner import PlcPartner
from barsight.plant.settings import PlantSettings
from barsight.plant.steps import LiftSteps
from barsight.plant.telegram import IN_MAGIC, out_values, pack, unpack
from barsight.store import confirmation
from barsight.store.audit import entry
from barsight.store.lift_records import add_lifts, settle_lifts
from barsight.store.opening import Store, open_store
from barsight.store.tables import BUNDLES, SURVEYS
from barsight.store.touches import end_disturbed

FIRST_NS = 1_790_000_000 * 10**9
STAY_S = 0.3
"""What the PLC takes for too old: a life counter that stands, an answer to `executing`."""
MAX_BEHIND = 3
"""Telegrams that the echo of its life counter may be behind."""
LIFTS, VALID_S = 6, 60.0
OFFERED, CLAIMED, BEGUN = 2, 4, 32
CLAIM, EXECUTING, EXECUTED, FAILED = 1, 2, 3, 4
DONE, REFUSED, CONTRADICTED = 1, 2, 3


class Killed(BaseException):
    """The server's process ends here."""


@dataclass(frozen=True)
class DyingStore(Store):
    """A store whose next write may fail or end the process: `before`, `after` its commit, or `locked`."""

    fault: list[str] = field(default_factory=list)

    @contextmanager
    def writing(self) -> Iterator[object]:
        fault = self.fault.pop() if self.fault else ""
        if fault == "locked":
            raise InputError(self.name, "database is locked", "wait")
        with super().writing() as connection:
            yield connection
            if fault == "before":
                raise Killed
        if fault == "after":
            raise Killed


@dataclass
class Wire:
    """A connection. `up` to the server, `down` to the crane; what lies in it may come late, or never."""

    crane: Crane
    partner: PlcPartner
    up: deque[dict[str, int]] = field(default_factory=deque)
    down: deque[dict[str, int]] = field(default_factory=deque)


class Crane:
    """A PLC's program as docs/how-to/connect-a-plant.md asks for it; knows only telegrams and its clock."""

    def __init__(self, host: str, plant: Plant) -> None:
        self.host, self.plant = host, plant
        self.number = self.life = self.resumed = 0
        self.forget()

    def forget(self) -> None:
        """Start cold: nothing is known of what was done."""
        self.phase, self.sent_s = "idle", 0.0
        self.lift = {"lift_id": 0, "checksum": 0, "token": 0}
        self.seen: dict[str, int] = {}
        self.seen_s = self.turned_s = -1.0
        self.load = 0

    def hear(self, told: dict[str, int]) -> None:
        if told["life"] != self.seen.get("life"):
            self.seen_s = self.plant.now_s
        self.seen = told

    @property
    def may_act(self) -> bool:
        echo = self.seen.get("life_echo", 0)
        is_fresh = self.plant.now_s - self.seen_s <= STAY_S and (self.life - echo) & 0xFFFF <= MAX_BEHIND
        is_since = 1 <= (echo - self.resumed) & 0xFFFF < 0x8000
        return is_fresh and is_since and bool(self.seen["status"] & 1)

    def turn(self) -> dict[str, int]:
        """One cycle: judge what was heard, and form the telegram that goes out."""
        if self.plant.now_s - self.turned_s > STAY_S:
            self.resumed = self.life
        self.turned_s = self.plant.now_s
        seen, self.life = self.seen, self.life % 65535 + 1
        told = seen.get("answer", 0) if seen.get("answer_number") == self.number else 0
        if self.phase == "idle" and self.may_act and seen["status"] & (OFFERED | CLAIMED):
            self.lift = {"lift_id": seen["lift_id"], "checksum": seen["checksum"], "token": 0}
            self._go("claiming")
        elif self.phase == "claiming" and told == DONE:
            self.lift["token"] = seen["token"]
            self._go("failed" if seen["status"] & BEGUN else "asking")
        elif self.phase == "claiming" and (told or self.plant.now_s - self.sent_s > 5):
            self._go("idle")
        elif self.phase == "asking" and self.plant.now_s - self.sent_s > STAY_S:
            self._go("failed")
        elif self.phase == "asking" and told:
            self._go("lifting" if told == DONE and self.may_act else "failed")
            if self.phase == "lifting":
                self.plant.lifts_off(self.lift["lift_id"])
        elif self.phase == "lifting":
            self.load = 17_000
            self._go("executed")
        elif self.phase in ("executed", "failed") and told:
            self.plant.answered(self.lift["lift_id"], self.phase, told)
            self._go("idle")
        return self._telegram()

    def _go(self, phase: str) -> None:
        self.phase, self.sent_s = phase, self.plant.now_s
        self.plant.handshakes += phase == "claiming"
        if phase not in ("idle", "lifting"):
            self.number = self.number % 65535 + 1

    def _telegram(self) -> dict[str, int]:
        command = {"claiming": CLAIM, "asking": EXECUTING, "executed": EXECUTED, "failed": FAILED}
        values = {
            "magic": IN_MAGIC, "version": 1, "life": self.life, "flags": 2 | 8, "load": self.load,
            "command": command.get(self.phase, 0), "command_number": self.number, **self.lift,
        }  # fmt: skip
        found = unpack("in", pack("in", values))
        assert not isinstance(found, Failed)
        return found


def make_template(folder: Path) -> Path:
    """An empty store to copy; making one takes longer than a test's whole run."""
    path = folder / "template.db"
    with open_store(f"sqlite:///{path}", create=True):
        return path


class Plant:
    """Everything between the yard's truth and its cranes. `now_s`: seconds since the test began.

    is_drawn_time: whether all of Barsight goes by `now_s`; if not, the lifts are valid for a minute from now.
    """

    def __init__(self, template: Path, folder: Path, *, is_drawn_time: bool = True) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "yard.db"
        shutil.copy(template, path)
        self.now_s, self.counter, self.surveys, self.handshakes = 0.0, 0, 0, 0
        self.first_ns = FIRST_NS if is_drawn_time else time.time_ns()
        self.ends_s: dict[int, float] = {}
        self.began_s: dict[int, float] = {}
        self.answers: Counter[str] = Counter()
        self.forgotten: set[int] = set()
        clock = SimpleNamespace(time_ns=lambda: self.now_ns, monotonic=lambda: self.now_s)
        modules = (confirmation, partner, feed) if is_drawn_time else ()
        self._patches = [patch.object(module, "time", clock) for module in modules]
        for one in self._patches:
            one.start()
        self._opened = open_store(f"sqlite:///{path}")
        plain = self._opened.__enter__()
        self.store = DyingStore(plain.engine, plain.name)
        self.settings = PlantSettings()
        self.cranes = [Crane("10.0.0.1", self), Crane("10.0.0.2", self)]
        self.wires: list[Wire] = []
        self.lost: list[Wire] = []
        self.survey()
        self.start_server()

    def close(self) -> None:
        self._opened.__exit__(None, None, None)
        for one in self._patches:
            one.stop()

    @property
    def now_ns(self) -> int:
        return self.first_ns + round(self.now_s * 1e9)

    def start_server(self) -> None:
        """Start it anew: all connections are lost; what they held never comes."""
        self.steps = LiftSteps(self.store, self.settings)
        self.wires, self.lost = [], []
        for crane in self.cranes:
            self.connect(crane)

    def connect(self, crane: Crane) -> Wire:
        """Connect anew; what the crane sent by the old connection may still come."""
        old = [one for one in self.wires if one.crane is crane]
        self.lost += [one for one in old if one.up]
        wire = Wire(crane, PlcPartner(f"plc {crane.host}", self.steps, STAY_S))
        self.wires = [one for one in self.wires if one.crane is not crane] + [wire]
        return wire

    def wire_of(self, crane: Crane) -> Wire:
        return next(one for one in self.wires if one.crane is crane)

    def survey(self, begun_s: float | None = None, offset_m: float | None = None) -> None:
        """A new survey with lifts of its own, far apart; the lifts of the one before end.

        begun_s: of its first frame. offset_m: of its lifts.
        """
        self.surveys += 1
        offset_m = 100.0 * self.surveys if offset_m is None else offset_m
        from_ns = self.now_ns if begun_s is None else self.first_ns + round(begun_s * 1e9)
        for lift_id, end_s in self.ends_s.items():
            self.ends_s[lift_id] = min(end_s, self.now_s)
        with entry(self.store, "test", "survey", self.now_ns) as opened:
            survey_id = opened.add(
                SURVEYS, map_id=f"map {self.surveys}", captured_from_ns=from_ns,
                captured_to_ns=self.now_ns + self.surveys, added_ns=self.now_ns, calibration_id="c",
                is_simulated=False, software_version="1", folder="none", files="{}", heights=b"",
            )  # fmt: skip
            lifts = [self._lift(rank, offset_m) for rank in range(1, LIFTS + 1)]
            ids = {k: opened.add(BUNDLES, survey_id=survey_id) for k in range(1, LIFTS + 1)}
            content = {
                "vetoes": [], "refused": [], "lifts": lifts, "settings": {"disturbed_reach_m": 1.0},
                "magnet": {"beam": {"width_m": 1.0, "length_m": 1.0}},
            }  # fmt: skip
            settle_lifts(opened, {}, from_ns, is_newest=True)
            add_lifts(opened, survey_id, content, ids, is_newest=True)
            end_disturbed(opened, from_ns)
            for lift_id in opened.rows["lifts"]:
                self.ends_s[lift_id] = self.now_s + VALID_S

    def _lift(self, rank: int, offset_m: float) -> dict[str, object]:
        place = {"x_m": 9.0 * rank + offset_m, "y_m": 0.0, "z_m": 0.5, "yaw_deg": 0.0}
        return {
            "rank": rank, "bundles": [rank], "target": place, "set_down": None, "count": 1,
            "tolerance": {"x_m": 0.01, "y_m": 0.01, "yaw_deg": 0.1}, "mass_kg": 1700.0, "mass_sigma_kg": 50.0,
            "valid_until_ns": self.now_ns + round(VALID_S * 1e9),
        }  # fmt: skip

    def veto(self) -> None:
        confirmation.forbid(self.store, "no-magnet", "the test says so", "ann")
        for lift_id, end_s in self.ends_s.items():
            self.ends_s[lift_id] = min(end_s, self.now_s)

    def lifts_off(self, lift_id: int) -> None:
        """A crane raises a load: never twice, and never one that is invalid for longer than `STAY_S`."""
        assert lift_id not in self.began_s, f"lift {lift_id} is executed twice"
        late_s = self.now_s - self.ends_s[lift_id]
        assert late_s <= STAY_S, f"lift {lift_id} is executed {late_s:.2f} s after it was invalid"
        self.began_s[lift_id] = self.now_s

    def answered(self, lift_id: int, phase: str, told: int) -> None:
        self.answers[f"{phase} {told}"] += 1
        if phase == "executed":
            assert told in (DONE, CONTRADICTED), f"lift {lift_id} was executed and its report is refused"

    def forget(self, crane: Crane) -> None:
        """Start a crane's PLC cold."""
        if crane.phase in ("lifting", "executed"):
            self.forgotten.add(crane.lift["lift_id"])
        crane.forget()
        self.connect(crane)

    def send(self, wire: Wire) -> None:
        """The server's cycle for one connection."""
        self.counter = self.counter % 65535 + 1
        state = replace(read_state(self.store, self.settings), life_counter=self.counter)
        found = unpack("out", pack("out", out_values(wire.partner.seen(state), wire.partner.answer)))
        assert not isinstance(found, Failed)
        wire.down.append(found)

    def take(self, wire: Wire, fault: str = "") -> bool:
        """Let the server take one telegram; False where it died of it."""
        if not wire.up:
            return True
        found = wire.up.popleft()
        try:
            wire.partner.watch(wire.partner.reading(found))
            if wire.partner.receive(found):
                self.store.fault[:] = [fault] if fault else []
                wire.partner.execute()
        except Killed:
            self.start_server()
            return False
        finally:
            self.store.fault.clear()
        return True

    def cycle(self, crane: Crane, fault: str = "") -> None:
        """Server, crane, server in turn, without delay."""
        self.now_s += 0.1
        wire = self.wire_of(crane)
        self.send(wire)
        while wire.down:
            crane.hear(wire.down.popleft())
        wire.up.append(crane.turn())
        while wire.up and self.take(wire, fault):
            fault = ""

    def judge(self) -> None:
        """Hold the store against what cranes truly did."""
        with self.store.reading() as connection:
            open_of = {one.lift_id: one.state for one in confirmation.open_lifts(connection)}
        assert list(open_of.values()).count("executing") <= 1
        for crane in self.cranes:
            if crane.phase == "lifting":
                others = [state for lift, state in open_of.items() if lift != crane.lift["lift_id"]]
                assert "executing" not in others

    def settle(self) -> None:
        """End all faults; what was lifted is in the store, and a lift can be made from start to end."""
        for wire in [*self.lost, *self.wires]:
            while wire.up and self.take(wire):
                pass
        for _ in range(6):
            for crane in self.cranes:
                self.cycle(crane)
        with self.store.reading() as connection:
            begun = [one for one in confirmation.open_lifts(connection) if one.state == "executing"]
        in_hand = [crane.lift["lift_id"] for crane in self.cranes if crane.phase != "idle"]
        for one in begun:
            if one.lift_id not in in_hand:  # its crane has forgotten it: an operator looks and ends it
                assert one.lift_id in self.forgotten or one.lift_id not in self.began_s
                confirmation.end_lift(self.store, one.lift_id, "failed", "ann", "looked")
        self.survey()
        before = self.answers["executed 1"]
        for _ in range(40):
            if self.answers["executed 1"] > before + 1:
                break
            for crane in self.cranes:
                self.cycle(crane)
        else:
            raise AssertionError("no lift can be made any more")
        for lift_id in self.began_s:
            states = self.states_of(lift_id)
            if not any(crane.lift["lift_id"] == lift_id and crane.phase != "idle" for crane in self.cranes):
                assert "executed" in states or lift_id in self.forgotten, f"lift {lift_id} is lost: {states}"

    def states_of(self, lift_id: int) -> list[str]:
        return states_of(self.store, lift_id)
