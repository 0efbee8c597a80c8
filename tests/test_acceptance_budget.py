"""Budgets: against commissionings simulated ray by ray, sampling, and what isn't known."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.acceptance.budgets import error_sources
from barsight.acceptance.budgets.budget import ERRORS, FIGURES, BudgetedLoad, ErrorSource, budget
from barsight.acceptance.budgets.error_sources import SHAPE, fit_sources, measured_load
from barsight.acceptance.observation import ViewGeometry
from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.registration.bending import CraneBend
from barsight.registration.yard_file import YardFrame
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.types import FitSigma
from barsight.yard_frame import with_shared
from lift_yards import laid, map_of, record

VIEW = ViewGeometry(np.array([4.0, 0.2, 8.0]), 1250.0, 0.5)
ORIGIN = np.array([0.0, -2.0, 0.0])
LOAD = BudgetedLoad(np.array([4.0, 1.1, 0.6]), 0.12, 6.0, 0.31, 900.0)
YAW, BASE, FOCAL, TURN, MOVE = np.radians(0.004), 6e-4, 5e-4, np.radians(0.02), 0.002
FRAME = np.diag([TURN**2] * 3 + [MOVE**2] * 3)
FRAME[0, 3] = FRAME[3, 0] = 0.6 * TURN * MOVE


def sources() -> tuple[ErrorSource, ...]:
    def one(name: str, *sigmas: float, names: tuple[str, ...], **more: object) -> ErrorSource:
        return ErrorSource(name, names, np.diag(np.square(sigmas)), "a test", **more)  # type: ignore[arg-type]

    frame = ErrorSource("frame", ERRORS[3:9], FRAME, "targets")
    return (
        one("yaw", YAW, names=("yaw",)), one("base", BASE, names=("baseline",), distribution="rectangular"),
        one("focal", FOCAL, names=("focal",)), frame,
        one("fit", 2e-3, 1e-3, 1.5e-3, 3e-4, names=("fit_along", "fit_across", "fit_top", "fit_yaw")),
    )  # fmt: skip


def commissioned(rng: np.random.Generator) -> Float64:
    """Commission once: a rig and a frame with errors; see both ends of the axis with it as cameras do.

    Rays and rotations as they are, without the model's steps. Returns x, y, z, yaw.
    """
    yaw, focal = rng.normal(0, YAW), 1 + rng.normal(0, FOCAL)
    base = 0.5 * (1 + rng.uniform(-1, 1) * 3**0.5 * BASE)
    turn_move = rng.multivariate_normal(np.zeros(6), FRAME)
    right_turn = Rotation.from_rotvec([0, yaw, 0])
    frame_turn = Rotation.from_rotvec(turn_move[:3])
    found = []
    way = np.array([-np.sin(LOAD.yaw_rad), np.cos(LOAD.yaw_rad), 0.0])
    for share in (-0.5, 0.5):
        point = LOAD.top_m + share * LOAD.length_m * way
        local = (point - [4.0, 0.2, 8.0]) * (1, -1, -1)
        pixel = 1250 * local[:2] / local[2]
        right = right_turn.inv().apply(local - [0.5, 0, 0])
        depth = 1250 * focal * base / (pixel[0] - 1250 * right[0] / right[2])
        seen = np.array([*(pixel / (1250 * focal)), 1.0]) * depth * (1, -1, -1) + [4.0, 0.2, 8.0]
        found.append(frame_turn.apply(seen - ORIGIN) + ORIGIN + turn_move[3:])
    middle, along = (found[0] + found[1]) / 2, found[1] - found[0]
    across = np.array([way[1], -way[0], 0])
    middle = middle + rng.normal(0, 2e-3) * way + rng.normal(0, 1e-3) * across
    middle[2] += rng.normal(0, 1.5e-3)
    return np.array([*middle, np.arctan2(-along[0], along[1]) + rng.normal(0, 3e-4)])


def scatter_ratios(commissionings: int, seed: int) -> Float64:
    """Scatter of x, y, z and yaw over the budget's sigma, (4,)."""
    figures = budget(LOAD, VIEW, ORIGIN, sources())
    stated = np.array([one.combined.sigma for one in figures[:4]]) / [one[2] for one in FIGURES[:4]]
    rng = np.random.default_rng(seed)
    drawn = np.array([commissioned(rng) for _ in range(commissionings)])
    ratios: Float64 = drawn.std(axis=0, ddof=1) / stated
    return ratios


def test_the_budget_is_what_commissionings_scatter() -> None:
    np.testing.assert_allclose(scatter_ratios(1000, 21), 1, atol=0.08)


