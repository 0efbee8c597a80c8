"""Targets picked on the page, in rendered yards: how far places and frame are off, and whether sigma says so.

`python benchmarks/picked_targets.py FIRST LAST ABOVE_FLOOR_M FOLDER` draws, measures and picks a yard a seed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.page.targets import Pick, place_pick
from barsight.registration.rigid import design_rows
from barsight.registration.surveyed_targets import Targets, write_targets
from barsight.registration.yard import predicted_sigma
from barsight.registration.yard_file import read_yard_file
from barsight.result_folder import read_heights, read_summary
from barsight.yard.lifting.travel_accuracy import Travel

TURN, SHIFT = Rotation.from_rotvec([0.002, -0.001, 0.4]).as_matrix(), np.array([100.0, 20.0, 0.05])
CAMERA = ("--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625")
YARD = ("--yard.max-layers", "2", "--yard.bar-length-m", "5")
SURVEY_M, ASIDE_M, APART_M = 0.001, 0.02, 0.75
"""Noise of a surveyed coordinate; how far beside a disc's middle the click is; targets keep so far apart."""


def laid(rng: np.random.Generator) -> Float64:
    """Draw places (6, 3)."""
    places = np.empty((0, 3))
    while len(places) < 6:
        one = rng.uniform((0.0, -1.4, 0.9), (3.6, 1.4, 1.3))
        if np.all(np.linalg.norm(places[:, :2] - one[:2], axis=1) > APART_M):
            places = np.vstack([places, one])
    return places


def measured(folder: Path, seed: int, places: Float64, above_m: str) -> None:
    """Simulate and measure, where that wasn't done yet."""
    rows = (f"{k + 3},{x:.5f},{y:.5f},{z:.5f}" for k, (x, y, z) in enumerate(places))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "laid.csv").write_text("\n".join(["ring,yard_x,yard_y,yard_z", *rows, ""]))
    words = ("--length", "3.6", "--frames", "12", "--seed", str(seed), "--depth-views", "0", *CAMERA, *YARD)
    words += ("--camera.above-floor-m", above_m)
    recording, out = str(folder / "recording"), str(folder / "out")
    if not (folder / "out" / "result.json").is_file():
        assert run(["simulate", recording, *words, "--tags", str(folder / "laid.csv"), "--tag-m", "0.1"]) == 0
        assert run(["measure", recording, "-o", out]) == 0


def picked(folder: Path, seed: int, above_m: str) -> list[str]:
    """Pick in one yard; a row of the table for its targets each, one for the frame."""
    rng = np.random.default_rng(seed)
    places = laid(rng)
    measured(folder, seed, places, above_m)
    heights, told, found = read_heights(folder / "out"), [], []
    travel = Travel.read(read_summary(folder / "out"))
    for k, place in enumerate(places):
        turn = rng.uniform(0, 2 * np.pi)
        click = place[:2] + ASIDE_M * np.array([np.cos(turn), np.sin(turn)])
        paper = place[:2] + 0.075 * np.array([np.cos(k), np.sin(k)])
        for pick in (Pick(f"post {k}", *click), Pick(f"post {k}", *paper, is_exact=True)):
            try:
                one = place_pick(heights, travel, pick)
            except InputError as error:
                told.append(f"{seed} {error}")
                continue
            off = one.place_m - place
            told.append(f"{seed} {k} {one.found} " + " ".join(f"{1e3 * v:.2f}" for v in (*off, *one.sigma_m)))
            if not pick.is_exact:
                found.append((k, one))
    return [*told, frame_off(folder, places, found, rng)]


def frame_off(folder: Path, places: Float64, found: list, rng: np.random.Generator) -> str:
    """Calibrate with four, check with two; the worst of six places under the frame against the truth."""
    true = places @ TURN.T + SHIFT
    numbers = [k for k, _ in found]
    sigma = np.array([np.sqrt(SURVEY_M**2 + (one.sigma_m**2).mean()) for _, one in found])
    targets = Targets(
        tuple(f"post {k}" for k in numbers), (true + rng.normal(0, SURVEY_M, true.shape))[numbers],
        np.array([one.place_m for _, one in found]), sigma, np.array(numbers) > 3,
    )  # fmt: skip
    (folder / "targets.csv").write_text(write_targets(targets))
    words = ["calibrate", "yard", str(folder / "targets.csv"), "--measured", str(folder / "out")]
    if run([*words, "-o", str(folder / "yard.yaml")]) != 0:
        return f"{folder.name} frame refused"
    frame = read_yard_file(folder / "yard.yaml")
    off = np.linalg.norm(frame.yard_from.apply(places) - true, axis=1)
    design = design_rows(places @ frame.yard_from.rotation.T)
    told = np.sqrt(3) * predicted_sigma(design, frame.covariance, np.zeros(6), np.ones(6, bool))
    k = int(off.argmax())
    return (
        f"{folder.name} frame worst {1e3 * off[k]:.2f} mm of {1e3 * told[k]:.2f}, doubts {len(frame.doubts)}"
    )


if __name__ == "__main__":
    for number in range(int(sys.argv[1]), int(sys.argv[2])):
        print(*picked(Path(sys.argv[4]) / str(number), number, sys.argv[3]), sep="\n", flush=True)
