"""The judge of lifts against what can be computed by hand."""

from __future__ import annotations

import math
import tomllib

import numpy as np
import pytest
from scipy.optimize import linprog

from barsight.benchmarks.lift_judge.envelopes import Envelope, cut, envelope
from barsight.benchmarks.lift_judge.faces import Spread
from barsight.benchmarks.lift_judge.judge import Judge, LiftVerdict, Target, covered_width
from barsight.benchmarks.lift_judge.lowering import STEEPEST_PITCH, lower
from barsight.benchmarks.lift_judge.magnet import magnet_of
from barsight.simulation.worlds.solids import NOTHING, Solid, SolidYard, box, cylinder
from barsight.yard.magnet.description import example_magnet

MAGNET = magnet_of(
    {
        "own_mass_kg": 1000.0, "capacity_kg": 4000.0, "crane_capacity_kg": 8000.0, "safety_factor": 2.0,
        "poles": [
            {"along_m": v, "across_m": 0.0, "length_m": 0.8, "width_m": 0.1} for v in (-1.0, 1.0)
        ],
        "type": "electro", "battery_backup": True,
        "beam": {"length_m": 3.0, "width_m": 0.3, "above_faces_m": 0.3},
        "pull": {
            "gap_m": [0.0, 0.01, 0.03], "kilopascal": [400.0, 200.0, 0.0], "thickness_m": 0.03,
            "grade_ratio": 1.0, "heat_ratio": 1.0, "duty_ratio": 1.0,
        },
        "tolerance": {"x_m": 0.01, "y_m": 0.02, "yaw_deg": 0.2},
        "limits": {
            "pitch_deg": 3.0, "roll_deg": 6.0, "offset_along_m": 0.3, "offset_across_m": 0.04,
            "overhang_m": 2.0, "gap_m": 0.008, "contact_share": 0.1,
        },
    }
)  # fmt: skip
Y = np.array([0.0, 1.0, 0.0])
NOWHERE = (0.0, 0.0, 0.0)


def bar(x: float, z: float, radius: float = 0.02, length: float = 3.4, bundle: int = 0) -> Solid:
    return cylinder("bar", np.array([x, 0.0, z]), Y, radius, length, bundle)


def plate(*, bundle: int = 0, x: float = 0.0, top: float = 0.3) -> list[Solid]:
    """A plate of steel with a level top; the bar in it is what it weighs: 432 kg."""
    shell = box("strap", np.array([x, 0.0, top - 0.1]), np.array([0.25, 3.4, 0.2]), bundle=bundle)
    return [shell, bar(x, top - 0.1, 0.0718, bundle=bundle)]


def judged(*solids: Solid, target: Target | None = None) -> LiftVerdict:
    return Judge(SolidYard(solids), MAGNET).judge(target or Target(0.0, 0.0, 0.0, MAGNET.tolerance))


def test_a_level_plate_is_pulled_as_the_table_says_and_fine() -> None:
    verdict = judged(*plate())
    assert verdict.is_fine, (verdict.dangerous, verdict.unclear)
    assert verdict.pull_n == pytest.approx(2 * 0.8 * 0.1 * 400e3, rel=1e-6)
    assert verdict.figures["a pole's least gap, mm"] == pytest.approx(0.0, abs=1e-3)
    assert verdict.mass_kg == pytest.approx(7850 * math.pi * 0.0718**2 * 3.4)


def test_one_bar_is_pulled_as_much_as_the_maker_says() -> None:
    sheet = tomllib.loads(example_magnet())
    thick = bar(0.0, 0.3, 0.05, 6.0)
    verdict = Judge(SolidYard((thick,)), magnet_of(sheet)).judge(Target(0.0, 0.0, 0.0, NOWHERE))
    # 100 mm: 0.55 of the thick plate's 800 kPa on four faces of 0.9 x 0.1 m, 0.9 of it by the grade.
    assert verdict.pull_n == pytest.approx(0.55 * 0.9 * 800e3 * 4 * 0.9 * 0.1, rel=0.01)


