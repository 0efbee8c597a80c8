"""Score measurements of drawn worlds against their truth: map, contours, poses, bundles."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance
from barsight.benchmarks.yard.bundle_scores import TrueBundle, read_true_bundles, score_bundles
from barsight.core.arrays import rms
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.pose import Pose
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.stamps import seconds_to_ns
from barsight.evaluation.score import score_folder
from barsight.evaluation.trajectory_error import frame_errors
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.result_folder import read_summary
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.types import Bundle, DoubtKind

UNSEEN = frozenset({
    DoubtKind.UNSEEN_FLANK, DoubtKind.HIDDEN_FLANK, DoubtKind.OVERLAP, DoubtKind.FAINT_LINE,
    DoubtKind.CROSSING_EDGE,
})  # fmt: skip
"""Doubts in `cover_doubts` about what isn't seen to lie on a bundle: a bundle with no other doubts is
reported as free. A beam or bar that is seen across it does cover it in a world's truth.
"""
SEEN_FRAMES, SEEN_RATIO = 2, 0.5
"""A bundle is in view if this many frames see this share of its axis, at least, in both cameras."""
MAP_ROWS = ("contour, smooth places", "contour, everywhere", "height, smooth stack", "height, seen by two")
POSE_ROWS = {
    "ground below the frames: RMSE, mm": "rmse_mm",
    "frames' attitude: RMSE, deg": "turn_rmse_deg",
    "ground below the frames but for one rigid motion: RMSE, mm": "aligned_rmse_mm",
    "frames' attitude but for the same motion: RMSE, deg": "aligned_turn_rmse_deg",
}
BUNDLE_ROWS = {
    "lateral": "mm", "yaw": "deg", "top": "mm", "width": "mm", "diameter": "mm", "low end": "mm",
    "high end": "mm", "mass": "kg",
}  # fmt: skip


@dataclass(frozen=True)
class WorldScore:
    """Scores of one world. refused: reason why it could not be measured, empty if it was.

    maps: figures of `score_folder`, mm. poses: errors of the ground below the frames and of their attitude,
    as they are and after removing one common rigid motion. counts: free bundles in view and found; bundles
    reported as free, how many of those are wrong, and how many have no true bundle at all, free or not;
    numbers of bars reported and right; single bars in view and found. errors, sigmas: of the found bundles by
    figure, m (yaw rad, mass t).
    """

    seed: int
    kind: str
    conditions: tuple[str, ...]
    looked_at: str
    refused: str
    maps: dict[str, dict[str, float]]
    poses: dict[str, float]
    counts: dict[str, int]
    errors: dict[str, list[float]]
    sigmas: dict[str, list[float]]


@dataclass(frozen=True)
class WorldRow:
    """One figure over the worlds of a kind. n: samples behind within_95_pct; seed: of the worst world."""

    kind: str
    figure: str
    n: int
    median: float
    worst: float
    seed: int
    within_95_pct: float


@dataclass(frozen=True)
class WorldBench:
    """All worlds, and their pooled figures."""

    worlds: tuple[WorldScore, ...]
    rows: tuple[WorldRow, ...]
    provenance: Provenance


def score_world(recording: Path, out: Path | None, looked_at: str, refused: str) -> WorldScore:
    """Score the folder that a world was measured into; out: None if measuring was refused."""
    truth = _truth(recording, "world.json")
    names = tuple(name for name, holds in truth["conditions"].items() if holds)
    known = (truth["seed"], truth["kind"], names, looked_at, refused)
    if out is None:
        return WorldScore(*known, {}, {}, {}, {}, {})
    maps = {name: dict(figures) for name, figures in score_folder(recording, out).items()}
    true = read_true_bundles(recording)
    loose = [bool(row.get("is_loose")) for row in _truth(recording, "bundles.json")]
    shown = _shown(recording, true)
    bundles = tuple(t for t, alone, seen in zip(true, loose, shown, strict=True) if seen and not alone)
    bars = tuple(t for t, alone, seen in zip(true, loose, shown, strict=True) if seen and alone)
    found = tuple(replace(b, on_top=_said_free(b)) for b in read_bundles(out / "bundles.json"))
    lying = tuple(replace(t, on_top=True) for t in true)
    scores, single, every, anywhere = (score_bundles(found, part) for part in (bundles, bars, true, lying))
    counts = {
        "free": scores.free, "found": scores.found, "claimed": every.claimed, "wrong": every.wrong,
        "said_count": scores.said_count, "right_count": scores.right_count, "single": single.free,
        "single_found": single.found, "nowhere": anywhere.wrong,
    }  # fmt: skip
    errors = {name: [float(v) for v in values] for name, values in scores.errors.items()}
    sigmas = {name: [float(v) for v in values] for name, values in scores.sigmas.items()}
    return WorldScore(*known, maps, _poses(recording, out), counts, errors, sigmas)


def _said_free(bundle: Bundle) -> bool:
    """Check that a bundle is on top and that nothing is seen to lie on it."""
    return bundle.on_top is True and all(doubt.kind in UNSEEN for doubt in bundle.cover_doubts)


def world_rows(worlds: Sequence[WorldScore]) -> tuple[WorldRow, ...]:
    """Compute the rows of all worlds together, then of each kind."""
    rows: list[WorldRow] = []
    for kind in ("all", *sorted({w.kind for w in worlds})):
        part = [w for w in worlds if kind in ("all", w.kind) and not w.refused]
        rows += _map_rows(kind, part)
        rows += _bundle_rows(kind, part)
    return tuple(rows)


def world_table(bench: WorldBench) -> Table:
    """Tabulate medians, worst cases with their seeds, and shares within the stated 95 % intervals."""
    worlds = bench.worlds
    refused = [w for w in worlds if w.refused]
    looked = sum(bool(w.looked_at) for w in worlds)
    title = f"{len(worlds)} worlds, {len(refused)} of them refused, {looked} looked at before"
    table = Table("kind", "figure", title=title, box=SIMPLE_HEAD)
    for head in ("n", "median", "worst", "seed", "in 95 %"):
        table.add_column(head, justify="right")
    last = ""
    for row in bench.rows:
        if row.kind != last and last:
            table.add_section()
        share = f"{row.within_95_pct:.1f}" if math.isfinite(row.within_95_pct) else "-"
        table.add_row(
            row.kind if row.kind != last else "", row.figure, str(row.n), f"{row.median:.4g}",
            f"{row.worst:.4g}", str(row.seed) if row.seed >= 0 else "-", share,
        )  # fmt: skip
        last = row.kind
    return table


def world_list(bench: WorldBench) -> Table:
    """List the worlds: kind, conditions, whether looked at, what was found, reason of a refusal."""
    table = Table("seed", "kind", "conditions", "looked at", "found", "false", box=SIMPLE_HEAD)
    for w in bench.worlds:
        c = w.counts
        found = f"{c['found']} of {c['free']}" if c else w.refused
        wrong = f"{c['wrong']} of {c['claimed']}" if c else "-"
        table.add_row(str(w.seed), w.kind, ", ".join(w.conditions) or "-", w.looked_at or "-", found, wrong)
    return table


def _map_rows(kind: str, worlds: Sequence[WorldScore]) -> Iterable[WorldRow]:
    for name in MAP_ROWS:
        figures = [(w.maps[name], w.seed) for w in worlds if w.maps.get(name, {}).get("samples")]
        yield from _over_worlds(kind, f"{name}: P95, mm", figures, "p95_mm", max)
        if name == "height, seen by two":
            yield from _over_worlds(
                kind, "cells seen by two that are measured, %", figures, "coverage_pct", min
            )
    poses = [(w.poses, w.seed) for w in worlds if w.poses]
    for name, key in POSE_ROWS.items():
        yield from _over_worlds(kind, name, poses, key, max)


def _over_worlds(
    kind: str, name: str, figures: list[tuple[dict[str, float], int]], key: str,
    worst: Callable[[list[tuple[float, int]]], tuple[float, int]],
) -> Iterable[WorldRow]:  # fmt: skip
    """Compute one figure's median and worst value over the worlds, and its share weighted by samples."""
    values = [(one[key], seed) for one, seed in figures if key in one]
    if not values:
        return
    samples = np.array([one["samples"] for one, _ in figures])
    inside = np.array([one["within_95_pct"] for one, _ in figures])
    has_sigma = key in ("p95_mm", "rmse_mm")
    share = float((samples * inside).sum() / samples.sum()) if has_sigma else math.nan
    bad, seed = worst(values)
    n = round(samples.sum())
    yield WorldRow(kind, name, n, float(np.median([v for v, _ in values])), bad, seed, share)


