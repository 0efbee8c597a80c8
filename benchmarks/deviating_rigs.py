"""Measure drawn worlds by deviating rigs: `python benchmarks/deviating_rigs.py KEEP/seed_* -o OUT`.

Each folder is one that `barsight bench worlds --keep KEEP` has written. Worlds are recorded by rigs that are
exactly as calibrated, although sigma allows for a calibration error. Here the calibration's right camera is
turned, about the axis square to baseline and line of sight, by a normal error of the stated size. Prints how
many heights lie in their 95 % intervals, with the exact and with the deviating calibration.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from barsight.core.files import atomic_directory
from barsight.evaluation.score import score_folder
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings

ROWS = ("contour, smooth places", "height, smooth stack", "height, seen by two")
FIGURES = ("median_mm", "p95_mm", "within_95_pct")
TOO_FEW = 100
ERROR_FILE = "error_px.txt"


def turn_right_camera(sensor: Path, left: Path, seed: int) -> float:
    """Turn the right camera of a recording's calibration by a drawn error. Returns it in pixels."""
    yaml = YAML(typ="safe")
    text, other = (yaml.load(path.read_text(encoding="utf-8")) for path in (sensor, left))
    pose, pose0 = (np.reshape(camera["T_BS"]["data"], (4, 4)) for camera in (text, other))
    stated_px = MeasureSettings().stereo.calibration_sigma_px
    error_px = float(stated_px * np.random.default_rng((53, seed)).normal())
    axis = np.cross(pose[:3, 2], pose[:3, 3] - pose0[:3, 3])
    angle_rad = error_px / text["intrinsics"][0]
    pose[:3, :3] = Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
    text["T_BS"]["data"] = pose.ravel().tolist()
    with sensor.open("w", encoding="utf-8") as file:
        yaml.dump(text, file)
    return error_px


def copy_recording(folder: Path, own: Path) -> None:
    """Copy a world's recording into the new folder `own`, with the right camera turned."""
    with atomic_directory(own) as part:
        shutil.copytree(folder / "recording", part / "recording")
        cameras = part / "recording" / "mav0"
        seed = int(folder.name.rsplit("_", 1)[1])
        sensors = (cameras / name / "sensor.yaml" for name in ("cam1", "cam0"))
        (part / ERROR_FILE).write_text(f"{turn_right_camera(*sensors, seed)}\n", encoding="utf-8")


def measure(folder: Path, out: Path) -> tuple[str, float, list[dict[str, dict[str, float]]]]:
    """Measure one world with a deviating calibration; return its name, the error in px and both scores."""
    own = out / folder.name
    if not own.exists():
        copy_recording(folder, own)
    recording, measured = own / "recording", own / "measured"
    if not (measured / "result.json").is_file():
        measure_into(recording, measured, MeasureSettings(), report=False, judged_at="end")
    error_px = float((own / ERROR_FILE).read_text(encoding="utf-8"))
    return folder.name, error_px, [score_folder(recording, each) for each in (folder / "measured", measured)]


def main() -> None:
    """Print each world's figures, exact and deviating, and the shares over all worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    shares: dict[tuple[str, int], list[list[float]]] = {}
    with ProcessPoolExecutor(2) as pool:
        for name, error_px, scores in pool.map(partial(measure, out=given.out), given.folders):
            print(f"{name} {error_px:+.3f} px")
            for row in ROWS:
                for k, score in enumerate(scores):
                    figures = score.get(row, {})
                    if figures.get("samples", 0) >= TOO_FEW:
                        shares.setdefault((row, k), []).append(
                            [figures[one] for one in ("samples", *FIGURES)]
                        )
                        values = ", ".join(f"{figure} {figures[figure]:.1f}" for figure in FIGURES)
                        print(f"  {row}, {('exact', 'deviating')[k]}: {values}")
            sys.stdout.flush()
    for (row, k), pairs in sorted(shares.items()):
        samples, median, p95, inside = np.array(pairs).T
        print(
            f"{row}, {('exact', 'deviating')[k]}: {np.average(inside, weights=samples):.1f} % inside; of "
            f"{len(inside)} worlds {np.sum(inside < 85)} under 85 %, {np.sum(inside < 92)} under 92 %, "
            f"{np.sum(inside > 98)} over 98 %; medians of the worlds' medians and P95 "
            f"{np.median(median):.2f}, {np.median(p95):.2f} mm"
        )


if __name__ == "__main__":
    main()
