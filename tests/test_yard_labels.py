"""Labels on drawn orthophotos of a load: found under a face, and not mistaken for straps or shine."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.core.records.heights import HeightSource
from barsight.yard.lift_settings import UPPER
from barsight.yard.lifting.hold import Hold
from barsight.yard.magnet.contact import FaceHeights, rest_magnet
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import weakest_bundle
from barsight.yard.placement import labels
from barsight.yard.placement.clearance import FacePlane
from barsight.yard.placement.labels import find_labels, rests_on_label
from barsight.yard.plates import plate_masks
from barsight.yard.types import HeightMap
from lift_yards import MAGNET, SETTINGS, codes, judged, laid, map_of, record

PLACE = Placement(0.3, 0.0, 0.0)


def plane(place: Placement, heights: HeightMap) -> FacePlane:
    contact = rest_magnet(heights, place, MAGNET, 0.002)
    assert contact is not None
    return FacePlane.of(contact)


def bars(shape: tuple[int, int]) -> np.ndarray:
    rng = np.random.default_rng(4)
    return 100 * np.exp(rng.normal(0, 0.12, shape)) * (0.7 + 0.5 * np.sin(np.arange(shape[1])) ** 2)


def mark_labels(gray: np.ndarray) -> np.ndarray:
    """Mark labels on a load that fills the picture."""
    return labels.mark_labels(gray, gray > 0)


def test_a_label_is_marked_and_bars_are_not() -> None:
    gray = bars((300, 21))
    assert not mark_labels(gray).any()
    gray[200:, :4] = 250.0
    assert not mark_labels(gray)[:190].any(), "a bright bar"
    gray[150:156, 8:12] = 250.0
    rows, columns = np.nonzero(mark_labels(gray)[:190])
    assert rows.min() >= 149 and rows.max() <= 156 and columns.min() >= 7 and columns.max() <= 12


@pytest.mark.parametrize(("y_m", "under"), [(MAGNET.poles[0].along_m, True), (0.0, False)])
def test_a_label_under_a_face_forbids(y_m: float, under: bool) -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    gray = bars(heights.shape)
    label = np.ix_(np.abs(heights.y_m - y_m) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)
    gray[label] = 250.0
    heights = replace(heights, gray=np.clip(gray, 1, 255).astype(np.uint8))
    found = find_labels(PLACE, heights, MAGNET, plane(PLACE, heights))
    assert len(found) == under
    for one in found:
        assert one.place_under(PLACE) == pytest.approx((y_m, 0.0), abs=0.01)
        assert (one.half_along_m, one.half_across_m) == pytest.approx((0.033, 0.02), abs=0.011)
        assert one.steel_z_m == pytest.approx(laid(0.3).top_z_m, abs=0.004) and one.own_z_m < one.steel_z_m
    lift = judged([laid(0.3)], (record(laid(0.3)),), PLACE, heights=heights)
    assert codes(lift) == ({"gap"} if under else set())


@pytest.mark.parametrize(
    ("diameter_m", "labels_m", "thick_m", "told"),
    [
        (0.03, (), 0.003, ""),
        (0.03, (-2.1,), 0.003, ""),
        (0.03, (-2.1,), 0.006, "of the faces count as in contact"),
        (0.03, (-2.1, 0.7), 0.003, "several labels"),
        (0.09, (-2.1,), 0.003, "of the faces count as in contact"),
    ],
)
def test_thin_bars_are_held_on_one_label_and_the_pull_on_it_is_told(
    diameter_m: float, labels_m: tuple[float, ...], thick_m: float, told: str
) -> None:
    bundle = laid(0.3, bars=61, diameter_m=0.03) if diameter_m == 0.03 else laid(0.3)
    heights = map_of([bundle], x_m=(-1.5, 2.0), sigma_m=0.0005)
    gray = np.full(heights.shape, 90, np.uint8)
    for y_m in labels_m:
        gray[np.ix_(np.abs(heights.y_m - y_m) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)] = 250
    settings = replace(SETTINGS, label_m=thick_m)
    bare, lift = (
        judged([bundle], place=PLACE, settings=settings, heights=replace(heights, gray=photo))
        for photo in (np.full(heights.shape, 90, np.uint8), gray)
    )
    assert codes(bare) == set() and bare.contact is not None and lift.contact is not None
    assert bool(codes(lift)) == bool(told) and all(told in veto.reason for veto in lift.vetoes)
    if labels_m and not told:
        assert lift.contact.pull_low_n < 0.97 * bare.contact.pull_low_n and lift.safety < bare.safety
        assert lift.contact.contact_share < bare.contact.contact_share
    if not told:
        for name in ("centre_z_m", "roll_rad", "pitch_rad"):
            assert getattr(lift.contact, name) == getattr(bare.contact, name)
        off = lift.contact.sigma_m**2 - bare.contact.sigma_m**2
        assert (1e-3**2 < off <= thick_m**2) == bool(labels_m)
        (pull,) = (check for check in lift.checks if check.what == "pull on the load")
        assert pull.value is not None and pull.sigma is not None
        assert pull.value - UPPER * pull.sigma == pytest.approx(lift.contact.pull_low_n)


def test_a_label_whose_heights_were_filled_in_is_one_of_unknown_height() -> None:
    """A filled height 30 mm below the faces' plane would have it lie on a flank."""
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    at = np.ix_(np.abs(heights.y_m - MAGNET.poles[0].along_m) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)
    gray, z_m, source = np.full(heights.shape, 90, np.uint8), heights.z_m.copy(), heights.source.copy()
    gray[at], source[at] = 250, HeightSource.FILLED
    z_m[at] -= 0.03
    faces = plane(PLACE, heights)
    for code, found in ((HeightSource.FILLED, 1), (HeightSource.UNKNOWN, 1), (source[0, 0], 0)):
        source[at] = code
        shown = replace(heights, gray=gray, z_m=z_m, source=source)
        assert len(find_labels(PLACE, shown, MAGNET, faces)) == found


