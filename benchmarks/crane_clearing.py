"""Let a simulated crane serve a list of orders in a drawn yard by telegrams alone.

    python benchmarks/crane_clearing.py SEED BUNDLES [WANTED]

The yard is stacks of up to three bundles on dunnage, drawn from the seed; WANTED of them (all where it isn't
given) are ordered, one after the other. A survey is the yard's exact heights with noise (`noisy_world`), with
a stock list, through `lifts --fetch` and the store; `plant run` serves it. The crane's program knows only the
table of bytes. It lifts and sets down with errors within its tolerance; each lift, way and set-down is judged
by exact geometry. What is dug out lies on where it was set down, what was ordered is taken away from there.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from digging_judge import Bars, Beam, World, judge_set_down, judge_way

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.benchmarks.lift_judge.judge import Judge, LiftVerdict, Target
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet, read_magnet
from barsight.benchmarks.yard.drawn_worlds import noisy_world
from barsight.result_folder import seal_map
from barsight.simulation.worlds.solids import SolidYard, box, cylinder
from barsight.simulation.worlds.yards import DrawnYard
from barsight.store.adding import add_survey, read_survey
from barsight.store.history import executed_lifts
from barsight.store.opening import Store, open_store
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.inventory.stock_list import ListedBundle, StockMatch, match_stock
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import example_magnet
from barsight.yard.types import Bundle, HeightMap
from lift_yards import sure_travel
from opcua_servers import free_port
from result_folders import summary
from yard_folders import lifts, write_heights
from yard_maps import Laid

IN = struct.Struct(">HHHHqiiiIHHIII")
VALID, SET_DOWN_KNOWN = 1, 16
CLAIM, EXECUTING, EXECUTED, FAILED = 1, 2, 3, 4
DONE, CONTRADICTED = 1, 3
STAY_S, ANSWER_S, OFFER_S = 0.3, 10.0, 5.0
LOAD_CELL_SIGMA, SWING_M, APPROACH_M = 0.01, 0.4, 3.0
KINDS = ((7, 0.09), (7, 0.06))
PITCH_M, MARGIN_M, ACROSS_M, DUNNAGE_M = 1.1, 3.0, 11.0, 0.09
LISTED_SIGMA_M, MAX_SURVEYS = 0.01, 200
LAYERS = (0.4, 0.45, 0.15)
"""Shares of stacks of one, two and three bundles."""


class CranePlc:
    """The crane's program: one command at a time, repeated until it is answered."""

    def __init__(self, port: int) -> None:
        self.link = socket.create_connection(("127.0.0.1", port), timeout=5)
        self.life = self.number = 0

    def turn(self, command: int = 0, flags: int = 0, load: int = 0, *lift: int) -> bytes:
        """Exchange one telegram; lift: its number, token and checksum."""
        self.life = (self.life + 1) & 0xFFFF
        self.link.sendall(IN.pack(
            0xB51B, 1, self.life, flags, time.time_ns(), 0, 0, 0, load, command, self.number,
            *(*lift, 0, 0, 0)[:3],
        ))  # fmt: skip
        return self.link.recv(98, socket.MSG_WAITALL)

    def ask(self, command: int, flags: int, load: int, *lift: int) -> tuple[int, int, float]:
        """Return the answer, the token and the seconds that it took."""
        self.number = self.number % 65535 + 1
        began_s = time.monotonic()
        while time.monotonic() - began_s < ANSWER_S:
            number, answer, _, token = struct.unpack_from(">HHHI", self.turn(command, flags, load, *lift), 70)
            if number == self.number:
                return answer, token, time.monotonic() - began_s
        return 0, 0, ANSWER_S

    def next_lift(self) -> bytes | None:
        """Wait for a valid state; None where none comes."""
        ends_s = time.monotonic() + OFFER_S
        while time.monotonic() < ends_s:
            if struct.unpack_from(">H", content := self.turn(), 6)[0] & VALID:
                return content
        return None


