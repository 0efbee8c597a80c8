"""Define the settings of the map."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from barsight.core.settings.values import NOT_NEGATIVE, OVER_0, POSITIVE, expect_ranges


@dataclass(frozen=True)
class MapSettings:
    """The height surface and the contours."""

    cell_m: float | None = None
    """Side of a map cell; 0.01 in the yard, elsewhere chosen to fit the pictures' resolution."""
    min_views: int = 2
    """Minimum number of frames that must see a cell; with fewer it stays unknown (one is enough if the
    recording has only one frame).
    """
    min_shift: float = 0.0
    """Minimum motion of the picture between mapped frames, as a share of its shorter side, at the first
    pair's middle range; in any case at least 24 px there and on the floor. A frame that has hardly moved,
    as of a crane at rest, would confirm the errors of the last one; only the last frame is mapped anyway.
    """
    top_ratio: float = 0.35
    """Minimum number of views, as a share of those of the cell's best-seen height, that a height needs to
    count as a possible occluder; the highest such height may hide what is behind it.
    """
    own_ratio: float = 0.7
    """Minimum share of votes that makes a height part of the surface, among the views with a free line of
    sight to it.
    """
    along_ratio: float = 0.3
    """Minimum share of votes, averaged along a bar or an edge over a height and similar ones, that makes
    the height part of the surface although its own share is below own_ratio.
    """
    gate_sigma: float = 3.0
    """Heights that differ by at most this many sigma are one surface."""
    min_gate_m: float = 0.015
    """Heights that differ by at most this much are one surface, however small their sigma."""
    along_m: float = 0.26
    """Distance to either side over which heights are averaged along the direction in which they are most
    alike (a bar's own), at most 28 cells; 0 leaves each cell as it is.
    """
    sharpen_px: float = 1.25
    """Blur across the bars that is undone, in pixels (sigma): matching's window lowers crests and raises
    valleys as such a blur does. Heights averaged along a bar are moved back by the same amount, and their
    sigma grows with it; 0 leaves both unchanged.
    """
    thin_bars: Literal["sigma", "drawn"] = "sigma"
    """Use of the orthophoto's stripes where bars are too thin to show in the heights: `sigma` adds the
    hidden relief to the heights' sigma; `drawn` draws round bars over the heights, which is closer in the
    median on stacks of thin bars, but further off on piles of irregular ones, whose bundles are then found
    less well.
    """
    fill_m: float = 0.03
    """Maximum distance of an unknown cell from seen cells on opposite sides for it to be filled; filled
    cells are flagged.
    """
    carve_gullies: bool = False
    """Prove unseen gullies beside bundles free by space carving: at no height does the place look
    alike to all views. It assumes that nothing dark and glossy lies there: a highlight that comes and goes
    looks the same.
    """
    max_sigma_m: float = 0.5
    """Maximum sigma of a point's depth; less certain points are left out."""
    resident_tiles: int = 64
    """Maximum number of tiles of 256 x 256 cells kept in memory (7 MiB each), and no more than the last
    view has touched; the others are stored on disk.
    """
    contours: Literal["fused", "paper"] = "fused"
    """Processing of the contours. fused: the surface as it is, unknown where it wasn't seen. paper: the
    paper's median, cubic interpolation and filter; interpolated samples are flagged as filled.
    """
    laser: Literal["compare", "fuse"] = "compare"
    """Use of the laser. compare: its profiles stay out of the map, as an independent reference. fuse:
    profiles that agree with vision are fused into the map, and the reported agreement is that of vision
    before fusion; profiles that are off are named and left out.
    """
    laser_sigma_m: float = 0.002
    """Sigma of a laser point's height in a cell; the `sensor.yaml` value is used if it is larger."""
    laser_off_m: float = 0.01
    """Offset in height that vision must be able to reveal (twice as much along x) for a profile to be
    fused; coarser maps need a larger value.
    """
    profile_y_m: tuple[float, ...] = ()
    """Values of y at which to cut contours; if empty, at the laser's profiles, or in the middle without a
    laser.
    """

    def __post_init__(self) -> None:
        expect_ranges(
            self, "map.", cell_m=(0.001, 10), min_views=(1, inf), resident_tiles=(16, inf),
            min_shift=(0, 0.5), sharpen_px=(0, 5), top_ratio=(OVER_0, 1), own_ratio=(OVER_0, 1),
            along_ratio=(OVER_0, 1), gate_sigma=POSITIVE, max_sigma_m=POSITIVE, min_gate_m=NOT_NEGATIVE,
            along_m=NOT_NEGATIVE, fill_m=NOT_NEGATIVE, laser_sigma_m=(1e-4, 0.1),
            laser_off_m=(0.001, 0.1),
        )  # fmt: skip