def test_a_lift_is_no_safer_than_on_any_part_of_a_label() -> None:
    """Beside the middle of a face the least pull and the weakest pole are those of different parts."""
    one = laid(0.3, bars=61, diameter_m=0.03)
    heights, load = map_of([one], x_m=(-1.5, 2.0), sigma_m=0.0005), (record(one),)
    gray = np.full(heights.shape, 90, np.uint8)
    gray[np.ix_(np.abs(heights.y_m + 2.4) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)] = 250
    heights = replace(heights, gray=gray)
    lift = judged([one], load, PLACE, heights=heights)
    (label,) = find_labels(PLACE, heights, MAGNET, plane(PLACE, heights))
    faces = FaceHeights.of(heights, PLACE, MAGNET)
    assert faces is not None
    bare = faces.rest(MAGNET, SETTINGS.contact_gap_m)
    held = [
        Hold.of(contact, PLACE, MAGNET, load, lift.needed_n, SETTINGS)
        for contact in rests_on_label(label, PLACE, faces, bare, MAGNET, SETTINGS)
    ]
    least = min(hold.weakest.ratio for hold in held if hold.weakest)
    assert codes(lift) == set() and lift.contact is not None and lift.safety <= least
    assert lift.contact.pull_low_n == min(hold.contact.pull_low_n for hold in held)


