"""Let a simulated crane clear a drawn yard by telegrams alone, each lift judged by the yard's solids.

    python benchmarks/crane_clearing.py SEED BUNDLES

The yard is one layer of bundles beside each other, drawn from the seed. A survey is its exact heights with
noise (`noisy_world`), through `lifts` and the store; `plant run` serves it. The crane's program knows only
the table of bytes. A load that it takes leaves the yard.
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

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.benchmarks.lift_judge.judge import Judge, Target
from barsight.benchmarks.lift_judge.magnet import read_magnet
from barsight.benchmarks.yard.drawn_worlds import noisy_world
from barsight.result_folder import seal_map
from barsight.simulation.worlds.solids import SolidYard, cylinder
from barsight.simulation.worlds.yards import DrawnYard
from barsight.store.adding import add_survey, read_survey
from barsight.store.opening import Store, open_store
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import example_magnet
from lift_yards import sure_travel
from opcua_servers import free_port
from result_folders import summary
from yard_folders import lifts, write_heights
from yard_maps import Laid

IN = struct.Struct(">HHHHqiiiIHHIII")
VALID, BEGUN = 1, 32
CLAIM, EXECUTING, EXECUTED, FAILED = 1, 2, 3, 4
DONE, CONTRADICTED = 1, 3
STAY_S, ANSWER_S = 0.3, 10.0
LOAD_CELL_SIGMA = 0.01
KINDS = ((7, 0.09), (7, 0.06))
PITCH_M, MARGIN_M = 1.1, 0.6


@dataclass
class Cleared:
    """A yard after it was cleared. lifts: a line each; left: bundles; refused: codes of the last survey."""

    bundles: int
    surveys: int = 0
    lifts: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    left: list[str] = field(default_factory=list)


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

    def next_lift(self, wait_s: float) -> bytes | None:
        """Wait for a valid state; None where none comes."""
        ends_s = time.monotonic() + wait_s
        while time.monotonic() < ends_s:
            if struct.unpack_from(">H", content := self.turn(), 6)[0] & VALID:
                return content
        return None


def draw_row(seed: int, count: int) -> DrawnYard:
    """Draw bundles of bars along Y on the floor, one beside the other along X."""
    rng = np.random.default_rng((43, seed))
    solids = []
    for number in range(count):
        bars, diameter = KINDS[int(rng.integers(len(KINDS)))]
        x, y, yaw = rng.normal((MARGIN_M + PITCH_M * number, 0.0, 0.0), (0.05, 0.15, 0.5))
        one = Laid(float(x), float(y), 0.0, float(yaw), diameter, bars, float(rng.uniform(6.0, 7.0)), 0.0)
        turned = math.radians(one.yaw_deg)
        along = np.array([-math.sin(turned), math.cos(turned), 0.0])
        across = np.array([along[1], -along[0], 0.0])
        low = one.axes_m[:, 1].min() - diameter / 2
        for side, up in one.axes_m:
            at = np.array([one.x_m, one.y_m, up - low]) + side * across
            solids.append(cylinder("bar", at, along, diameter / 2, one.length_m, number))
    return DrawnYard(seed, "row", SolidYard(tuple(solids)), (), (2 * MARGIN_M + PITCH_M * count, 8.0))


def survey(store: Store, world: DrawnYard, folder: Path) -> Counter[str]:
    """Survey what lies there now; return the codes of what the product refuses."""
    folder.mkdir(parents=True)
    mapped = noisy_world(world, LiftSettings())
    heights, bundles = mapped.scene.heights, mapped.scene.table.bundles
    place = write_heights(heights, folder / "height.tif")
    photo = np.full(heights.z_m.shape, 90, np.uint8)
    tifffile.imwrite(
        folder / "tops.tif", photo, photometric="minisblack", tile=(256, 256), metadata=None, extratags=place
    )
    way = np.array([(x, 0.0) for x in np.arange(0.0, world.size_m[0], 0.5)])
    stamps = time.time_ns() + 1_000_000 * np.arange(-len(way), 0)
    content = summary() | {
        "agreement": [], "travel": sure_travel(way, stamps).content(), "captured_from_ns": int(stamps[0]),
        "captured_to_ns": int(stamps[-1]),
    }  # fmt: skip
    identity = seal_map(content, folder)
    (folder / "result.json").write_text(json.dumps(content), encoding="utf-8")
    write_bundles(bundles, None, "yard", identity, folder / "bundles.json")
    assert lifts(folder) in (0, 5)
    told = json.loads((folder / "lifts.json").read_text(encoding="utf-8"))
    add_survey(store, read_survey(folder), "crane")
    return Counter(veto["code"] for one in (*told["refused"], told) for veto in one["vetoes"])


def lift_one(plc: CranePlc, content: bytes, world: DrawnYard, judge: Judge, told: Cleared) -> DrawnYard:
    """Make one lift by the handshake; return the yard as it is then."""
    lift_id, checksum = struct.unpack_from(">II", content, 16)
    x, y, _, yaw = (value / 1e4 for value in struct.unpack_from(">iiii", content, 32))
    box_x, box_y, box_yaw = struct.unpack_from(">HHH", content, 52)
    told_kg = struct.unpack_from(">I", content, 60)[0] / 10
    answer, token, _ = plc.ask(CLAIM, 0, 0, lift_id, 0, checksum)
    if answer != DONE:
        told.counts["claim refused"] += 1
        return world
    answer, _, took_s = plc.ask(EXECUTING, 0, 0, lift_id, token, checksum)
    if answer != DONE or took_s > STAY_S:
        told.counts["not begun in time"] += 1
        plc.ask(FAILED, 0, 0, lift_id, token, checksum)
        return world
    turned = math.radians(yaw * 10)
    box = box_x / 1e4, box_y / 1e4, math.radians(box_yaw / 1e3)
    verdict = judge.judge(Target(x, y, turned, box))
    kind = "dangerous" if verdict.dangerous else "unclear" if verdict.unclear else "fine"
    told.counts[kind] += 1
    told.lifts.append(
        f"lift {lift_id} at {x:.3f} {y:.3f} m, {yaw * 10:.2f} deg: {kind}, bundles {list(verdict.load)}, "
        f"{verdict.mass_kg:.0f} kg, told {told_kg:.0f} kg {'; '.join(verdict.dangerous + verdict.unclear)}"
    )
    print(told.lifts[-1], flush=True)
    if not verdict.load:
        plc.ask(FAILED, 4, 0, lift_id, token, checksum)
        return world
    rng = np.random.default_rng((41, world.seed, lift_id))
    weighed = round(10 * verdict.mass_kg * (1 + rng.normal(0, LOAD_CELL_SIGMA)))
    answer, _, _ = plc.ask(EXECUTED, 2 | 8, weighed, lift_id, token, checksum)
    told.counts[{DONE: "load confirmed", CONTRADICTED: "load contradicts"}.get(answer, "report refused")] += 1
    left = tuple(one for one in world.yard.solids if one.bundle not in verdict.load)
    return replace(world, yard=SolidYard(left))


def clear_yard(seed: int, count: int, folder: Path) -> Cleared:
    """Survey and lift until nothing is offered any more."""
    described = folder / "magnet.toml"
    described.write_text(example_magnet(), encoding="utf-8")
    magnet = read_magnet(described)
    world, told = draw_row(seed, count), Cleared(count)
    url, port, config = f"sqlite:///{folder / 'yard.db'}", free_port(), folder / "plant.toml"
    config.write_text(f'[store]\nurl = "{url}"\nallow_simulated = true\n[telegram]\nport = {port}\n')
    with open_store(url, create=True) as store:
        told.refused = survey(store, world, folder / "0")
        command = [sys.executable, "-m", "barsight", "plant", "run", "--config", str(config)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            try:
                assert process.stdout is not None and process.stdout.readline()
                plc = CranePlc(port)
                for number in range(1, count + 2):
                    told.surveys, made = number, len(told.lifts)
                    while (content := plc.next_lift(3.0)) is not None:
                        judge = Judge(world.yard, magnet)
                        world = lift_one(plc, content, world, judge, told)
                    if len(told.lifts) == made:
                        break
                    plc.link.close()
                    told.refused = survey(
                        store, replace(world, seed=1000 * seed + number), folder / str(number)
                    )
                    plc = CranePlc(port)
            finally:
                process.terminate()
    told.counts["bundles left"] = len(world.yard.bundles)
    for bundle in world.yard.bundles:
        bars = world.yard.bars(bundle)
        told.left.append(f"{len(bars)} bars of {2e3 * bars[0].half[1]:.0f} mm, {2 * bars[0].half[0]:.1f} m")
    return told


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        began_s = time.monotonic()
        found = clear_yard(int(sys.argv[1]), int(sys.argv[2]), Path(place))
        took_s = time.monotonic() - began_s
    print(f"seed {sys.argv[1]}: {found.bundles} bundles, {found.surveys} surveys, {took_s:.0f} s")
    print(dict(found.counts), "refused at the end:", dict(found.refused), "left:", found.left)
