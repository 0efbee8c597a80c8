"""Clearance: nothing may stand above the faces' plane under or beside the magnet, seen or not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import yard_maps
from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.clearance import BEAM_CLEAR_M
from barsight.yard.placement.load import leaning_checks
from barsight.yard.types import HeightMap
from barsight.yard.vetoes import vetoes_of
from lift_yards import MAGNET, SETTINGS, SIGMA, codes, judged, laid, map_of, record

TOP_M = laid(0.3).top_z_m


def with_block(
    x_m: tuple[float, float], y_m: tuple[float, float], top_m: float | None, free_m: float = np.inf
) -> HeightMap:
    """One bundle and a block somewhere; without a top the place is unseen, and free from free_m up."""
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    x = heights.x0_m + np.arange(heights.shape[1]) * heights.cell_m
    y = heights.y0_m + np.arange(heights.shape[0]) * heights.cell_m
    rows = np.flatnonzero((y >= y_m[0]) & (y <= y_m[1]))[:, None]
    columns = np.flatnonzero((x >= x_m[0]) & (x <= x_m[1]))
    if top_m is not None:
        heights.z_m[rows, columns] = top_m
        return heights
    free = np.full(heights.shape, np.inf, np.float32)
    free[rows, columns] = free_m
    heights.source[rows, columns] = HeightSource.UNKNOWN
    heights.z_m[rows, columns] = np.nan
    return replace(heights, free_m=free)


def found(heights: HeightMap) -> set[str]:
    return codes(judged([laid(0.3)], (record(laid(0.3)),), Placement(0.3, 0.0, 0.0), heights=heights))


@pytest.mark.parametrize(
    ("x_m", "y_m", "rise_m"),
    [
        ((0.0, 0.6), (0.65, 0.75), 0.06),  # a beam across a pole
        ((0.28, 0.34), (2.3, 2.34), 0.02),  # a buckle under the last pole
        ((0.36, 0.40), (-0.8, -0.4), 0.02),  # beside a face, within the stray field
        ((0.0, 0.6), (-0.05, 0.05), 0.10),  # between two poles, under the beam
        ((0.48, 0.52), (-3.0, 3.0), 0.70),  # a wall
        ((0.0, 0.6), (-0.004, 0.004), 0.30),  # a plate on edge, one cell wide
    ],
)
def test_what_stands_above_the_faces_obstructs(
    x_m: tuple[float, float], y_m: tuple[float, float], rise_m: float
) -> None:
    assert "obstructed" in found(with_block(x_m, y_m, TOP_M + rise_m))


def test_the_beam_passes_over_what_stands_beside_the_load() -> None:
    beside = (0.46, 0.9), (-3.0, 3.0)
    high = MAGNET.beam.above_faces_m - BEAM_CLEAR_M
    assert found(with_block(*beside, TOP_M + high - 0.02)) == set()
    assert found(with_block(*beside, TOP_M + high + 0.02)) == {"obstructed"}
    assert found(with_block((0.36, 0.9), (-0.05, 0.05), TOP_M + 0.1)) == {"obstructed"}, "it lies on the load"


def test_what_is_level_or_further_off_obstructs_nothing() -> None:
    assert found(with_block((0.62, 1.2), (-3.0, 3.0), TOP_M + 0.7)) == set()
    assert found(with_block((0.28, 0.34), (2.3, 2.34), TOP_M + 0.004)) == set()
    assert found(with_block((0.3, 0.3), (0.5, 0.5), TOP_M + 0.3)) == set(), "one wrong match"


@pytest.mark.parametrize("wall", [((0.42, 0.55), (-3.0, 3.0)), ((-0.1, 0.15), (1.0, 2.0))])
def test_unseen_is_an_obstacle_unless_lines_of_sight_pass_there(
    wall: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    assert found(with_block(*wall, TOP_M + 0.7)) == {"obstructed"}
    assert found(with_block(*wall, None)) == {"unknown-under-footprint"}
    assert found(with_block(*wall, None, TOP_M + 0.7)) == {"unknown-under-footprint"}
    assert found(with_block(*wall, None, TOP_M - 0.02)) == set()
    heights = with_block(*wall, None)
    assert found(replace(heights, free_m=None)) == {"unknown-under-footprint"}


def test_an_unseen_face_needs_free_space_down_to_its_plane() -> None:
    place = (0.2, 0.4), (1.07, 1.15)
    assert "unknown-under-footprint" in found(with_block(*place, None, TOP_M + 0.05))
    assert found(with_block(*place, None, TOP_M)) == set()


@pytest.mark.parametrize(("wide_m", "vetoed"), [(0.02, False), (0.06, True)])
def test_a_strip_between_bars_hides_nothing_but_a_wide_one_does(wide_m: float, vetoed: bool) -> None:
    heights = with_block((0.3 - wide_m / 2, 0.3 + wide_m / 2 - 0.005), (-3.0, 3.0), None)
    assert ("unknown-under-footprint" in found(heights)) == vetoed


@pytest.mark.parametrize(("cells", "vetoed"), [(3, False), (4, True)])
def test_beside_the_load_what_wrong_lines_of_sight_leave_of_a_post_forbids(cells: int, vetoed: bool) -> None:
    post = with_block((0.46, 0.53), (1.0, 1.07), None, TOP_M - 0.1)
    assert found(post) == set()
    assert post.free_m is not None
    row, column = (int(abs(axis - at).argmin()) for axis, at in ((post.y_m, 1.02), (post.x_m, 0.48)))
    post.free_m[row : row + cells, column : column + cells] = np.inf
    assert found(post) == ({"unknown-under-footprint"} if vetoed else set())


def test_a_map_that_ends_beside_the_magnet_is_unseen_there() -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 0.4))
    assert "unknown-under-footprint" in found(heights)


WALL = ((0.42, 0.55), (-3.0, 3.0))


def seen_in_part(every: int, top_m: float) -> HeightMap:
    """An unseen wall of which single cells are seen, one in every so many rows and columns."""
    heights = with_block(*WALL, None)
    cells = np.zeros(heights.shape, np.bool_)
    cells[::every, ::every] = True
    cells &= np.isnan(heights.z_m)
    heights.z_m[cells], heights.source[cells] = top_m, HeightSource.VISION
    return heights


@pytest.mark.parametrize("every", [2, 3, 5])
def test_a_wall_that_is_seen_in_part_is_an_obstacle(every: int) -> None:
    assert "obstructed" in found(seen_in_part(every, TOP_M + 0.7))


@pytest.mark.parametrize("every", [2, 4, 7])
def test_single_low_cells_do_not_prove_an_unseen_place_free(every: int) -> None:
    assert found(seen_in_part(every, 0.2)) == {"unknown-under-footprint"}


@pytest.mark.parametrize("cell_m", [0.01, 0.015, 0.02])
def test_one_low_cell_does_not_prove_a_hole_under_a_face_free(
    cell_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yard_maps, "CELL_M", cell_m)
    heights = with_block((0.245, 0.355), (0.745, 0.855), None)
    rows, columns = np.nonzero(heights.source == HeightSource.UNKNOWN)
    middle = len(rows) // 2
    heights.z_m[rows[middle], columns[middle]] = TOP_M - 0.01
    heights.source[rows[middle], columns[middle]] = HeightSource.VISION
    assert "unknown-under-footprint" in found(heights)


def test_a_bound_that_is_no_number_proves_nothing() -> None:
    assert found(with_block(*WALL, None, np.nan)) == {"unknown-under-footprint"}


def test_the_box_that_a_lift_states_is_clear_too() -> None:
    open_yard, beside_wall = (
        judged([laid(0.3)], place=Placement(0.3, 0.0, 0.0), heights=heights)
        for heights in (None, with_block((0.51, 1.2), (-3.0, 3.0), TOP_M + 0.7))
    )
    assert not beside_wall.vetoes
    assert beside_wall.tolerance.x_m == MAGNET.tolerance.x_m < open_yard.tolerance.x_m


def test_faces_must_rest_on_the_load_itself() -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    for pole in MAGNET.poles:
        rows = np.abs(heights.y_m - pole.along_m) < 0.25
        heights.z_m[np.ix_(rows, np.abs(heights.x_m - 0.3) < 0.3)] = TOP_M + 0.018
    assert found(heights) == {"obstructed"}
    unsure = record(laid(0.3), sigma=replace(SIGMA, top_z_m=float("nan")))
    assert "obstructed" in codes(judged([laid(0.3)], (unsure,), Placement(0.3, 0.0, 0.0), heights=heights))


@pytest.mark.parametrize(("x_m", "y_m", "over_m", "passes"), [
    (0.48, 1.5, 0.2, True), (0.48, 1.5, 0.3, False), (0.6, 1.5, 2.0, True), (0.3, 3.2, 2.0, True),
    (0.3, 2.6, 2.0, False), (0.36, 2.5, 0.06, False),
])  # fmt: skip
def test_no_stanchion_that_the_map_does_not_show_stands_in_the_magnet(
    x_m: float, y_m: float, over_m: float, *, passes: bool
) -> None:
    """The beam is 0.3 m wide, 5.4 m long and 0.35 m over the faces, which reach to 0.05 and 2.55 m."""
    settings = replace(SETTINGS, stanchions=((x_m, y_m, TOP_M + over_m),))
    lift = judged([laid(0.3)], settings=settings)
    assert codes(lift) == (set() if passes else {"obstructed"}), lift.vetoes


@pytest.mark.parametrize(("roll_deg", "down_m", "sigma_m", "aside_m", "passes"), [
    (0.0, 0.013, 0.001, 0.0, True), (0.0, 0.016, 0.001, 0.0, False), (-6.0, 0.001, 0.004, 0.0, True),
    (6.0, 0.007, 0.001, 0.0, False), (-6.0, 0.007, 0.001, 0.0, False), (6.0, 0.001, 0.0045, 0.0, False),
    (0.0, 0.003, 0.0072, 0.0, True), (0.0, 0.004, 0.0072, 0.0, False), (6.0, 0.007, 0.001, 0.06, False),
    (6.0, 0.007, 0.001, -0.06, True), (-6.0, 0.007, 0.001, 0.06, True), (-6.0, 0.007, 0.001, -0.06, False),
])  # fmt: skip
def test_the_loads_top_does_not_stand_above_leaning_faces(
    roll_deg: float, down_m: float, sigma_m: float, aside_m: float, *, passes: bool
) -> None:
    """The faces may lie lower than the fitted top, and lean down from there. A map of polished bars was 9 mm
    too low with a sigma of 7.2 mm: tops stood 15 to 19 mm above the stated plane. Where the faces lean down
    beside the load, towards -X for a positive slope, no crest lies beyond the outermost bar's axis.
    """
    bundle, place = record(laid(0.3)), Placement(0.3 + aside_m, 0.0, 0.0)
    z_m = bundle.top_z_m + SETTINGS.strap_m - down_m
    heights, lean_rad = np.full(len(MAGNET.poles), z_m), np.radians(roll_deg)
    contact = Contact(z_m, heights, 0.0, lean_rad, 0.0, sigma_m, 0.0005, 0.0035, ())
    narrow = replace(MAGNET, tolerance=Tolerance(0.02, 0.02, 0.2))
    (check,) = leaning_checks(place, narrow, contact, (bundle,), SETTINGS.strap_m)
    outermost_m = 0.09 * 1.003 + 1.645 * (0.001 / 2 + np.hypot(SIGMA.lateral_m, SIGMA.width_m / 2))
    half_m = min(MAGNET.pole_table[0, 3] / 2 + 0.02, outermost_m + np.sign(roll_deg) * aside_m)
    assert check.value == pytest.approx(1e3 * (down_m + half_m * np.tan(abs(lean_rad))), abs=0.01)
    assert (not vetoes_of([check])) is passes


@pytest.mark.parametrize("askew_deg", [5.0, 90.0])
def test_bars_that_lie_askew_may_have_a_crest_at_the_faces_edge(askew_deg: float) -> None:
    bundle, place = record(laid(0.3)), Placement(0.24, 0.0, np.radians(askew_deg))
    z_m = bundle.top_z_m + SETTINGS.strap_m
    contact = Contact(z_m, np.full(len(MAGNET.poles), z_m), 0.0, 0.1, 0.0, 0.001, 0.0005, 0.0035, ())
    narrow = replace(MAGNET, tolerance=Tolerance(0.02, 0.02, 0.2))
    (check,) = leaning_checks(place, narrow, contact, (bundle,), SETTINGS.strap_m)
    edge_m = MAGNET.pole_table[0, 3] / 2 + narrow.tolerance.along(place.across)
    assert check.value == pytest.approx(1e3 * edge_m * np.tan(0.1), abs=0.01)


@pytest.mark.parametrize("cell_m", [0.01, 0.008, 0.005])
def test_a_plate_on_edge_one_cell_wide_obstructs_whatever_the_maps_cells_are(
    cell_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yard_maps, "CELL_M", cell_m)
    for cell in range(5):
        middle = (cell + 25) * cell_m
        heights = with_block((0.0, 0.6), (middle - 0.4 * cell_m, middle + 0.4 * cell_m), TOP_M + 0.3)
        assert "obstructed" in found(heights)