def test_a_plate_on_one_bundle_touches_no_other_one() -> None:
    """A label that holds the faces 5 mm off both bundles bears the one under it alone."""
    magnet = replace(MAGNET, poles=tuple(replace(pole, width_m=0.6) for pole in MAGNET.poles))
    stock = [laid(x_m, bars=61, diameter_m=0.03) for x_m in (0.3, 0.62)]
    load, place = tuple(record(one, k) for k, one in enumerate(stock)), replace(PLACE, x_m=0.46)
    contact = rest_magnet(map_of(stock, sigma_m=0.0005), place, magnet, 0.003)
    assert contact is not None
    off = replace(
        contact, plate_m=np.array([(v, u) for v in (-2.1, 2.1) for u in (-0.22, -0.1)]),
        poles=tuple(replace(pole, gap_map_m=pole.gap_map_m + 0.005) for pole in contact.poles),
    )  # fmt: skip
    assert weakest_bundle(contact, magnet, place, load, SETTINGS.strap_m) > 1
    assert weakest_bundle(off, magnet, place, load, SETTINGS.strap_m) == 0
    assert weakest_bundle(off, magnet, place, load[:1] * 2, SETTINGS.strap_m) > 1


def test_a_plate_is_at_least_as_thick_as_the_map_shows() -> None:
    heights = map_of([laid(0.3, bars=61, diameter_m=0.03)], x_m=(-1.5, 2.0))
    at = np.ix_(np.abs(heights.y_m - MAGNET.poles[0].along_m) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)
    gray, z_m = np.full(heights.shape, 90, np.uint8), heights.z_m.copy()
    gray[at] = 250
    z_m[at] += 0.009
    flat = replace(heights, gray=gray)
    highest = []
    for shown in (flat, replace(flat, z_m=z_m)):
        (label,) = find_labels(PLACE, shown, MAGNET, plane(PLACE, shown))
        faces = FaceHeights.of(shown, PLACE, MAGNET)
        assert faces is not None
        bare = faces.rest(MAGNET, SETTINGS.contact_gap_m)
        rests = rests_on_label(label, PLACE, faces, bare, MAGNET, SETTINGS)
        highest.append(max(contact.centre_z_m for contact in rests))
    assert highest[1] - highest[0] > 0.001


@pytest.mark.parametrize("half_m", [(0.03, 0.05), (0.05, 0.03)], ids=["along", "across"])
def test_a_label_with_a_code_forbids(half_m: tuple[float, float]) -> None:
    """Its dark modules keep the middle as dark as bars; a label's edge counts as its middle does."""
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    at_m = MAGNET.poles[0].along_m
    gray = np.clip(bars(heights.shape), 1, 255)
    along, across = np.abs(heights.y_m - at_m), np.abs(heights.x_m - 0.3)
    gray[np.ix_(along <= half_m[1], across <= half_m[0])] = 250.0
    inner = np.ix_(along <= 0.026, across <= 0.026)
    gray[inner] = 150.0 + np.random.default_rng(3).normal(0, 25, gray[inner].shape)
    heights = replace(heights, gray=gray.astype(np.uint8))
    assert codes(judged([laid(0.3)], (record(laid(0.3)),), PLACE, heights=heights)) == {"gap"}
    between = (MAGNET.poles[0].along_m + MAGNET.poles[1].along_m) / 2
    beside = replace(PLACE, y_m=at_m - between)
    assert not find_labels(beside, heights, MAGNET, plane(beside, heights))
    over = replace(plane(PLACE, heights), centre_z_m=plane(PLACE, heights).centre_z_m + 0.03)
    assert not find_labels(PLACE, heights, MAGNET, over), "it lies 30 mm below the faces"


def test_an_askew_label_on_a_bright_bar_is_found_and_a_gleam_is_not() -> None:
    """Levels as on full-size pictures of a drawn yard: a label of 230 on a bar of 175, a cell askew."""
    gray = np.full((40, 15), 120.0, np.float32)
    gray[:, 6:11] = 175.0
    gleam = gray.copy()
    for row in range(17, 23):
        first = 6 + (row >= 20)
        gray[row, first : first + 4] = 230.0
    assert mark_labels(gray).any()
    rows = np.arange(40)[:, None]
    gleam[:, 6:11] += 60 * np.exp(-(((rows - 20) / 8.0) ** 2))
    assert not mark_labels(gleam).any()


