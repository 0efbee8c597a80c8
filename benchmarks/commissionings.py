"""Commission simulated rigs and compare a dummy bundle's errors with what `barsight budget` states.

`python benchmarks/commissionings.py 8700:8730 OUT.jsonl` writes a line of JSON for each and prints how they
scatter. Every one has its own rig error, drawn from the covariance that its rig file states, its own surveyed
tags, and its own dummy bundle, laid as `accept --plan` asks for it. Tags place the yard, it is measured, and
the bundle is budgeted, all by the commands that a user types.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from acceptance_faults import CAMERA, ORDINARY, wrong_rig

from barsight.acceptance.budgets.error_sources import SHAPE
from barsight.artefacts.plan import AcceptancePlan, DummyBundle
from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.recording.open import open_recording
from barsight.registration.surveyed_targets import read_tags
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.simulation.worlds.artefacts import lay_artefacts
from barsight.simulation.worlds.tags import lay_tags

AREA = ((0.2, 3.8), (-1.35, 1.35))
SURVEY_M = 0.001
TAGS, TAG_M = 8, 0.16
PLACE = (0.64, 0.5)
"""Shares of the area where the plan has its dummy bundle."""
FIGURES = ("lift x", "lift y", "lift z", "yaw")


def draw_dummy(rng: np.random.Generator) -> DummyBundle:
    """Draw a dummy bundle of seven bars as `accept --plan` asks for, 12 to 14 pixels wide, which lies across
    the crane's way, not far from where the plan has it.
    """
    diameter, length = round(float(rng.uniform(0.09, 0.1)), 3), round(float(rng.uniform(1.3, 1.5)), 2)
    x, y = (
        float(low + share * (high - low) + rng.normal(0, 0.1))
        for share, (low, high) in zip(PLACE, AREA, strict=True)
    )
    pitch = 1.003 * diameter
    return DummyBundle(
        "dummy", round(x, 3), round(y, 3), round(float(rng.normal(3, 1.5)), 2), length,
        round(2 * pitch + diameter, 4), round(pitch * 3**0.5 + diameter, 4), 7, diameter,
    )  # fmt: skip


def draw_tags(dummy: DummyBundle, rng: np.random.Generator) -> Float64:
    """Spread tags over the yard, half a metre from the bundle's axis and as far apart as they go: (8, 3)."""
    spots = rng.uniform([AREA[0][0], AREA[1][0]], [AREA[0][1], AREA[1][1]], (600, 2))
    yaw = np.radians(dummy.yaw_deg)
    off = spots - (dummy.x_m, dummy.y_m)
    along = np.clip(off @ (-np.sin(yaw), np.cos(yaw)), -dummy.length_m / 2, dummy.length_m / 2)
    away = np.linalg.norm(off - along[:, None] * (-np.sin(yaw), np.cos(yaw)), axis=1)
    free = spots[away > 0.5]
    chosen = [0]
    while len(chosen) < TAGS:
        chosen.append(int(np.linalg.norm(free[:, None] - free[chosen], axis=2).min(axis=1).argmax()))
    return np.column_stack([free[chosen], rng.uniform(0.03, 0.6, TAGS)])


def write_rig(path: Path, recording: Path, rng: np.random.Generator) -> list[float]:
    """Write the rig file of a calibration, off by what its own covariance states; return the errors."""
    rig = open_recording(recording).rig
    errors = [float(rng.normal(0, sigma)) for sigma in ORDINARY]
    names = [f"{cam}.{name}" for cam in ("cam0", "cam1") for name in ("fx_px", "fy_px")]
    by = np.zeros((6, 3))  # of the parameters by yaw, baseline and both cameras' focal ratio
    by[:4, 2] = [getattr(cam, name) for cam in (rig.cam0, rig.cam1) for name in ("fx_px", "fy_px")]
    by[4, 0], by[5, 1] = 1.0, rig.baseline_m
    covariance = by @ np.diag(np.square([np.radians(ORDINARY[0]), *ORDINARY[1:]])) @ by.T
    named = [*names, "cam1_from_cam0.ry_rad", "cam1_from_cam0.tx_m"]
    section = {"parameters": named, "covariance": covariance.tolist()}
    write_rig_file(path, wrong_rig(rig, *errors), section=section)
    return errors


