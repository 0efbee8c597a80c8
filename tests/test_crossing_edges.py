"""Things across a bundle are told by edges that run over its flanks; straps and dunnage are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from barsight.bundle_pictures.crossing_edges import with_edge
from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.yard.types import Bundle, Doubt, DoubtKind
from drawn_pictures import TOP_M, Pictures, flat_map, looking_down
from lift_yards import record
from yard_maps import Laid

WIDTH_M, LENGTH_M, STRAPS_M = 0.24, 2.0, (-0.6, 0.05, 0.7)
Shade = Callable[[np.ndarray], np.ndarray]


def bundle() -> Bundle:
    """Describe a free bundle along y; its bars are counted, so that nothing but edges is looked for."""
    return replace(
        record(Laid(0.0, 0.0, TOP_M - WIDTH_M / 2, 0.0, length_m=LENGTH_M)), width_m=WIDTH_M, top_z_m=TOP_M
    )


def shaded(*things: tuple[float, float, float, float, float, float]) -> Shade:
    """Shade rough bars with dark straps on a floor, and over both bars (x, y, half the length, half the
    width, turn in degrees, gray level).
    """

    def shade(places: np.ndarray) -> np.ndarray:
        x, y = places[..., 0], places[..., 1]
        on = np.abs(x) < WIDTH_M / 2
        rough = 12 * np.sin(61 * y + 5 * np.sin(37 * x)) * np.sin(83 * x + 3 * np.sin(29 * y))
        level = np.where(on, 110 + 40 * np.abs(np.sin(np.pi * x / 0.04)) + rough, 95 + rough)
        strap = np.abs(y[..., None] - STRAPS_M).min(axis=-1) < 0.01
        level = np.where(on & strap, 55.0, level)
        for at_x, at_y, long, wide, turn_deg, gray in things:
            c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
            u, v = c * (x - at_x) + s * (y - at_y), c * (y - at_y) - s * (x - at_x)
            level = np.where((np.abs(u) < long) & (np.abs(v) < wide), gray, level)
        return np.asarray(level)

    return shade


def edges_of(gray: Shade, one: Bundle) -> list[str]:
    poses = looking_down(0.03, 1)
    (seen,) = measure_from_pictures(Pictures(poses, gray), poses, flat_map(), (one,))  # type: ignore[arg-type]
    return [doubt.sentence for doubt in seen.cover_doubts if doubt.kind is DoubtKind.CROSSING_EDGE]


@pytest.mark.parametrize("gray", [60.0, 200.0])
@pytest.mark.parametrize(("at_x", "turn_deg"), [(0.0, 0.0), (0.14, 12.0), (-0.14, -15.0)])
def test_a_bar_across_is_found_dark_or_bright(gray: float, at_x: float, turn_deg: float) -> None:
    """Its end may lie on the bundle."""
    bar = (at_x, 0.35, 0.25, 0.0125, turn_deg, gray)
    (said,) = edges_of(shaded(bar), bundle())
    along = float(said.split("flank ")[1].split(" m")[0])
    sides = [0.35 + np.tan(np.radians(turn_deg)) * (side * WIDTH_M / 2 - at_x) for side in (-1, 1)]
    assert min(abs(along - side) for side in sides) < 0.03


def test_straps_and_dunnage_are_no_bars() -> None:
    """Dunnage shows beside the bundle only; a bar beside it that doesn't reach it lies in no way."""
    assert edges_of(shaded(), bundle()) == []
    beams = [(side * 0.31, 0.35, 0.19, 0.04, 0.0, 190.0) for side in (-1, 1)]
    assert edges_of(shaded(*beams), bundle()) == []
    assert edges_of(shaded((0.3, 0.35, 0.15, 0.0125, 8.0, 60.0)), bundle()) == []


HIDDEN = Doubt(DoubtKind.HIDDEN_FLANK, "what stands higher beside it may lie over its low flank")


@pytest.mark.parametrize(
    ("away_m", "lower_m", "on_top", "expected"),
    [
        (0.4, 0.0, True, True), (0.4, 0.0, None, True), (0.4, 0.0, False, False), (1.2, 0.0, True, False),
        (0.4, 0.35, True, False),
    ],
)  # fmt: skip
def test_bundles_beside_a_free_one_are_looked_at_too(
    away_m: float, lower_m: float, on_top: bool | None, expected: bool
) -> None:
    """A bar lies across the neighbour alone; what is told to be covered forbids as it is."""
    low, free = TOP_M - lower_m, replace(bundle(), id=1)
    free = replace(free, centre_m=free.centre_m + np.array([away_m, 0.0, 0.0]))
    unsure = replace(bundle(), on_top=on_top, cover_doubts=(HIDDEN,), top_z_m=low)
    poses = looking_down(0.03, 1)
    seen, other = measure_from_pictures(
        Pictures(poses, shaded((0.0, 0.35, 0.25, 0.0125, 0.0, 200.0))),
        poses,
        flat_map(),
        (unsure, free),  # type: ignore[arg-type]
    )
    assert (seen.cover_doubts[-1].kind is DoubtKind.CROSSING_EDGE) == expected
    assert other.is_free


def test_covered_bundles_alone_are_not_looked_at_and_the_doubt_forbids() -> None:
    covered = replace(bundle(), cover_doubts=(HIDDEN,))
    assert edges_of(shaded((0.0, 0.35, 0.25, 0.0125, 0.0, 200.0)), covered) == []
    one = with_edge(bundle(), 0.3)
    assert not one.is_free and one.cover_doubts == one.reasons[-1:]
    earlier = "an edge runs over its flank +0.40 m from its middle: a thin bar may lie over it"
    for sentence in (one.reasons[-1].sentence, earlier):
        assert Doubt.read(sentence).kind is DoubtKind.CROSSING_EDGE


@pytest.mark.parametrize(("line_m", "on_top"), [(0.31, None), (-0.6, True)])
def test_a_line_and_an_edge_at_one_place_leave_open_whether_a_bundle_is_free(
    line_m: float, on_top: bool | None
) -> None:
    """A strap shows as a line, a tag as an edge; only what lies across shows as both."""
    line = Doubt.read(f"a line runs across it {line_m:+.2f} m from its middle: a thin bar may lie over it")
    crossed = with_edge(bundle().with_cover_doubt(line), 0.35)
    assert crossed.on_top is on_top and len(crossed.cover_doubts) == 2
    assert with_edge(replace(bundle(), on_top=False, cover_doubts=(line,)), line_m).on_top is False