def test_bars_are_pulled_as_plates_pi_quarters_as_thick() -> None:
    sheet = tomllib.loads(example_magnet())
    del sheet["pull"]["round_diameter_m"], sheet["pull"]["round_ratio"]
    gap = np.array([0.0, 0.0035, 0.05])
    thick = magnet_of(sheet).bar_pressure(gap, 0.1, 0.1)
    assert thick == pytest.approx([0.9 * 800e3, 0.9 * 635e3, 0.0])
    half = magnet_of(sheet).bar_pressure(gap, 0.005 * 4 / math.pi, 0.1)
    assert half == pytest.approx([0.25 * 0.9 * 150e3, 0.25 * 0.9 * 137.5e3, 0.0])
    del sheet["pull"]["thickness_m"], sheet["pull"]["thin"], sheet["type"]
    # Flux through both sides of a 20 mm plate at 1.6 T, over a face 0.1 m wide: 0.64 T.
    unknown = magnet_of(sheet)
    assert unknown.bar_pressure(gap[:1], 0.08 / math.pi, 0.1) == pytest.approx(0.9 * 0.64**2 / 8e-7 / math.pi)
    assert unknown.factor == 3.0


def test_seven_bars_weigh_what_their_sections_do() -> None:
    around = [(0.09 * math.cos(a), 0.2 + 0.09 * math.sin(a)) for a in np.arange(6) * math.pi / 3]
    yard = SolidYard(tuple(bar(x, z, 0.045, 5.0) for x, z in [(0.0, 0.2), *around]))
    kg, centre = yard.load(0)
    assert kg == pytest.approx(7 * 7850 * math.pi / 4 * 0.09**2 * 5.0)
    assert centre == pytest.approx([0.0, 0.0, 0.2])


def test_a_beam_under_one_pole_lifts_and_tilts_the_faces() -> None:
    beam = box("beam", np.array([0.0, 1.0, 0.33]), np.array([1.0, 0.1, 0.06]))
    verdict = judged(*plate(), beam, target=Target(0.0, 0.0, 0.0, NOWHERE))
    # The plane turns about the far pole's end, 1.4 m off, over the beam's nearer edge.
    slope = 0.06 / (1.4 + 0.95)
    assert verdict.figures["slope along the beam, deg"] == pytest.approx(math.degrees(slope), abs=0.003)
    assert verdict.figures["foreign over the faces, mm"] == pytest.approx(60, abs=0.01)
    assert any(reason.startswith("foreign over the faces") for reason in verdict.dangerous)
    gaps = slope * (np.arange(0, 0.8, 1e-5) + 0.5e-5)
    assert verdict.pull_n == pytest.approx(MAGNET.pressure(gaps).sum() * 1e-5 * 0.1, rel=0.003)


def test_the_faces_rest_on_two_bars_as_their_common_tangent_does() -> None:
    low, high = bar(-0.03, 0.2), bar(0.03, 0.203)
    verdict = judged(low, high, target=Target(0.0, 0.0, 0.0, NOWHERE))
    lean = math.atan(0.003 / 0.06)
    u = np.arange(-0.05, 0.05, 1e-5) + 0.5e-5
    plane = 0.2015 + 0.02 / math.cos(lean) + u * math.tan(lean)
    away = np.minimum(np.abs(u - 0.03), np.abs(u + 0.03))
    centre = np.where(u > 0, 0.203, 0.2)
    gap = np.where(away < 0.02, plane - centre - np.sqrt(np.maximum(0.02**2 - away**2, 0)), np.inf)
    expected = MAGNET.pressure(gap).sum() * 1e-5 * 1.6
    assert verdict.pull_n == pytest.approx(expected, rel=0.003)


def test_the_share_of_a_pole_follows_the_moments() -> None:
    verdict = judged(*(s.moved(0.15 * Y) for s in plate()), target=Target(0.0, 0.0, 0.0, NOWHERE))
    share = verdict.mass_kg * 9.81 * (0.5 + 0.15 / 2)
    assert verdict.figures["a pole's pull over its share"] == pytest.approx(0.08 * 400e3 / share, rel=1e-6)


