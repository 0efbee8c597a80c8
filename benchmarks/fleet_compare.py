"""Compare two versions of an archive that differ by a known turn of the rig, and see that it is found.

    python benchmarks/fleet_compare.py FOLDER [--recordings 30] [--yaw-deg 0.02] [--workers 2]

One crane's recordings of as many yards are drawn, then measured by `barsight fleet` with its rig file as it
is, with that file written with another comment (the same rig under another digest), and with the right
camera turned by the yaw. Two comparisons are printed: of the first two, which must find nothing, and of the
first with the last. What is done in FOLDER is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.calibration.files.rig_file import write_rig_file
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.open import open_recording
from fleet_rounds import SMALL, call

RIG = ("--camera.rig-seed", "1")


def write_rigs(folder: Path, yaw_deg: float) -> list[Path]:
    """Write the crane's rig file, the same with a comment, and the turned one."""
    own = open_recording(folder / "archive" / "r01").rig
    paths = [folder / f"{name}.yaml" for name in ("own", "same", "turned")]
    write_rig_file(paths[0], own)
    paths[1].write_text(paths[0].read_text() + "# the same rig\n")
    write_rig_file(paths[2], turn_right_camera(own, np.array([0.0, np.radians(yaw_deg), 0.0])))
    return paths


def main() -> None:
    """Draw, measure, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=int, default=30)
    parser.add_argument("--yaw-deg", type=float, default=0.02)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    folder = given.folder.absolute()
    (folder / "archive").mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text('preset = "fast"\n')
    for number in range(1, given.recordings + 1):
        if not (out := folder / "archive" / f"r{number:02d}").exists():
            call(folder, "simulate", out, "--seed", 100 + number, *SMALL, *RIG)
    shared = ("--results", folder / "results", "--store", f"sqlite:///{folder}/store.db")
    versions = []
    for rig in write_rigs(folder, given.yaw_deg):
        told = call(
            folder, "fleet", "plan", folder / "archive", *shared, "--config", "config.toml", "--rig", rig
        )
        versions.append(told.split()[1].rstrip(":"))
        print(
            rig.stem, told, call(folder, "fleet", "run", *shared, "--workers", given.workers, "--threads", 1)
        )
    for name, after in zip(("same", "turned"), versions[1:], strict=True):
        out = folder / f"comparison-{name}-{after[:6]}"
        if not out.exists():
            print(name, call(folder, "fleet", "compare", versions[0], after, *shared, "-o", out))
        found = json.loads((out / "comparison.json").read_text())
        for shift in (*found["shifts"], *found["lifts"]):
            print(f"  {name}: {shift}")
        print(f"  {name}: beyond {len(found['beyond'])} of {found['tests']}, vetoes",
              sorted({v for one in found["recordings"] for v in one["vetoes"]}))  # fmt: skip


if __name__ == "__main__":
    main()