@pytest.mark.parametrize("ratio", [1.1, 1.4])
def test_a_dull_label_between_dark_straps_is_marked_on_bright_bars(ratio: float) -> None:
    """Take levels as a rendered tag had that held the faces off: a third brighter than its load."""
    gray = np.full((60, 20), 120.0, np.float32)
    gray[24:27, 6:12] = gray[33:36, 6:12] = 60.0
    gray[27:33, 7:11] = 120.0 * ratio
    assert mark_labels(gray).any() == (ratio > 1.3)


@pytest.mark.parametrize(
    ("levels", "is_label"),
    [
        ([110, 119, 109, 96, 77, 68, 87, 188, 254, 255, 233, 142, 81, 73, 70, 72, 82], True),
        ([150, 148, 156, 164, 163, 161, 185, 211, 215, 214, 201, 176, 155, 157, 153, 144, 147], False),
        ([179, 182, 184, 178, 184, 204, 216, 236, 230, 239, 239, 213, 186, 180, 177, 173, 176], False),
        ([135, 132, 122, 116, 122, 138, 153, 165, 172, 181, 181, 163, 141, 113, 0, 0, 0], False),
        ([206, 205, 205, 189, 204, 252, 252, 250, 243, 244, 252, 202, 193, 213, 208, 208, 206], True),
    ],
    ids=["label", "gleam", "bright gleam", "gleam at an end", "label on polished steel"],
)
def test_a_short_label_ends_at_once_and_a_gleam_fades(levels: list[int], is_label: bool) -> None:
    """Take levels along a bar from a demo's orthophoto, with a label of 36 mm, on bars as mottled."""
    gray = 90 * np.exp(np.random.default_rng(2).normal(0, 0.1, (57, 20))).astype(np.float32)
    gray[20:37, 8:12] = np.array(levels, np.float32)[:, None]
    assert mark_labels(gray).any() == is_label


@pytest.mark.parametrize("blur_cells", [0.5, 1.0, 1.2])
@pytest.mark.parametrize(("bar", "paper"), [(90, 170), (120, 200), (175, 250)])
@pytest.mark.parametrize("size", [(4, 7), (6, 4), (10, 6)], ids=["36 mm", "64 mm", "100 mm"])
def test_labels_are_found_however_a_picture_blurs_them(
    size: tuple[int, int], bar: int, paper: int, blur_cells: float
) -> None:
    rng, found = np.random.default_rng(7), 0
    for _ in range(10):
        gray = bar * np.exp(rng.normal(0, 0.04, (60, 27)))
        gray[28 : 28 + size[0], 10 : 10 + size[1]] = paper
        blurred = ndimage.gaussian_filter(gray, blur_cells).clip(1, 255).astype(np.float32)
        found += mark_labels(blurred)[28 : 28 + size[0], 10 : 10 + size[1]].any()
    assert found >= 9


def test_a_bright_floor_beside_a_narrow_load_hides_no_label() -> None:
    heights = map_of([laid(0.3, bars=1, diameter_m=0.16)], x_m=(-1.5, 2.0))
    gray = np.where(np.abs(heights.x_m - 0.3) < 0.08, 90.0, 170.0) * np.ones(heights.shape)
    at_m = MAGNET.poles[0].along_m
    gray[np.ix_(np.abs(heights.y_m - at_m) < 0.025, np.abs(heights.x_m - 0.3) < 0.02)] = 160.0
    heights = replace(heights, gray=gray.astype(np.uint8))
    assert find_labels(PLACE, heights, MAGNET, plane(PLACE, heights))