def test_the_faces_are_lowered_as_one_linear_programme_over_all_points_says() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        v, u, z = rng.uniform(-1.5, 1.5, 400), rng.uniform(-0.1, 0.1, 400), rng.normal(0.3, 0.004, 400)
        z[rng.random(400) < 0.1] = -np.inf
        rest = lower(v, u, z, rng.integers(0, 16, 400), 0.1)
        there = np.isfinite(z)
        rows = -np.column_stack([np.ones(400), v, u])[there]
        bounds = [(None, None), (-STEEPEST_PITCH, STEEPEST_PITCH), (-0.1, 0.1)]
        best = linprog([1.0, 0.0, 0.0], rows, -z[there], bounds=bounds).x
        assert rest.height == pytest.approx(best[0], abs=2e-6)
        over = z - rest.at(v, u)
        assert over.max() < 1e-6
        assert set(rest.contacts) <= set(np.flatnonzero(over > -1.01e-4)) and len(rest.contacts) >= 2


def test_points_see_the_nearest_cell_of_what_was_drawn() -> None:
    rng = np.random.default_rng(3)
    z, top = rng.normal(size=(30, 40)).astype(np.float32), rng.integers(-1, 5, (30, 40)).astype(np.int32)
    assert NOTHING == -1
    owner = np.array([7, 7, 8, -1, 9], np.int32)
    points = Spread.over(np.array([[0.05, 0.0, 0.2, 0.1], [-0.1, 0.02, 0.1, 0.1]]), 0.01, 0.009)
    found_z, found = points.look(Envelope(-0.15, -0.2, 0.01, z, top), owner, (0.013, -0.021, 0.3))
    turned = (points.u + 1j * points.v) * np.exp(0.3j)
    i = np.rint((turned.real + 0.013 + 0.15) / 0.01).astype(int).clip(0, 29)
    j = np.rint((turned.imag - 0.021 + 0.2) / 0.01).astype(int).clip(0, 39)
    drawn = top[i, j] >= 0
    np.testing.assert_array_equal(found_z, np.where(drawn, z[i, j], -np.inf))
    np.testing.assert_array_equal(found, np.where(drawn, owner[top[i, j]], NOTHING))
    assert 0.5 < drawn.mean() < 1


CASES = {
    "foreign over the faces": [box("wall", np.array([0.07, 0.9, 0.2]), np.array([0.03, 0.5, 0.5]))],
    "under the beam": [box("wall", np.array([0.145, 0.0, 0.4]), np.array([0.03, 0.5, 0.8]))],
    "pull on bundle 1": plate(bundle=1, x=0.16),
    "pull on other steel": [cylinder("stanchion", np.array([0.09, 0.9, 0.149]), np.eye(3)[2], 0.06, 0.298)],
    "covered over a width": [cylinder("bar", np.array([0.0, 1.6, 0.316]), np.eye(3)[0], 0.016, 0.8, 5)],
}  # fmt: skip


@pytest.mark.parametrize("reason", CASES)
def test_each_danger_is_named(reason: str) -> None:
    load = [s.moved(np.array([-0.1, 0, 0])) for s in plate()] if "pull" in reason else plate()
    verdict = judged(*load, *CASES[reason])
    assert [one for one in verdict.dangerous if one.startswith(reason)], verdict.dangerous


@pytest.mark.parametrize(
    ("reason", "target"),
    [
        ("anything over the stated plane", Target(0.0, 0.0, 0.0, NOWHERE, (0.28, 0.0, 0.0))),
        ("true mass over the stated bound", Target(0.0, 0.0, 0.0, NOWHERE, None, 340.0)),
        ("stated bound of the pull", Target(0.0, 0.0, 0.0, NOWHERE, None, 450.0, 81e3)),
        ("centre off across", Target(0.06, 0.0, 0.0, NOWHERE)),
        ("centre off along", Target(0.0, 0.4, 0.0, NOWHERE)),
        ("pull over weight", Target(0.165, 0.0, 0.0, NOWHERE)),
        ("0 bundles lie under the faces", Target(3.0, 0.0, 0.0, NOWHERE)),
    ],
)
def test_a_place_that_is_off_is_dangerous(reason: str, target: Target) -> None:
    assert any(one.startswith(reason) for one in judged(*plate(), target=target).dangerous)


def test_what_lies_in_the_tolerance_alone_is_found() -> None:
    wall = box("wall", np.array([0.075, 0.9, 0.2]), np.array([0.03, 0.5, 0.5]))
    near = judged(*plate(), wall, target=Target(0.0, 0.0, 0.0, NOWHERE))
    assert not near.dangerous and any("beside the faces" in one for one in near.unclear)
    assert judged(*plate(), wall, target=Target(0.0, 0.0, 0.0, (0.015, 0.0, 0.0))).dangerous


