"""Count what becomes of labels on drawn yards: read, said to be illegible, missed, or read wrongly.

    PYTHONPATH=src python benchmarks/drawn_labels.py 8000:8012 [--kind drawn|stacked|near] [--keep DIR]

A label is 100 x 60 mm. drawn: a world of 3 m from `--draw`, about half the bundles bear a label, seen from
7 to 8.6 m by 1280 x 1024 pixels. stacked: a yard where each bundle bears one over its strap, seen from 8 m.
near: one layer of it, seen from 2.5 m at 1 mm a pixel. A label counts where truth has it on top at its middle
and two pairs or more see it. Truth alone judges: outlines in bundles.json tell which bundle a label lies on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

ON_TOP_M, MIN_PAIRS = 0.006, 2
NEAR = [
    "--length", "1.6", "--frames", "10", "--camera.above-floor-m", "2.5", "--camera.focal-px", "2500",
    "--camera.baseline-m", "0.2", "--camera.trolley-y-m", "0.75", "--yard.max-layers", "1",
    "--yard.bar-length-m", "3",
]  # fmt: skip


def barsight(*arguments: str) -> bool:
    done = subprocess.run([sys.executable, "-m", "barsight", *arguments], capture_output=True, text=True)
    if done.returncode:
        print("  ", done.stderr.strip().splitlines()[-1])
    return done.returncode == 0


def visible_labels(recording: Path) -> list[tuple[str, np.ndarray]]:
    heights = np.load(recording / "truth" / "height.npz")
    found = []
    for row in json.loads((recording / "truth" / "labels.json").read_text()):
        place = np.array(row["center"])
        i, j = (int(np.abs(heights[axis] - at).argmin()) for axis, at in zip("xy", place, strict=False))
        inside = all(abs(heights[axis] - at).min() < 0.02 for axis, at in zip("xy", place, strict=False))
        if inside and abs(heights["z"][i, j] - place[2]) < ON_TOP_M and heights["visible"][i, j] >= MIN_PAIRS:
            found.append((row["text"], place))
    return found


def holds(bundle: dict[str, Any], place: np.ndarray) -> bool:
    away = place[:2] - np.array(bundle["axis_centre_m"][:2])
    yaw = np.radians(bundle["yaw_deg"])
    along, across = abs(away @ [-np.sin(yaw), np.cos(yaw)]), abs(away @ [np.cos(yaw), np.sin(yaw)])
    return bool(along <= bundle["length_m"] / 2 and across <= bundle["width_m"] / 2)


def judge(recording: Path, out: Path) -> Counter[str]:
    bundles = json.loads((out / "bundles.json").read_text())["bundles"]
    labels, told, bearing = visible_labels(recording), Counter[str](), set()
    for text, place in labels:
        here = [one for one in bundles if holds(one, place)]
        top = max(here, key=lambda one: one["top_z_m"], default=None)
        label = None if top is None else top["label"]
        bearing |= {one["id"] for one in here}
        if top is None:
            told["on a bundle that is covered or wasn't found"] += 1
        elif label is None:
            told["missed"] += 1
        elif label["text"] is None:
            told["said illegible"] += 1
        else:
            told["read" if label["text"] == text else "on a bundle with another label"] += 1
    there = {row["text"] for row in json.loads((recording / "truth" / "labels.json").read_text())}
    texts = [one["label"]["text"] for one in bundles if one["label"] and one["label"]["text"]]
    blank = [one for one in bundles if one["id"] not in bearing]
    told += Counter(
        labels=len(labels), wrong=sum(text not in there for text in texts), blank=len(blank),
        blank_called_illegible=sum(one["label"] is not None for one in blank),
    )  # fmt: skip
    return told


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("seeds")
    parser.add_argument("--kind", choices=["drawn", "stacked", "near"], default="drawn")
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    first, end = map(int, given.seeds.split(":"))
    total = Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        for seed in range(first, end):
            recording, out = folder / f"{seed}", folder / f"{seed}-out"
            how = {
                "drawn": ["--draw", str(seed), "--length", "3", "--frames", "10"],
                "stacked": ["--seed", str(seed), "--length", "3", "--frames", "8"],
                "near": ["--seed", str(seed), *NEAR],
            }[given.kind]
            label = ["--yard.label-m", "0.1", "0.06", "--depth-views", "0"]
            done = recording.exists() or barsight("simulate", str(recording), *how, *label)
            if done and (
                out.exists() or barsight("measure", str(recording), "-o", str(out), "--labels.read")
            ):
                told = judge(recording, out)
                total += told
                print(seed, dict(told), flush=True)
    print("all", dict(total))


if __name__ == "__main__":
    main()