def _bundle_rows(kind: str, worlds: Sequence[WorldScore]) -> Iterable[WorldRow]:
    for name, unit in BUNDLE_ROWS.items():
        errors = np.array([v for w in worlds for v in w.errors.get(name, ())], np.float64)
        sigmas = np.array([v for w in worlds for v in w.sigmas.get(name, ())], np.float64)
        seeds = [w.seed for w in worlds for _ in w.errors.get(name, ())]
        known = np.isfinite(errors)
        if not known.any():
            continue
        size = np.abs(errors[known]) * (np.degrees(1.0) if unit == "deg" else 1e3)
        inside = np.abs(errors[known]) <= SIGMAS_95 * sigmas[known]
        k = int(size.argmax())
        yield WorldRow(
            kind, f"bundles: {name}, {unit}", len(size), float(np.median(size)), float(size[k]),
            seeds[np.flatnonzero(known)[k]], 100 * float(inside.mean()),
        )  # fmt: skip
    for name, part, whole in (
        ("free bundles found, %", "found", "free"),
        ("said to be free and is not, %", "wrong", "claimed"),
        ("said to be free where no bundle lies so, %", "nowhere", "claimed"),
        ("number of bars right where said, %", "right_count", "said_count"),
        ("single bars found, %", "single_found", "single"),
    ):
        shares = [
            (100 * w.counts[part] / w.counts[whole], w.seed) for w in worlds if w.counts.get(whole, 0) > 0
        ]
        if shares:
            bad, seed = (max if whole == "claimed" else min)(shares)
            count = sum(w.counts[whole] for w in worlds)
            yield WorldRow(kind, name, count, float(np.median([v for v, _ in shares])), bad, seed, math.nan)