def test_sampling_agrees_and_parts_are_told() -> None:
    figures = {one.name: one for one in budget(LOAD, VIEW, ORIGIN, sources())}
    assert all(figures[name].agree for name in ("lift x", "lift y", "lift z", "yaw"))
    z = {part.source: part.sigma for part in figures["lift z"].parts}
    assert z["yaw"] == pytest.approx(1e3 * YAW * 7.4**2 / 0.5, rel=1e-2)
    assert z["base"] == pytest.approx(1e3 * BASE * 7.4, rel=1e-2)
    turn_m = LOAD.top_m[1] - ORIGIN[1]  # a roll lifts by the way from the frame's origin; it moves with it
    variance = (turn_m * TURN) ** 2 + MOVE**2 + (4.0 * TURN) ** 2
    assert z["frame"] == pytest.approx(1e3 * np.sqrt(variance), rel=0.01)
    assert figures["lift z"].combined.expanded == pytest.approx(
        2 * figures["lift z"].combined.sigma, rel=1e-3
    )
    lean = {part.source for part in figures["yaw"].parts}
    assert {"frame", "fit"} <= lean


def test_a_rectangular_part_alone_is_told_apart_by_sampling() -> None:
    """k = 2 covers all of a rectangle: GUM's U is larger than what 95.45 % need, and that is said."""
    only = ErrorSource("warm", ("baseline",), np.array([[BASE**2]]), "a test", "rectangular")
    z = budget(LOAD, VIEW, ORIGIN, (only,))[2]
    assert not z.agree and z.sampled_expanded == pytest.approx(0.9545 * 3**0.5 * z.combined.sigma, rel=0.02)


def test_what_is_not_known_is_not_budgeted() -> None:
    blind = ErrorSource("fit", ("fit_along",), np.array([[np.nan]]), "open end", "t", 4)
    figures = {one.name: one for one in budget(LOAD, VIEW, ORIGIN, (*sources(), blind))}
    assert np.isnan(figures["lift y"].combined.expanded) and not figures["lift y"].agree
    assert np.isfinite(figures["lift z"].combined.expanded)
    unweighed = BudgetedLoad(LOAD.top_m, LOAD.yaw_rad, LOAD.length_m, LOAD.width_m, np.nan)
    assert np.isnan(budget(unweighed, VIEW, ORIGIN, sources())[6].combined.expanded)


def test_what_the_shape_leaves_open_is_a_source_of_its_own() -> None:
    """A dummy bundle's shape is known: its budget is that of the fit alone."""
    one, heights = laid(0.0), map_of([laid(0.0)])
    fit = FitSigma(0.001, 0.02, 0.0006, 0.004, 0.003)
    parts = {
        (source.name, *source.errors): float(source.covariance[0, 0]) ** 0.5
        for source in fit_sources(record(one, fit_sigma=fit), heights)
    }
    assert parts["matching and fit", "fit_across"] == pytest.approx(0.001)
    assert parts[SHAPE, "fit_across"] == pytest.approx((0.003**2 - 0.001**2) ** 0.5)
    assert (SHAPE, "fit_along") not in parts and (SHAPE, "fit_yaw") not in parts
    whole = {(one.name, *one.errors) for one in fit_sources(record(one), heights)}
    assert not any(name[0] == SHAPE for name in whole) and ("matching and fit", "fit_top") in whole


BODY = np.array([20.0, 0.4, 8.0])
OWN = np.diag([1e-12] * 3 + [1e-6] * 3)


def frame_parts(frame: YardFrame, monkeypatch: pytest.MonkeyPatch) -> Float64:
    """Budget a bundle below BODY: sigma (3,) of lift x, y and z, mm, that the frame and the travel cause."""
    one, camera = laid(20.0), RectifiedCamera(1250.0, 800.0, 600.0, 0.5, 0.0, 1600, 1200)
    posed = tuple(PosedFrame(k, Pose("yard", "body", np.eye(3), BODY), OWN) for k in (1, 2))
    way = with_shared(Trajectory("yard", posed, (), ("crane",)), frame)
    travel = Travel.of(way, None, 0, 0, BODY[2] - one.top_z_m, camera, {1, 2}).content()
    told = {
        "reference": "yard", "travel": travel,
        "configuration": {
            "stereo": {"calibration_sigma_px": 0.01},
            "bundles": {"shared_lateral_m": 0.0, "shared_height_m": 0.0},
        },
    }  # fmt: skip
    for name, answer in (
        ("open_folder", (told, None)), ("measured_rig", None), ("_yard_frame", frame),
        ("view_geometry", ViewGeometry(BODY, 1250.0, 0.5)), ("read_heights", map_of([one])),
        ("_chosen", record(one)),
    ):  # fmt: skip
        monkeypatch.setattr(error_sources, name, lambda *_, said=answer, **__: said)
    found = measured_load(Path("folder"), None, None, 0.0)
    figures = budget(found.load, found.view, found.origin_m, found.sources, 1000)[:3]
    named = [[p.sigma for p in one.parts if p.source in ("yard frame", "travel")] for one in figures]
    return np.array([float(np.linalg.norm(parts)) for parts in named])


