"""Test encoders beside which the crane's body oscillates, and whose stamps jitter, as in drawn worlds."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from drawn_crane_jumps import recorded_crane, told_jumps

SPRINGY = (1440, 1441, 1449, 1475)
"""Worlds whose body oscillates by 4 to 5 mm beside the encoders."""


@pytest.mark.parametrize("seed", SPRINGY)
def test_a_body_that_oscillates_beside_its_encoders_is_no_jump(seed: int) -> None:
    assert told_jumps(*recorded_crane(seed)) == ()


@pytest.mark.parametrize("seed", SPRINGY)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_jump_shows_beside_an_oscillation(seed: int, axis: int) -> None:
    crane, imu = recorded_crane(seed)
    place, middle = crane.position_m.copy(), len(crane.stamp_ns) // 2
    place[middle:, axis] += 0.03
    (jump,) = told_jumps(replace(crane, position_m=place), imu)
    assert (jump.axis, jump.kind) == (axis, "sure")
    assert abs(jump.stamp_ns - int(crane.stamp_ns[middle])) < 150_000_000
    assert jump.size_m == pytest.approx(0.03, abs=0.01)