def _truth(recording: Path, name: str) -> Any:
    return json.loads((recording / "truth" / name).read_text(encoding="utf-8"))


def _shown(recording: Path, true: tuple[TrueBundle, ...]) -> list[bool]:
    """Tell which bundles the cameras had in view, from the truth's count of frames along their axes."""
    with np.load(recording / "truth" / "height.npz") as truth:
        x, y, visible = truth["x"], truth["y"], truth["visible"]
    out = []
    for t in true:
        along = np.linspace(-0.5, 0.5, 41) * t.length_m
        px, py = t.centre_m[0] - along * np.sin(t.yaw_rad), t.centre_m[1] + along * np.cos(t.yaw_rad)
        i, j = (np.rint((p - axis[0]) / (axis[1] - axis[0])).astype(int) for p, axis in ((px, x), (py, y)))
        inside = (i >= 0) & (j >= 0) & (i < len(x)) & (j < len(y))
        seen = inside & (visible[i * inside, j * inside] >= SEEN_FRAMES)
        out.append(bool(seen.mean() >= SEEN_RATIO))
    return out


def _poses(recording: Path, out: Path) -> dict[str, float]:
    """Compare each frame's attitude, and the ground below it, with the truth; empty in `world`."""
    summary = read_summary(out)
    travel = summary.get("travel")
    if summary["reference"] != "yard" or not travel:
        return {}
    path = read_ground_truth(out / "trajectory.tum", reference="yard")
    frames = tuple(
        PosedFrame(int(stamp), pose, np.zeros((6, 6)))
        for stamp, pose in zip(path.stamp_ns, path.poses, strict=True)
    )
    rig = _truth(recording, "rig.json")
    shift = seconds_to_ns(rig["time_offset_s"])
    found = frame_errors(
        Trajectory("yard", frames, (), ()), read_ground_truth(recording, reference="yard"), shift
    )
    if found is None:
        return {}
    poses: dict[int, Pose] = {frame.stamp_ns: frame.reference_from_body for frame in frames}
    sigma_of = dict(zip(travel["stamp_ns"], travel["sigma_m"], strict=True))
    known = np.array([stamp in sigma_of for stamp in found.stamp_ns.tolist()])
    if not known.any():
        return {}
    turn = found.turn_rad[known]
    stamps = found.stamp_ns[known].tolist()
    ground = np.array([poses[stamp].translation for stamp in stamps])
    down = np.array([0.0, 0.0, -1.0]) * ground[:, 2:]
    ground = ground + down
    error = found.place_m[known] + np.cross(turn, down)
    sigmas = [sigma_of[stamp] for stamp in stamps]
    # One rigid motion: the mean rotation, and the mean shift that remains.
    aligned = error - error.mean(axis=0) - np.cross(turn.mean(axis=0), ground - ground.mean(axis=0))
    inside = np.abs(error) <= SIGMAS_95 * np.array(sigmas, np.float64)
    return {
        "samples": float(error.size),
        "rmse_mm": 1e3 * rms(error),
        "max_mm": 1e3 * float(np.linalg.norm(error, axis=1).max()),
        "within_95_pct": 100 * float(inside.mean()),
        "turn_rmse_deg": math.degrees(rms(turn)),
        "aligned_rmse_mm": 1e3 * rms(aligned),
        "aligned_turn_rmse_deg": math.degrees(rms(turn - turn.mean(axis=0))),
    }