def frame_of(pose: Pose, covariance: Float64, hangs: Float64 | None, bend: CraneBend | None) -> YardFrame:
    return YardFrame(Path("yard.yaml"), pose, covariance, hangs, None, None, None, (), "", bend)


def test_what_a_bent_cranes_frame_leaves_open_is_budgeted(monkeypatch: pytest.MonkeyPatch) -> None:
    sigma = np.diag([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 6e-3, 2e-4, 4e-3])
    alike = np.eye(9)
    alike[5, 6] = alike[6, 5] = 0.6
    covariance = sigma @ alike @ sigma
    bend = CraneBend((-8.0, 8.0), (0.0, 40.0), np.zeros(3), covariance)
    pose = Pose("yard", "encoders", np.eye(3), np.zeros(3))
    told = frame_parts(frame_of(pose, covariance[:6, :6], None, bend), monkeypatch)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(9), covariance, 20_000)
    top = np.array([20.0, 0.0, laid(20.0).top_z_m])
    shift, tilt = (part[0] for part in bend.slopes(BODY[None]))
    values = errors[:, 6:]
    moved = np.cross(errors[:, :3], top) + errors[:, 3:6]
    moved += values @ shift.T + np.cross(values @ tilt.T, top - BODY)
    assert told == pytest.approx(1e3 * np.hypot(moved.std(axis=0), 1e-3), rel=0.05)


def test_a_frame_that_gives_the_attitude_alone_counts_about_the_body(monkeypatch: pytest.MonkeyPatch) -> None:
    covariance = np.diag(np.square([2e-4, 2e-4, 2e-4, 5e-3, 5e-3, 5e-3]))
    away = np.array([0.0, 0.0, laid(20.0).top_z_m]) - BODY * [0, 1, 1]
    moved = 2e-4 * np.array([np.hypot(away[1], away[2]), abs(away[2]), abs(away[1])])
    for origin in (np.zeros(3), np.array([80.0, -30.0, 1.0])):
        pose = Pose("yard", "world", np.eye(3), origin)
        told = frame_parts(frame_of(pose, covariance, np.eye(3), None), monkeypatch)
        assert told == pytest.approx(1e3 * np.hypot(moved, 1e-3), rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["nowhere"], 3, "no such folder"),
        (["nowhere", "-o", "budget.txt"], 4, "end its name in .json"),
        (["nowhere", "--temperature-k", "-1"], 2, "must lie in 0...100"),
    ],
)
def test_bad_input(arguments: list[str], code: int, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["budget", *arguments]) == code
    assert reason in capsys.readouterr().err


@pytest.mark.slow
def test_a_measured_bundle_is_budgeted(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["measure", str(data / "yard_dev"), "-o", str(out), "--preset", "fast"]) == 0
    assert run(["budget", str(out), "-o", str(tmp_path / "budget.json")]) == 0
    told = json.loads((tmp_path / "budget.json").read_text())
    missing = ("no rig file with a covariance", "no yard file", "no touch-downs")
    assert all(line.startswith(start) for line, start in zip(told["assumed"], missing, strict=True))
    figures = {one["name"]: one for one in told["figures"]}
    assert 1 < figures["lift z"]["combined"]["expanded"] < 40
    assert 0 < figures["yaw"]["combined"]["expanded"] < 1


def test_a_frame_that_the_same_rig_found_takes_up_its_errors() -> None:
    """Targets at the load's height, all about it, move as it does: only what is left of the way counts."""
    rig = ErrorSource("rig", ("yaw", "baseline", "focal"), np.diag(np.square([YAW, BASE, FOCAL])), "a test")
    x, y = np.meshgrid([2.0, 6.0], [-1.0, 3.0])
    level = np.column_stack([x.ravel(), y.ravel(), np.full(4, LOAD.top_m[2])])
    z = [
        budget(LOAD, VIEW, ORIGIN, (rig,), 1000, targets_m=targets)[2].combined.sigma
        for targets in (None, level, level - [0, 0, 0.6])
    ]
    assert z[1] < 0.05 * z[0]
    low = np.array([YAW, BASE, FOCAL]) @ np.diag([(8.0**2 - 7.4**2) / 0.5, 0.6, 0.6])
    assert z[2] == pytest.approx(1e3 * float(np.linalg.norm(low)), rel=0.1)
