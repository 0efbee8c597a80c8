"""Judge offered lifts by what truly stands above the faces: `python benchmarks/clearance.py 200:216 FOLDER`.

Draws, renders and measures a small yard per seed, then holds the lifts in `lifts.json` against the truth's
height map alone: nothing of the package judges. FOLDER keeps what was measured.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.simulation.settings import SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.yard.lifting.magnet import example_magnet

BARS = (
    "90mm:7", "60mm:7", "40mm:19", "90mm:7,40mm:19", "60mm:19", "40mm:37", "50mm:7,90mm:7", "60mm:19,25mm:37",
)  # fmt: skip
DANGEROUS_M, STRAY_FIELD_M = 0.015, 0.03
CLEARANCE = {"obstructed", "unknown-under-footprint"}


def main() -> None:
    """Measure the seeds and print the table."""
    first, last = (int(part) for part in sys.argv[1].split(":"))
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "magnet.toml").write_text(example_magnet(), encoding="utf-8")
    offered = dangerous = refused = wrongly = 0
    for seed in range(first, last):
        recording, out = draw(folder, seed)
        lifts = json.loads((out / "lifts.json").read_text(encoding="utf-8"))
        for lift, true_m in rises(recording, lifts, 0.0, "lifts"):
            offered += 1
            if true_m > DANGEROUS_M:
                dangerous += 1
                print(f"seed {seed}, rank {lift['rank']}: {1e3 * true_m:.1f} mm stand above a face")
        for lift, true_m in rises(recording, lifts, STRAY_FIELD_M, "refused"):
            if {veto["code"] for veto in lift["vetoes"]} <= CLEARANCE:
                refused += 1
                wrongly += true_m <= DANGEROUS_M
    print(f"offered {offered}, dangerous {dangerous}")
    print(f"refused for clearance alone {refused}, nothing stands above the faces in {wrongly}")


def draw(folder: Path, seed: int) -> tuple[Path, Path]:
    """Render and measure the yard of a seed, unless it was; recording and result."""
    recording, out = folder / f"recording{seed}", folder / f"result{seed}"
    if not out.exists():
        base = SimulationSettings.demo()
        yard = replace(
            base.yard, max_layers=1 + seed % 4, crossed_ratio=0.0 if seed % 3 else 0.4,
            dunnage_m=(0.05, 0.09, 0.12, 0.2)[seed % 4], gap_m=(0.02, 0.05, 0.01)[seed % 3],
            missing_ratio=(0.08, 0.25)[seed % 2],
        )  # fmt: skip
        simulate(
            recording, replace(base, seed=seed, bars=BARS[seed % 8], yard=yard), lambda done, total: None
        )
        measure_into(recording, out, MeasureSettings(), magnet=folder / "magnet.toml", judged_at="end")
    return recording, out


def rises(
    recording: Path, lifts: dict[str, Any], stray_m: float, which: str
) -> Iterator[tuple[dict[str, Any], float]]:
    """Return each lift and the highest that truly stands above its faces' plane, within the crane's
    tolerance.
    """
    truth = np.load(recording / "truth" / "height.npz")
    x0, y0, z = truth["x"][0], truth["y"][0], truth["z"]
    step_x, step_y = truth["x"][1] - x0, truth["y"][1] - y0
    tolerance = lifts["magnet"]["tolerance"]
    for lift in lifts[which]:
        target = lift["target"]
        if target["z_m"] is None:
            continue
        yaw = math.radians(target["yaw_deg"])
        slope, roll = (math.tan(math.radians(lift[name])) for name in ("pitch_deg", "roll_deg"))
        highest = -math.inf
        for pole in lifts["magnet"]["poles"]:
            long = pole["length_m"] / 2 + tolerance["y_m"] + stray_m
            wide = pole["width_m"] / 2 + tolerance["x_m"] + stray_m
            v, u = np.meshgrid(np.arange(-long, long, 0.01), np.arange(-wide, wide, 0.01))
            v, u = v + pole["along_m"], u + pole["across_m"]
            x = target["x_m"] - v * math.sin(yaw) + u * math.cos(yaw)
            y = target["y_m"] + v * math.cos(yaw) + u * math.sin(yaw)
            i = np.clip(np.round((x - x0) / step_x).astype(int), 0, z.shape[0] - 1)
            j = np.clip(np.round((y - y0) / step_y).astype(int), 0, z.shape[1] - 1)
            highest = max(highest, float((z[i, j] - target["z_m"] - v * slope - u * roll).max()))
        yield lift, highest


if __name__ == "__main__":
    main()