@dataclass
class OrderBook:
    """The dispatcher's list of what lies where, and what is wanted, the next one first."""

    listed: dict[str, ListedBundle]
    height_m: dict[str, float]
    wanted: list[str]
    carried: set[str] = field(default_factory=set)

    def matched(self, bundles: tuple[Bundle, ...]) -> StockMatch:
        """Match the list with a survey, and take over from it where what was set down truly lies."""
        by_id = {bundle.id: bundle for bundle in bundles}
        match = match_stock(tuple(self.listed.values()), bundles)
        for one in match.matched:
            if one.name in self.carried:
                x, y, _ = (float(value) for value in by_id[one.bundle].centre_m)
                top = by_id[one.bundle].top_z_m
                self.listed[one.name] = replace(self.listed[one.name], x_m=x, y_m=y, top_z_m=top)
        return match_stock(tuple(self.listed.values()), bundles)

    def asked(self, match: StockMatch, bundles: tuple[Bundle, ...]) -> dict[int, str]:
        """Name bundles of the map to be fetched, each with what is wanted of it: that itself, or what lies
        under it where the map doesn't show that.
        """
        by_name = {one.name: one.bundle for one in match.matched}
        top = {bundle.id: bundle.top_z_m for bundle in bundles}
        found = dict[int, str]()
        for name in self.wanted:
            own = self.listed[name]
            over = [
                one for other, one in by_name.items()
                if math.hypot(self.listed[other].x_m - own.x_m, (self.listed[other].y_m - own.y_m) / 6) < 0.2
            ]  # fmt: skip
            for number in [by_name[name]] if name in by_name else sorted(over, key=lambda k: -top[k])[:1]:
                found.setdefault(number, name)
        return found

    def moved(self, name: str, place: dict[str, float]) -> None:
        """Take over where a load was set down."""
        self.carried.add(name)
        self.listed[name] = replace(
            self.listed[name], x_m=place["x_m"], y_m=place["y_m"], yaw_deg=place["yaw_deg"],
            top_z_m=place["z_m"] + self.height_m[name],
        )  # fmt: skip


@dataclass
class Cleared:
    """Counts of what came of a yard, and a line for each lift."""

    counts: Counter[str] = field(default_factory=Counter)
    lines: list[str] = field(default_factory=list)


def stacked(number: int, place: tuple[float, float, float], base_m: float, length_m: float,
            kind: tuple[int, float]) -> tuple[Bars, list[Beam]]:  # fmt: skip
    """Lay a bundle on three beams of dunnage at a height."""
    (x, y, yaw), (bars, diameter) = place, kind
    cross = Laid(0, 0, 0, 0, diameter, bars, length_m, 0.0).axes_m
    z = base_m + DUNNAGE_M + diameter / 2 - cross[:, 1].min()
    one = Bars(number, x, y, float(z), yaw, cross, diameter, length_m)
    half = np.array([one.width_m / 2 + 0.1, 0.05, DUNNAGE_M / 2])
    return one, [
        Beam(np.array([x - v * math.sin(yaw), y + v * math.cos(yaw), base_m + DUNNAGE_M / 2]), half, yaw)
        for v in (-0.3 * length_m, 0.0, 0.3 * length_m)
    ]


def draw_stacks(seed: int, count: int) -> World:
    """Draw stacks beside each other along X, of bars along Y."""
    rng = np.random.default_rng((47, seed))
    bundles, beams, stacks = list[Bars](), list[Beam](), 0
    while len(bundles) < count:
        x, y = rng.normal((MARGIN_M + PITCH_M * stacks, 0.0), (0.03, 0.15))
        yaw, length = math.radians(rng.normal(0, 0.4)), float(rng.uniform(6.0, 7.0))
        base = 0.0
        for _ in range(min(1 + int(rng.choice(3, p=LAYERS)), count - len(bundles))):
            place = float(x + rng.normal(0, 0.01)), float(y + rng.normal(0, 0.05)), yaw
            own = length * float(rng.uniform(0.92, 1.0))
            one, under = stacked(len(bundles), place, base, own, KINDS[int(rng.integers(len(KINDS)))])
            bundles, beams, base = [*bundles, one], beams + under, one.top_z_m
        stacks += 1
    high = np.array([2 * MARGIN_M + PITCH_M * stacks, ACROSS_M / 2])
    return World(tuple(bundles), tuple(beams), np.array([0.0, -ACROSS_M / 2]), high)


