"""Learn the mean spectra of bundles' shades, `barsight.bundle_pictures.spectra.MEAN_SPECTRA`, or judge them.

`python benchmarks/pitch_spectra.py learn|judge KEEP FIRST:LAST`: KEEP has yards that `barsight bench lifts
--rendered --full-size --keep KEEP` measured with the example magnet; their bundles are found anew. `learn`
prints the table by the bundles with nothing on them, `judge` how all diameters compare with the drawn ones,
by the map alone and by the pictures.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from barsight.benchmarks.lift_judge.magnet import JudgedMagnet, magnet_of
from barsight.benchmarks.yard.drawn_worlds import drawn_scene, judged_yard
from barsight.bundle_pictures.diameters import with_pitch
from barsight.bundle_pictures.measuring import look_at_bundles
from barsight.bundle_pictures.profiles import PitchProfile
from barsight.bundle_pictures.spectra import CLASSES, FREQUENCIES, LOG_RATIOS, log_spectrum
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.bench.seeds import parse_seeds
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.labels.placing import pose_at
from barsight.recording.open import open_recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.result_folder import read_heights, read_path
from barsight.simulation.worlds.recording import cover, is_uncovered
from barsight.simulation.worlds.surfaces import owners
from barsight.simulation.worlds.yards import LOOSE, DrawnBundle, DrawnYard
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.magnet.description import example_magnet
from barsight.yard.magnet.holding import min_diameter_m
from barsight.yard.types import Bundle, YardMap

MIN_SCALE, MIN_BUNDLES = 0.4, 15
"""Least scale of a spectrum's logarithm, and bundles that a place of a table needs."""
ALIKE_RATIOS = 0.5, 1.3
"""Spectra are aligned by their mean between these values of f d, then by their medians."""
MAX_TURN_RAD = 0.2


@dataclass(frozen=True, eq=False)
class SeenBundle:
    """A found bundle, the drawn one about whose axis it lies, and its profiles."""

    bundle: Bundle
    drawn: DrawnBundle
    is_free: bool
    profiles: list[PitchProfile]


@dataclass(frozen=True, eq=False)
class KeptYard:
    """A yard that was measured, its bundles found anew. poses: of its frames by stamp."""

    world: DrawnYard
    pairs: RectifiedPairs
    poses: dict[int, Pose]
    heights: YardMap
    bundles: tuple[Bundle, ...]

    @classmethod
    def of(cls, keep: Path, seed: int, magnet: JudgedMagnet) -> KeptYard:
        """Read a yard's folders."""
        folder = keep / f"seed_{seed}"
        heights, path = read_heights(folder / "measured"), read_path(folder / "measured")
        recording = open_recording(folder / "recording")
        stamps = recording.index.stamps_ns if path is not None else ()
        return cls(
            judged_yard(seed, magnet), RectifiedPairs(recording, Rectifier(recording.rig)),
            {stamp: pose for stamp in stamps if path and (pose := pose_at(path, stamp)) is not None},
            heights, find_bundles(heights, BundleSettings()),
        )  # fmt: skip

    def drawn_ones(self) -> list[tuple[DrawnBundle, bool] | None]:
        """Find for each bundle the drawn one about whose axis it lies, and whether that one is free."""
        scene, owner = drawn_scene(self.world), owners(self.world.yard)
        packs, found = [drawn for drawn in self.world.bundles if drawn.number < LOOSE], []
        for bundle in self.bundles:
            asides = [(abs(aside_m(bundle, drawn)), k) for k, drawn in enumerate(packs)]
            aside, k = min(asides, default=(np.inf, -1))
            found.append(
                (packs[k], is_uncovered(*cover(scene, owner, packs[k]))) if np.isfinite(aside) else None
            )
        return found


def seen_bundles(keep: Path, seed: int, magnet: JudgedMagnet) -> Iterator[SeenBundle]:
    """Sample the profiles of a yard's found bundles of more than one bar."""
    yard = KeptYard.of(keep, seed, magnet)
    shown = look_at_bundles(yard.pairs, yard.poses, yard.heights, yard.bundles, ())
    for bundle, drawn, profiles in zip(yard.bundles, yard.drawn_ones(), shown.profiles, strict=True):
        if drawn is not None and profiles:
            yield SeenBundle(bundle, *drawn, profiles)


