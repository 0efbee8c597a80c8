"""Checks are records, vetoes are checks that aren't passed, and what decides a lift is steady."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from barsight.core.stamps import NS_PER_S
from barsight.yard.axes import corners, gap_between
from barsight.yard.events import YardEvent
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.lifting.travel_accuracy import target_covariance
from barsight.yard.magnet.contact import rest_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.vetoes import check_max, check_min, check_true, vetoes_of
from lift_yards import MAGNET, SETTINGS, bare, codes, judged, laid, map_of, record, sure_travel


@pytest.mark.parametrize(
    ("value", "sigma", "result", "close"),
    [(8.9, 1.0, "passed", False), (9.1, 1.0, "failed", True), (10.1, 1.0, "failed", False),
     (math.nan, 1.0, "unknown", False), (1.0, math.nan, "unknown", False)],
)  # fmt: skip
def test_a_figure_within_its_sigma_of_the_limit_is_a_veto_that_says_so(
    value: float, sigma: float, result: str, close: bool
) -> None:
    most = check_max("tilt", "slope", value, 10.0, "deg", "too steep", sigma=sigma)
    least = check_min("tilt", "slope", -value, -10.0, "deg", "too steep", sigma=sigma)
    assert most.result == least.result == result
    assert ("within its uncertainty" in most.reason) == close
    assert [v.code for v in vetoes_of([most, least])] == ([] if result == "passed" else ["tilt"] * 2)
    assert check_true("covered", "free", None, "not known").result == "unknown"


def test_a_lift_is_offered_where_all_checks_pass_and_has_a_veto_for_each_that_does_not() -> None:
    stock = [laid(0.3), laid(0.62)]
    bundles = (record(stock[0], 0), record(stock[1], 1, ends_open=(True, False), confidence=0.2))
    plan = plan_lifts(map_of(stock), bundles, MAGNET, SETTINGS, ())
    (offered,), (refused,) = plan.offered, plan.refused
    assert {check.result for check in offered.checks} == {"passed"}
    assert {"weak-pull", "obstructed", "narrow-tolerance", "covered"} <= {c.code for c in offered.checks}
    wrong = [check for check in refused.checks if check.result != "passed"]
    assert {(v.code, v.reason) for v in refused.vetoes} == {(c.code, c.reason) for c in wrong}
    assert {c.code: c.result for c in wrong} == {"end-open": "unknown", "bundle-doubtful": "failed"}


@pytest.mark.parametrize("x_m", [0.3, 0.305])
def test_a_micrometre_moves_a_contact_by_no_more(x_m: float) -> None:
    heights = map_of([laid(0.3, roll_deg=20.0)])
    one, other = (rest_magnet(heights, Placement(x_m + d, 0.0, 0.0), MAGNET, 0.003) for d in (-1e-6, 1e-6))
    assert one is not None and other is not None
    assert abs(one.centre_z_m - other.centre_z_m) < 1e-5
    assert one.pull_low_n == pytest.approx(other.pull_low_n, rel=5e-3)


def test_tiny_noise_changes_no_offer() -> None:
    stock = [laid(0.3), laid(0.62, roll_deg=11.0), laid(1.0, diameter_m=0.07)]
    bundles = tuple(record(one, k) for k, one in enumerate(stock))
    heights, rng = map_of(stock), np.random.default_rng(5)
    first = {lift.bundles for lift in plan_lifts(heights, bundles, MAGNET, SETTINGS, ()).offered}
    for _ in range(4):
        noisy = replace(heights, z_m=heights.z_m + rng.normal(0, 5e-5, heights.shape).astype(np.float32))
        again = {lift.bundles for lift in plan_lifts(noisy, bundles, MAGNET, SETTINGS, ()).offered}
        assert again == first != set()


def test_a_load_near_its_limit_is_refused_and_says_how_near() -> None:
    lift = judged([laid(0.3)])
    near = judged([laid(0.3)], magnet=replace(MAGNET, capacity_kg=lift.mass.kg + lift.mass.sigma_kg))
    assert codes(near) == {"overweight"}
    assert "within its uncertainty" in near.vetoes[0].reason
    far = judged([laid(0.3)], magnet=replace(MAGNET, capacity_kg=lift.mass.kg - 1))
    assert "(95 %) only" not in far.vetoes[0].reason


def test_the_targets_covariance_turns_with_the_bars() -> None:
    along_y, along_x = record(laid(0.3)), record(laid(0.3, yaw_deg=90.0))
    sigma = along_y.sigma
    one = target_covariance(Placement(0.3, 0.0, 0.0), (along_y,), 0.001, 0.002, None)
    other = target_covariance(Placement(0.3, 0.0, math.pi / 2), (along_x,), 0.001, 0.002, None)
    expected = [sigma.lateral_m**2, sigma.along_m**2, sigma.top_z_m**2 + 5e-6, sigma.yaw_rad**2]
    np.testing.assert_allclose(one, np.diag(expected), atol=1e-15)
    np.testing.assert_allclose(other, np.diag(np.array(expected)[[1, 0, 2, 3]]), atol=1e-15)
    beside = target_covariance(Placement(0.3, 2.0, 0.0), (along_y,), 0.001, 0.002, None)
    assert beside[0, 0] == pytest.approx(sigma.lateral_m**2 + (2.0 * sigma.yaw_rad) ** 2)
    assert beside[0, 3] == pytest.approx(-2.0 * sigma.yaw_rad**2)


def test_gaps_between_rectangles() -> None:
    here = corners((0.0, 0.0), 0.0, 0.4, 6.0)
    assert gap_between(here, corners((1.0, 0.0), 0.0, 0.4, 6.0)) == pytest.approx(0.6)
    assert gap_between(here, corners((0.0, 4.0), math.pi / 2, 1.0, 2.0)) == pytest.approx(0.5)
    assert gap_between(here, corners((0.3, 1.0), 0.7, 0.4, 1.0)) == 0.0


@pytest.mark.parametrize(("after_s", "disturbed"), [(-1, False), (50, True), (103, True)])
def test_what_happened_between_two_looks_of_one_recording_forbids(after_s: int, disturbed: bool) -> None:
    """Its map may show what was there before: of as many views with and without it, the higher counts."""
    at_ns = 10**18 + NS_PER_S * np.array([0, 1, 2, 100, 101, 102], np.int64)
    travel = replace(sure_travel(np.zeros((6, 2)), at_ns), reach_m=10.0, sure_reach_m=8.0)
    stock, bundles = [laid(0.3)], (record(laid(0.3)),)
    event = YardEvent(10**18 + after_s * NS_PER_S, "lift", 0.3, 0.0, 0.0, 7.0, 0.3)
    plan = plan_lifts(
        bare(map_of(stock)), bundles, MAGNET, SETTINGS, (), travel, int(at_ns[-1]), events=(event,)
    )
    assert [codes(lift) for lift in plan.refused] == ([{"disturbed"}] if disturbed else [])


def test_what_happened_near_forbids_and_what_was_far_does_not() -> None:
    stock = [laid(0.3), laid(0.62), laid(3.2)]
    bundles = tuple(record(one, k) for k, one in enumerate(stock))
    event = YardEvent(5, "magnet", 0.62, 0.0, 0.0, 7.0, 0.3)
    plan = plan_lifts(map_of(stock), bundles, MAGNET, SETTINGS, (), events=(event,))
    assert [lift.bundles for lift in plan.offered] == [(2,)]
    assert [codes(lift) for lift in plan.refused] == [{"disturbed"}] * 2