def book_of(world: World, seed: int, wanted: int) -> OrderBook:
    """List a world's bundles as a dispatcher would, and draw the orders."""
    rng = np.random.default_rng((48, seed))
    listed, heights = {}, {}
    for one in world.bundles:
        name = f"A{one.number}"
        x, y, top = rng.normal((one.x_m, one.y_m, one.top_z_m), LISTED_SIGMA_M)
        listed[name] = ListedBundle(
            name, float(x), float(y), float(top), math.degrees(one.yaw_rad), one.length_m, one.width_m,
            one.diameter_m, len(one.cross_m),
        )  # fmt: skip
        heights[name] = one.top_z_m - one.bottom_z_m
    order = [f"A{number}" for number in rng.permutation(len(world.bundles))[:wanted]]
    return OrderBook(listed, heights, order)


def solids_of(world: World) -> SolidYard:
    """Make the exact solids that the lifts' judge knows."""
    solids = []
    for one in world.bundles:
        along = np.array([-math.sin(one.yaw_rad), math.cos(one.yaw_rad), 0.0])
        across = np.array([along[1], -along[0], 0.0])
        for side, up in one.cross_m:
            at = np.array([one.x_m, one.y_m, one.z_m + up]) + side * across
            solids.append(cylinder("bar", at, along, one.diameter_m / 2, one.length_m, one.number))
    solids += [box("beam", one.centre_m, 2 * one.half_m, one.yaw_rad) for one in world.beams]
    return SolidYard(tuple(solids))


def write_survey(heights: HeightMap, bundles: tuple[Bundle, ...], match: StockMatch, folder: Path) -> None:
    """Write a measured folder as `measure --stock` leaves it, as far as lifts and store need it."""
    folder.mkdir(parents=True)
    place = write_heights(heights, folder / "height.tif")
    photo = np.full(heights.z_m.shape, 90, np.uint8)
    tifffile.imwrite(
        folder / "tops.tif", photo, photometric="minisblack", tile=(256, 256), metadata=None, extratags=place
    )
    way = np.array([(x, 0.0) for x in np.arange(heights.x0_m, heights.x_m[-1], 0.5)])
    stamps = time.time_ns() + 1_000_000 * np.arange(-len(way), 0)
    content = summary() | {
        "agreement": [], "travel": sure_travel(way, stamps).content(), "captured_from_ns": int(stamps[0]),
        "captured_to_ns": int(stamps[-1]),
    }  # fmt: skip
    identity = seal_map(content, folder)
    (folder / "result.json").write_text(json.dumps(content), encoding="utf-8")
    write_bundles(bundles, match, "yard", identity, folder / "bundles.json")