def test_faces_that_miss_the_load_and_rest_on_what_is_foreign_are_infinitely_high() -> None:
    walls = [box("wall", np.array([x, 0.0, 0.1]), np.array([0.06, 3.4, 0.2])) for x in (-0.4, 0.4)]
    missed = judged(*plate(), *walls, target=Target(0.0, 0.0, 0.0, (0.4, 0.0, 0.0)))
    assert missed.figures["foreign over the faces, mm"] == math.inf
    assert any(one.startswith("foreign over the faces") for one in missed.dangerous)


def test_a_bar_in_the_groove_of_two_lies_on_both_and_a_neighbour_on_neither() -> None:
    below = [bar(-0.03, 0.02, 0.02, bundle=0), bar(0.03, 0.02, 0.02, bundle=1)]
    above = bar(0.0, 0.02 + math.sqrt(0.04**2 - 0.03**2), 0.02, bundle=2)
    yard = SolidYard((*below, above))
    assert covered_width(yard, 0, (0,)) == pytest.approx(0.01, abs=0.003)
    assert covered_width(yard, 2, (2,)) == 0.0
    assert covered_width(SolidYard(tuple(below)), 0, (0,)) == 0.0


def test_of_two_bundles_each_must_be_held() -> None:
    low = plate(bundle=1, x=0.15, top=0.275)
    yard = SolidYard((*(s.moved(np.array([-0.1, 0, 0])) for s in plate()), *low))
    verdict = Judge(yard, MAGNET, 2).judge(Target(0.0, 0.0, 0.0, NOWHERE))
    # A quarter of the faces is over the second one, 25 mm over it: 50 kPa.
    held = 0.25 * 2 * 0.8 * 0.1 * 50e3 / (432.2 * 9.81)
    assert verdict.figures["pull over weight"] == pytest.approx(held, rel=0.01)
    assert any(one.startswith("pull over weight") for one in verdict.dangerous)


def test_what_is_lifted_along_with_one_load_covers_another() -> None:
    first = [s.moved(np.array([-0.125, 0, 0])) for s in plate()]
    block = [bar(-0.02, 0.32, 0.02, 0.3, 2).moved(1.6 * Y)]
    judge = Judge(SolidYard((*first, *plate(bundle=1, x=0.125), *block)), MAGNET, 2)
    assert set(judge.judge(Target(-0.05, 3.0, 0.0, NOWHERE)).load) == {0, 2}
    both = judge.judge(Target(0.0, 0.0, 0.0, NOWHERE))
    assert set(both.load) == {0, 1} and any(one.startswith("covered") for one in both.dangerous)


def test_a_turned_yard_is_judged_alike() -> None:
    beam = box("beam", np.array([0.3, 1.2, 0.31]), np.array([0.8, 0.1, 0.02]), 0.1)
    yard = SolidYard((*plate(), beam))
    here = Judge(yard, MAGNET).judge(Target(0.0, 0.0, 0.0, NOWHERE))
    turned = yard.seen_from(0.0, 0.0, -math.pi / 2)
    there = Judge(turned, MAGNET).judge(Target(0.0, 0.0, math.pi / 2, NOWHERE))
    assert there.figures == pytest.approx(here.figures, rel=0.01, abs=0.01)


def test_solids_are_cut_where_they_are() -> None:
    leaning = cylinder("bar", np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 1.0]), 0.1, 1.0)
    low, high = cut(SolidYard((leaning,)).table[0], 0.06, 0.0)
    # Across, the half chord is 0.08; along the vertical it is longer by sqrt(2).
    assert (high - low) / 2 == pytest.approx(0.08 * math.sqrt(2)) and (high + low) / 2 == pytest.approx(1.0)
    drawn = envelope(SolidYard((bar(0.0, 0.2), bar(0.1, 0.1))), (-0.05, 0.0), (0.15, 0.0))
    assert drawn.z[[50, 150, 100], 0] == pytest.approx([0.22, 0.12, 0.0])
    assert drawn.top[[50, 150, 100], 0].tolist() == [0, 1, -1]