@pytest.mark.parametrize("askew_deg", [0.6, 1.1])
def test_bars_a_little_askew_bear_no_label(askew_deg: float) -> None:
    """Bright crests of 80 mm bars jump by a cell to the side, and straps end them, as on drawn yards."""
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    yaw = math.radians(askew_deg)
    u = math.cos(yaw) * (heights.x_m - 0.3) + math.sin(yaw) * heights.y_m[:, None]
    v = math.cos(yaw) * heights.y_m[:, None] - math.sin(yaw) * (heights.x_m - 0.3)
    gray = 60 + 175 * np.abs(np.cos(np.pi * (u - 0.04) / 0.08))
    gray[np.abs(np.mod(v, 0.5) - 0.25) < 0.02] = 60.0
    heights = replace(heights, gray=gray.astype(np.uint8))
    place = replace(PLACE, yaw_rad=yaw)
    assert not find_labels(place, heights, MAGNET, plane(place, heights))


def test_a_strap_is_no_code() -> None:
    """Take levels as on a drawn yard: across crests as white as paper a strap, partly too dark to see."""
    gray = np.full((60, 27), 232.0, np.float32)
    gray[28:32, 10:16] = [
        (117, 137, 135, 114, 106, 120), (58, 0, 63, 62, 0, 60), (0, 71, 0, 0, 74, 66),
        (107, 121, 134, 111, 97, 115),
    ]  # fmt: skip
    flat = np.zeros(gray.shape, np.float32)
    assert not list(plate_masks(gray, flat, (0.1, 0.06)))
    gray[28:33, 10:16] = 145.0
    assert list(plate_masks(gray, flat, (0.1, 0.06))), "a code's dark and white, mixed"


@pytest.mark.parametrize(("beside_m", "found"), [(0.015, True), (0.06, False)])
def test_a_label_that_ends_beside_a_face_counts_two_cells_further(beside_m: float, found: bool) -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    exact = replace(MAGNET, tolerance=Tolerance(0.0, 0.0, 0.0))
    pole = exact.poles[0]
    far = pole.along_m - pole.length_m / 2 - beside_m
    gray = np.full(heights.shape, 90.0)
    rows = (heights.y_m <= far + 1e-6) & (heights.y_m > far - 0.06)
    gray[np.ix_(rows, np.abs(heights.x_m - 0.3) < 0.03)] = 250.0
    heights = replace(heights, gray=gray.astype(np.uint8))
    assert bool(find_labels(PLACE, heights, exact, plane(PLACE, heights))) == found


@pytest.mark.parametrize("exposure", [1.0, 0.5, 0.3])
def test_a_label_in_an_underexposed_picture_is_found(exposure: float) -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    gray = bars(heights.shape)
    gray[np.ix_(np.abs(heights.y_m - MAGNET.poles[0].along_m) < 0.033, np.abs(heights.x_m - 0.3) < 0.02)] = (
        250
    )
    heights = replace(heights, gray=np.clip(exposure * gray, 1, 255).astype(np.uint8))
    assert find_labels(PLACE, heights, MAGNET, plane(PLACE, heights))


@pytest.mark.parametrize(("cells", "may_hide"), [(3, True), (2, False)])
def test_saturated_steel_as_wide_as_a_label_may_hide_one(cells: int, may_hide: bool) -> None:
    gray = np.clip(bars((60, 20)), 1, 200)
    gray[:, 8 : 8 + cells] = 255
    assert mark_labels(gray).any() == may_hide


@pytest.mark.parametrize("exposure", [1.0, 0.6, 0.35])
def test_a_code_on_steel_as_bright_as_its_paper_is_found_in_a_dark_picture(exposure: float) -> None:
    heights = map_of([laid(0.3)], x_m=(-1.5, 2.0))
    along, across = np.abs(heights.y_m - MAGNET.poles[0].along_m), np.abs(heights.x_m - 0.3)
    gray = np.full(heights.shape, 84.0)
    gray[:, across < 0.14] = 225.0
    gray[np.ix_(along < 0.024, across < 0.024)] = 140.0
    heights = replace(heights, gray=np.rint(exposure * gray).astype(np.uint8))
    assert find_labels(PLACE, heights, MAGNET, plane(PLACE, heights))