class Yard:
    """The truth, its surveys and the judges."""

    def __init__(self, seed: int, count: int, wanted: int, folder: Path, magnet: JudgedMagnet) -> None:
        self.seed, self.folder, self.magnet, self.told = seed, folder, magnet, Cleared()
        self.world = draw_stacks(seed, count)
        self.book = book_of(self.world, seed, wanted)
        self.rng = np.random.default_rng((49, seed))
        self.order: dict[str, Any] = {}
        self.names: dict[int, str] = {}
        self.asked: dict[int, str] = {}

    def survey(self, store: Store) -> bool:
        """Survey what lies there now and ask for what is wanted; tell whether a lift is offered."""
        counts = self.told.counts
        counts["surveys"] += 1
        size = (float(self.world.high_m[0]), ACROSS_M)
        seed = 1000 * self.seed + counts["surveys"]
        mapped = noisy_world(DrawnYard(seed, "row", solids_of(self.world), (), size), LiftSettings())
        bundles = mapped.scene.table.bundles
        match = self.book.matched(bundles)
        self.names = {one.bundle: one.name for one in match.matched}
        counts["moved by the list"] += len(match.moved)
        counts["found and not listed"] += len(match.extra)
        folder = self.folder / str(counts["surveys"])
        write_survey(mapped.scene.heights, bundles, match, folder)
        self.asked = self.book.asked(match, bundles)
        fetch = ("--fetch", ",".join(map(str, self.asked)))
        is_offered = bool(self.asked) and not lifts(folder, "--dunnage-m", str(DUNNAGE_M), *fetch)
        if is_offered:
            self.order = json.loads((folder / "lifts.json").read_text(encoding="utf-8"))["fetch"]
        add_survey(store, read_survey(folder), "crane")
        return is_offered

    def lift_one(self, port: int) -> None:
        """Make one lift by the handshake, or count why not."""
        counts, content = self.told.counts, CranePlc(port).next_lift()
        if content is None:
            counts["not offered by telegram"] += 1
            return
        verdict = self.judge_lift(content)
        plc, (lift_id, checksum) = CranePlc(port), struct.unpack_from(">II", content, 16)
        plc.next_lift()
        answer, token, _ = plc.ask(CLAIM, 0, 0, lift_id, 0, checksum)
        if answer != DONE:
            counts["claim refused"] += 1
            return
        answer, _, took_s = plc.ask(EXECUTING, 0, 0, lift_id, token, checksum)
        if answer != DONE or took_s > STAY_S:
            counts["not begun in time"] += 1
            plc.ask(FAILED, 0, 0, lift_id, token, checksum)
            return
        if len(verdict.load) != 1 or not struct.unpack_from(">H", content, 6)[0] & SET_DOWN_KNOWN:
            counts["no load or no set-down"] += 1
            plc.ask(FAILED, 4, 0, lift_id, token, checksum)
            return
        weighed = round(10 * verdict.mass_kg * (1 + self.rng.normal(0, LOAD_CELL_SIGMA)))
        answer, _, _ = plc.ask(EXECUTED, 2 | 8, weighed, lift_id, token, checksum)
        counts[{DONE: "load confirmed", CONTRADICTED: "load contradicts"}.get(answer, "report refused")] += 1
        after = plc.next_lift()
        is_other = after is not None and struct.unpack_from(">I", after, 16)[0] != lift_id
        counts["second lifts of one order offered"] += is_other
        self.set_down(content, verdict.load[0])
        print(self.told.lines[-1], flush=True)

    def judge_lift(self, content: bytes) -> LiftVerdict:
        """Judge the lift within the tolerance that the telegram tells."""
        x, y, _, yaw = (value / 1e4 for value in struct.unpack_from(">iiii", content, 32))
        box_x, box_y, box_yaw = struct.unpack_from(">HHH", content, 52)
        around = box_x / 1e4, box_y / 1e4, math.radians(box_yaw / 1e3)
        judge = Judge(solids_of(self.world), self.magnet)
        verdict = judge.judge(Target(x, y, math.radians(yaw * 10), around))
        kind = "dangerous" if verdict.dangerous else "unclear" if verdict.unclear else "fine"
        self.told.counts[f"lifts {kind}"] += 1
        mass_kg = struct.unpack_from(">I", content, 60)[0] / 10
        self.told.lines.append(
            f"lift at {x:.3f} {y:.3f}: {kind}, bundle {verdict.load}, {verdict.mass_kg:.0f} kg, told "
            f"{mass_kg:.0f} kg {'; '.join(verdict.dangerous + verdict.unclear)}"
        )
        return verdict

    def set_down(self, content: bytes, number: int) -> None:
        """Carry the load, rigid in the magnet, to the told place and judge way and rest; go on from there."""
        counts, world, step = self.told.counts, self.world, self.order["steps"][0]
        (load,) = (one for one in world.bundles if one.number == number)
        hold, put = (np.array(struct.unpack_from(">iiii", content, at)) / 1e4 for at in (32, 80))
        hold[3], put[3] = (math.radians(10 * one[3]) for one in (hold, put))
        for place in (hold, put):
            off = self.rng.uniform(-1, 1, 3) * self.magnet.tolerance
            place[[0, 1, 3]] += off
        turn = put[3] - hold[3]
        cos, sin = math.cos(turn), math.sin(turn)
        x, y = put[:2] + np.array([[cos, -sin], [sin, cos]]) @ (np.array([load.x_m, load.y_m]) - hold[:2])
        yaw = math.remainder(load.yaw_rad + turn, math.pi)
        place = {"x_m": float(x), "y_m": float(y), "z_m": float(put[2]), "yaw_deg": math.degrees(yaw)}
        lies, beams, unsupported, collides = judge_set_down(
            world, load, place, (0.0, 0.0, 0.0), DUNNAGE_M, self.magnet.beam
        )
        height = load.top_z_m - load.bottom_z_m
        collides += judge_way(world, load, lies, APPROACH_M - height, SWING_M)
        counts["set-downs fine"] += not unsupported and not collides
        counts["set-downs unsupported"] += bool(unsupported)
        counts["set-downs or ways that collide"] += bool(collides)
        name = self.names[step["bundle"]]
        counts["another bundle than meant"] += name != f"A{number}"
        self.book.moved(name, step["set_down"])
        is_served = self.asked.get(step["bundle"]) == name
        counts["served" if is_served else "dug out"] += 1
        if is_served:
            self.book.wanted.remove(name)
            del self.book.listed[name]
        self.world = world.changed(None if is_served else lies, number, () if is_served else beams)
        self.told.lines[-1] += f", to {x:.3f} {y:.3f} {put[2]:.3f} m, {'served' if is_served else 'dug out'} "
        self.told.lines[-1] += "; ".join(unsupported + collides)