def aside_m(bundle: Bundle, drawn: DrawnBundle) -> float:
    """Compute how far a found bundle lies beside a drawn one's middle; inf where it lies outside of it."""
    c, s, radius = np.cos(drawn.yaw_rad), np.sin(drawn.yaw_rad), drawn.diameter_m / 2
    low, high = drawn.cross_m.min(axis=0) - radius, drawn.cross_m.max(axis=0) + radius
    step = bundle.centre_m[:2] - drawn.centre_m[:2]
    aside = float(step @ (c, s)) - float(low[0] + high[0]) / 2
    half = float(high[0] - low[0]) / 2
    turn = abs((bundle.yaw_rad - drawn.yaw_rad + np.pi / 2) % np.pi - np.pi / 2)
    lies = abs(aside) < half and abs(step @ (-s, c)) < drawn.length_m / 2 and turn < MAX_TURN_RAD
    return aside if lies and abs(bundle.top_z_m - drawn.centre_m[2] - high[1]) < half else np.inf


def learn(seen: list[SeenBundle]) -> str:
    """Print the mean and the scale of each class as a table."""
    text = ""
    for number in range(len(CLASSES) + 1):
        rows = []
        for one in (one for one in seen if one.is_free):
            level, length_m = log_spectrum(one.profiles)
            if np.searchsorted(CLASSES, one.drawn.diameter_m / length_m, side="right") == number:
                known = np.isfinite(level)
                at = np.log(FREQUENCIES * one.drawn.diameter_m)[known]
                rows.append(np.interp(LOG_RATIOS, at, level[known], left=np.nan, right=np.nan))
        mean, scale = mean_and_scale(np.array(rows))
        text += f"class {number}: {len(rows)} bundles\n{_lines(mean)}\n        ), (\n{_lines(scale)}\n"
    return text


def mean_and_scale(rows: Float64) -> tuple[Float64, Float64]:
    """Compute the median of spectra (N, R) and 1.48 of its median deviation, smoothed; the nearest known
    ones where too few bundles show any.
    """
    low, high = np.log(ALIKE_RATIOS)
    rows = rows - np.nanmean(rows[:, (low < LOG_RATIOS) & (high > LOG_RATIOS)], axis=1, keepdims=True)
    for _ in range(3):
        rows = rows - np.nanmedian(rows - np.nanmedian(rows, axis=0), axis=1, keepdims=True)
    known = np.isfinite(rows).sum(axis=0) >= MIN_BUNDLES
    mean = np.nanmedian(rows[:, known], axis=0)
    scale = 1.4826 * np.nanmedian(np.abs(rows[:, known] - mean), axis=0)
    mean, scale = (np.interp(LOG_RATIOS, LOG_RATIOS[known], figure) for figure in (mean, scale))
    mean = ndimage.gaussian_filter1d(mean, 0.6, mode="nearest")
    return mean, np.maximum(ndimage.gaussian_filter1d(scale, 0.8, mode="nearest"), MIN_SCALE)


def _lines(figures: Float64) -> str:
    return "\n".join("    " + ", ".join(f"{f:.2f}" for f in part) + "," for part in np.split(figures, 3))


def judge(seen: list[SeenBundle]) -> str:
    """Print how told diameters and their bounds compare with the drawn ones, by diameter."""
    text, drawn = "", np.array([one.drawn.diameter_m for one in seen])
    pictures = [with_pitch(one.bundle, one.profiles) for one in seen]
    for name, bundles in (("map", [one.bundle for one in seen]), ("pictures", pictures)):
        told, sigma = np.array([(b.bar_diameter_m, b.sigma.bar_diameter_m) for b in bundles]).T
        lower = np.array([min_diameter_m(bundle) for bundle in bundles])
        for diameter in (*np.unique(drawn), None):
            own = drawn == diameter if diameter else np.ones(len(drawn), bool)
            ratio = np.quantile(told[own] / drawn[own], [0.05, 0.25, 0.5, 0.75, 0.95])
            text += (
                f"{name:8} {1e3 * (diameter or np.nan):4.0f} mm {own.sum():5} bundles, told over drawn (P5 "
                f"to P95) {' '.join(f'{r:5.2f}' for r in ratio)}; in 95 % "
                f"{(abs(told - drawn) < 1.96 * sigma)[own].mean():.3f}, lower bound holds "
                f"{(lower <= 1.005 * drawn)[own].mean():.3f}, its median over drawn "
                f"{np.median(lower[own] / drawn[own]):.2f}\n"
            )
    return text


def main(task: str, keep: Path, seeds: range) -> None:
    """Sample the yards, and learn or judge."""
    magnet = magnet_of(tomllib.loads(example_magnet()))
    seen = list[SeenBundle]()
    for seed in seeds:
        if (keep / f"seed_{seed}" / "measured" / "result.json").is_file():
            seen += seen_bundles(keep, seed, magnet)
            print(f"{seed}: {len(seen)} bundles so far", file=sys.stderr, flush=True)
    print({"learn": learn, "judge": judge}[task](seen))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), parse_seeds(sys.argv[3], "pitch spectra"))