def commission(seed: int, work: Path) -> dict[str, object]:
    """Commission one rig; return errors and the budget's sigma, with and without the shape."""
    rng = np.random.default_rng((seed, 31))
    dummy = draw_dummy(rng)
    tags = draw_tags(dummy, rng)
    settings = SimulationSettings(length_m=4.0, frames=10, seed=seed, camera=CAMERA, depth_views=0)
    laid = lay_artefacts(AcceptancePlan("simulated", dummy_bundle=(dummy,)), settings)
    survey = work / "tags.csv"
    write_tags(survey, tags)
    simulate(work / "recording", settings, laid=lay_tags(laid, read_tags(survey), TAG_M, settings))
    write_tags(survey, tags + rng.normal(0, SURVEY_M, tags.shape))
    rig_errors = write_rig(work / "rig.yaml", work / "recording", rng)
    rig = ["--recording.rig", str(work / "rig.yaml")]
    yard, out, told = work / "yard.yaml", work / "measured", work / "budget.json"
    row: dict[str, object] = {"seed": seed, "rig": rig_errors, "yaw_deg": dummy.yaw_deg}
    for command in (
        ["calibrate", "yard", str(work / "recording"), "--tags", str(survey), *rig, "-o", str(yard)],
        ["measure", str(work / "recording"), "-o", str(out), *rig, "--yard", str(yard)],
    ):
        if code := run(command):
            return row | {"failed": command[0], "code": code}
    bundles = json.loads((out / "bundles.json").read_text())["bundles"]
    if not bundles:
        return row | {"failed": "no bundle"}
    near = min(
        bundles,
        key=lambda b: abs(complex(b["axis_centre_m"][0] - dummy.x_m, b["axis_centre_m"][1] - dummy.y_m)),
    )
    if run(["budget", str(out), "--bundle", str(near["id"]), "--temperature-k", "0", "-o", str(told)]):
        return row | {"failed": "budget"}
    turn = (near["yaw_deg"] - dummy.yaw_deg + 90) % 180 - 90
    off = [
        1e3 * (a - b)
        for a, b in zip(
            (*near["axis_centre_m"][:2], near["top_z_m"]), (dummy.x_m, dummy.y_m, dummy.top_z_m), strict=True
        )
    ]
    figures = {one["name"]: one for one in json.loads(told.read_text())["figures"]}
    for name, error in zip(FIGURES, (*off, turn), strict=True):
        parts = [(part["source"], part["sigma"]) for part in figures[name]["parts"]]
        row[name] = {"error": error, "parts": parts}
    return row


def write_tags(path: Path, places: Float64) -> None:
    """Write tags as a surveyor lists them."""
    rows = [f"{k},{x:.5f},{y:.5f},{z:.5f},{SURVEY_M}" for k, (x, y, z) in enumerate(places)]
    path.write_text("\n".join(["tag,yard_x,yard_y,yard_z,sigma_m", *rows, ""]))


def print_scatter(rows: list[dict[str, Any]]) -> None:
    """Print scatter and mean error of the figures beside the sigma stated, the shape left out."""
    done = [row for row in rows if "failed" not in row]
    print(f"{len(done)} of {len(rows)} budgeted")
    for name in FIGURES:
        errors = np.array([row[name]["error"] for row in done])
        parts = [[sigma for source, sigma in row[name]["parts"] if source != SHAPE] for row in done]
        stated = np.linalg.norm([np.linalg.norm(one) for one in parts]) / len(done) ** 0.5
        scatter, z = errors.std(ddof=1), errors / [np.linalg.norm(one) for one in parts]
        print(
            f"{name}: mean {errors.mean():.2f}, scatter {scatter:.2f}, stated {stated:.2f}, "
            f"ratio {scatter / stated:.2f}; within 2 sigma {np.mean(np.abs(z) < 2):.3f}"
        )


if __name__ == "__main__":
    first, end = map(int, sys.argv[1].split(":"))
    for number in range(first, end):
        with tempfile.TemporaryDirectory() as folder:
            found = commission(number, Path(folder))
        with Path(sys.argv[2]).open("a") as file:
            file.write(json.dumps(found) + "\n")
    print_scatter([json.loads(line) for line in Path(sys.argv[2]).read_text().splitlines()])