def serve_orders(yard: Yard) -> None:
    """Survey and lift until the list is served, or nothing of it is offered."""
    url, port, config = f"sqlite:///{yard.folder / 'yard.db'}", free_port(), yard.folder / "plant.toml"
    config.write_text(
        f'[store]\nurl = "{url}"\nallow_simulated = true\napproach_height_m = {APPROACH_M}\n'
        f"[telegram]\nport = {port}\n"
    )
    with open_store(url, create=True) as store:
        is_offered = yard.survey(store)
        command = [sys.executable, "-m", "barsight", "plant", "run", "--config", str(config)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            try:
                assert process.stdout is not None and process.stdout.readline()
                for _ in range(MAX_SURVEYS):
                    if not is_offered:
                        break
                    yard.lift_one(port)
                    is_offered = yard.survey(store)
            finally:
                process.terminate()
        with store.reading() as connection:
            yard.told.counts.update(f"in the store {one.state}" for one in executed_lifts(connection))


def main() -> None:
    """Serve the orders of one yard and print what came of it."""
    seed, count = int(sys.argv[1]), int(sys.argv[2])
    wanted = int(sys.argv[3]) if len(sys.argv) > 3 else count
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        described = Path(place) / "magnet.toml"
        described.write_text(example_magnet(), encoding="utf-8")
        yard = Yard(seed, count, wanted, Path(place), read_magnet(described))
        serve_orders(yard)
    print(f"seed {seed}: {count} bundles, {wanted} ordered, {time.monotonic() - began_s:.0f} s")
    print({name: number for name, number in sorted(yard.told.counts.items()) if number})
    print("not served:", yard.book.wanted)


if __name__ == "__main__":
    main()
