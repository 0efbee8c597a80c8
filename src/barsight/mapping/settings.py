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
    """Side of a cell; 0.01 in the yard, else fitted to the pictures' resolution."""
    min_views: int = 2
    """A cell seen in fewer frames is unknown (one is enough where the recording has only one)."""
    min_shift: float = 0.0
    """A frame is matched once its picture has moved by this share of its shorter side; 0 matches them all."""
    top_ratio: float = 0.35
    """What may hide a cell: its highest height that has this share of the best-seen one's views."""
    own_ratio: float = 0.7
    """A height stands that has the votes of this share of the views with a free line of sight to it."""
    along_ratio: float = 0.3
    """Another stands if, averaged along a bar or an edge, it and its like have the votes of this share."""
    gate_sigma: float = 3.0
    """Heights nearer than this many sigma are one surface."""
    min_gate_m: float = 0.015
    """Heights nearer than this are one surface however small their sigma."""
    along_m: float = 0.26
    """Heights are averaged so far to either side, 28 cells at most, along the direction in which they are
    most alike (a bar's own); 0 leaves each cell as it is."""
    sharpen_px: float = 1.25
    """Matching's window lowers crests and lifts valleys across the bars as a blur of so many pixels (sigma)
    does: heights averaged along a bar are moved back by as much, and sigma grows with it; 0 leaves both."""
    thin_bars: Literal["sigma", "drawn"] = "sigma"
    """Use of the orthophoto's stripes, where bars are too thin for heights to show them: `sigma` adds what is
    hidden to the heights' sigma, `drawn` draws round bars over them: nearer in the median on stacks of thin
    bars, further off on piles of irregular ones, whose bundles are then found less well."""
    fill_m: float = 0.03
    """Unknown cells no further than this from seen ones on opposite sides are filled, and flagged so."""
    max_sigma_m: float = 0.5
    """Points less sure than this are left out."""
    resident_tiles: int = 64
    """At most so many tiles of 256 x 256 cells are kept in memory (7 MiB each), and no more than the
    last view has touched; the others wait on disk."""
    contours: Literal["fused", "paper"] = "fused"
    """fused: the surface as it is, unknown where not seen. paper: its median, cubic interpolation and
    filter; what it fills is flagged."""
    laser: Literal["compare", "fuse"] = "compare"
    """compare: the laser's profiles stay out of the map, as its independent reference. fuse: those that agree
    with vision are fused into it; agreement is then that of vision before. Those that are off are named and
    left out."""
    laser_sigma_m: float = 0.002
    """Sigma of a laser point's height on a cell; that of its `sensor.yaml`, where that is larger."""
    laser_off_m: float = 0.01
    """A profile is fused only where vision would show that it is so far off in height, or twice as far along
    x; coarser maps need more."""
    profile_y_m: tuple[float, ...] = ()
    """Where to cut contours; at the laser's profiles when not given, else in the middle."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "map.", cell_m=(0.001, 10), min_views=(1, inf), resident_tiles=(16, inf),
            min_shift=(0, 0.5), sharpen_px=(0, 5), top_ratio=(OVER_0, 1), own_ratio=(OVER_0, 1),
            along_ratio=(OVER_0, 1), gate_sigma=POSITIVE, max_sigma_m=POSITIVE, min_gate_m=NOT_NEGATIVE,
            along_m=NOT_NEGATIVE, fill_m=NOT_NEGATIVE, laser_sigma_m=(1e-4, 0.1),
            laser_off_m=(0.001, 0.1),
        )  # fmt: skip
