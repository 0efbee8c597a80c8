"""Define the records that the yard's stages exchange: bars, bundles and their uncertainty.

All in the yard frame, m and rad. Yaw is the axis's angle from +Y about Z, counter-clockwise, in
(-pi/2, pi/2]: the axis runs along (-sin yaw, cos yaw).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Protocol

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8
from barsight.core.extras import extra
from barsight.core.records.heights import HeightSource
from barsight.yard.axes import axes_of, corners

ENDS = "low-y", "high-y"
"""Names of a bundle's ends."""


UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD = 0.05, 0.005
"""Standard deviations of a length or place (m) and of a yaw (rad) whose own aren't known: with them hardly
anything is certain.
"""


def known_sigma(sigma_m: float) -> float:
    """Return a standard deviation (m), or UNKNOWN_SIGMA_M where it isn't known."""
    return sigma_m if math.isfinite(sigma_m) else UNKNOWN_SIGMA_M


@dataclass(frozen=True, eq=False)
class HeightMap:
    """The map that the yard's stages read: arrays [y, x] with y rising.

    Cell (row, column) has its centre at (x0_m + column * cell_m, y0_m + row * cell_m). z_m, sigma_m: float32,
    NaN where unknown. views: float32. source: `HeightSource`. gray: the orthophoto, levels from 1, 0 where
    nothing was seen; None where there is none. free_m: float32, upper bound of what may stand in the cell by
    lines of sight that passed over it, inf where none did; None where no lines of sight are known. tops: gray
    levels, from 1, of the pictures projected at the height of the tops around (`TopPhoto`), 0 where nothing
    was seen; None where there is no such photo. passes: number of the newest pass that saw the place, from 1,
    0 where none did; None where one pass made the map.
    """

    x0_m: float
    y0_m: float
    cell_m: float
    z_m: Float32
    sigma_m: Float32
    views: Float32
    source: UInt8
    gray: UInt8 | None = None
    free_m: Float32 | None = None
    tops: UInt8 | None = None
    passes: UInt8 | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Return (rows, columns)."""
        rows, columns = self.z_m.shape
        return rows, columns

    @property
    def x_m(self) -> Float64:
        """Return the x of the cells' centres (columns,)."""
        return np.asarray(self.x0_m + self.cell_m * np.arange(self.shape[1]), np.float64)

    @property
    def y_m(self) -> Float64:
        """Return the y of the cells' centres (rows,)."""
        return np.asarray(self.y0_m + self.cell_m * np.arange(self.shape[0]), np.float64)

    @property
    def is_seen(self) -> Bool:
        """Mark the cells (rows, columns) that were seen; filled ones weren't."""
        return HeightSource.measured(self.source)

    def to_xarray(self) -> Any:
        """Return the map as an xarray.Dataset with coordinates `y` and `x` and units as attributes.

        Raises ConfigError where xarray isn't installed.
        """
        with extra("notebook"):
            from xarray import Dataset
        units = {"z_m": "m", "sigma_m": "m", "views": "1", "source": "0 unknown 1 vision 2 laser 3 filled"}
        layers = {name: (("y", "x"), getattr(self, name), {"units": unit}) for name, unit in units.items()}
        centres = {"y": ("y", self.y_m, {"units": "m"}), "x": ("x", self.x_m, {"units": "m"})}
        return Dataset(layers, centres, {"cell_m": self.cell_m})

    def __repr__(self) -> str:
        rows, columns = self.shape
        return f"<HeightMap: {columns} x {rows} cells of {1e3 * self.cell_m:.0f} mm>"

    def _repr_html_(self) -> str:
        """Return a picture of the heights for a notebook."""
        from barsight.yard.map_picture import picture_html

        return picture_html(self.x_m, self.y_m, self.z_m)

    def part(self, rows: slice, columns: slice) -> HeightMap:
        """Cut a rectangle of the map, by cells from start to stop; the arrays are shared."""
        x0_m, y0_m = (
            first + self.cell_m * part.start for first, part in ((self.x0_m, columns), (self.y0_m, rows))
        )
        cut = rows, columns
        return HeightMap(
            x0_m, y0_m, self.cell_m, self.z_m[cut], self.sigma_m[cut], self.views[cut], self.source[cut],
            None if self.gray is None else self.gray[cut],
            None if self.free_m is None else self.free_m[cut],
            None if self.tops is None else self.tops[cut],
            None if self.passes is None else self.passes[cut],
        )  # fmt: skip


class YardMap(Protocol):
    """A height map that may be too large for memory: `part` reads what is needed of it. See `HeightMap`."""

    @property
    def x0_m(self) -> float: ...

    @property
    def y0_m(self) -> float: ...

    @property
    def cell_m(self) -> float: ...

    @property
    def shape(self) -> tuple[int, int]: ...

    def part(self, rows: slice, columns: slice) -> HeightMap: ...


@dataclass(frozen=True, eq=False)
class Bar:
    """The visible part of one bar.

    centre_m: (3,) the axis at the middle of the visible part. direction: (3,) unit vector towards +y.
    length_m: of the visible part. covariance: (5, 5) of the axis's lateral place and height at the centre
    (m), its yaw and pitch (rad) and the diameter (m).
    """

    centre_m: Float64
    direction: Float64
    diameter_m: float
    length_m: float
    covariance: Float64


@dataclass(frozen=True)
class BundleLabel:
    """The label on a bundle. text: None where codes were read, but none with certainty. kind: of code, or
    `illegible`. reads: number of pictures that gave this text. confidence: probability that a further picture
    gives the same, (reads + 1) / (all readings there + 2); 0 where it is illegible.
    """

    text: str | None
    kind: str
    reads: int
    confidence: float


@dataclass(frozen=True)
class BundleSigma:
    """Standard deviation of each quantity of a bundle; NaN where the quantity is unknown."""

    lateral_m: float
    along_m: float
    yaw_rad: float
    length_m: float
    width_m: float
    top_z_m: float
    bar_diameter_m: float
    section_m2: float = float("nan")


@dataclass(frozen=True)
class FitSigma:
    """Standard deviation of each quantity of a fitted outline, assuming that it is the bundle's."""

    lateral_m: float
    along_m: float
    yaw_rad: float
    width_m: float
    top_z_m: float


class DoubtKind(Enum):
    """Kinds of doubts on which decisions depend. A value is the phrase that every sentence of the kind
    contains, and no other does, since files contain only sentences.
    """

    COVERED_END = "end is open: something higher"
    LIES_ACROSS = "lies across it"
    COVERS_PART = "covers a part of it"
    CROSSED = "crosses over it"
    THIN_BAR = "a thin bar lies over it"
    CROSSING_EDGE = "an edge runs over its flank"
    FAINT_LINE = "a thin bar may lie over it"
    UNSEEN_FLANK = "flank was not seen"
    HIDDEN_FLANK = "beside it may lie over its"
    OVERLAP = "overlap: one may lie over the other"
    WALL = "it may be a wall"
    GAP = "a gap as deep as half its width"
    MAY_GO_ON = "it may be wider"
    NO_STRAPS = "no straps that hold it"
    STRAPPED_BAR = "straps cross what looks like one bar"
    RIVAL = "explains the surface nearly as well"
    OTHER = ""


@dataclass(frozen=True)
class Doubt:
    """A doubt about a bundle as described. end: index, in ENDS, of the open end that it concerns."""

    kind: DoubtKind
    sentence: str
    end: int | None = None

    def __post_init__(self) -> None:
        if self.kind.value not in self.sentence:
            raise ValueError(f"no doubt of kind {self.kind.name}: {self.sentence}")

    @classmethod
    def read(cls, sentence: str) -> Doubt:
        """Read a doubt back from a sentence in a file."""
        end = next((k for k, name in enumerate(ENDS) if f"the {name} end is open" in sentence), None)
        return cls(next(kind for kind in DoubtKind if kind.value in sentence), sentence, end)

    @property
    def along_m(self) -> float:
        """Return where along the axis it lies that the doubt concerns, m from the middle, NaN if not told."""
        told = re.search(r"([+-]\d+\.\d+) m from its middle", self.sentence)
        return float(told[1]) if told else math.nan


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle of round bars, or a single heavy bar.

    id: its number in the result, from 0. centre_m: (3,) the axis at mid-length. yaw_rad, pitch_rad: of the
    axis. ends_m: (2, 3) the axis at its low-y and high-y end. ends_open: (2,) True where that end was not
    seen (out of view or covered), so the bundle may be longer. ends_sigma_m: (2,) of the ends along the axis,
    NaN where open. top_z_m: the highest line at mid-length. visible_bars: number of bars seen from above.
    bars: number of bars in the bundle by its outline, None where that isn't certain; section_m2:
    cross-section of steel by what was seen, NaN where that isn't known either. layer: 0 lies on the floor or
    on dunnage. on_top: no other bundle or bar is known to lie on it; None where something unknown lies there.
    cover_doubts: what may still hold it down, such as dunnage or a hidden flank. neighbours: ids of the
    bundles it touches. known_share: share of its outline that was measured. confidence: probability that a
    bundle lies here as described. reasons: all doubts about it. label: None where none was seen, or labels
    weren't read. fit_sigma: of the outline's fit alone; None where straps determine the place instead.
    straps_m: places of straps along the axis, from its middle, that the pictures tell from thin bars.
    map_sigma_z_m: of heights there, including the calibration's part, which the whole map shares and which
    isn't in `sigma`; NaN where it isn't known.
    """

    id: int
    centre_m: Float64
    yaw_rad: float
    pitch_rad: float
    length_m: float
    ends_m: Float64
    ends_open: tuple[bool, bool]
    width_m: float
    top_z_m: float
    bar_diameter_m: float
    visible_bars: int
    bars: int | None
    layer: int
    on_top: bool | None
    neighbours: tuple[int, ...]
    sigma: BundleSigma
    known_share: float
    confidence: float
    reasons: tuple[Doubt, ...]
    bar_axes: tuple[Bar, ...] = ()
    ends_sigma_m: tuple[float, float] = (float("nan"), float("nan"))
    section_m2: float = float("nan")
    cover_doubts: tuple[Doubt, ...] = ()
    label: BundleLabel | None = None
    fit_sigma: FitSigma | None = None
    map_sigma_z_m: float = float("nan")
    straps_m: tuple[float, ...] = ()

    def __repr__(self) -> str:
        size = f"{self.length_m:.2f} m x {self.width_m:.2f} m"
        return f"<Bundle {self.id}: {size} at ({self.centre_m[0]:.2f}, {self.centre_m[1]:.2f}) m>"

    @property
    def is_free(self) -> bool:
        """Check that nothing lies on the bundle, with certainty."""
        return self.on_top is True and not self.cover_doubts

    def with_cover_doubt(self, doubt: Doubt) -> Bundle:
        """Return the bundle with a doubt whether something lies on it, added to both lists of doubts."""
        both = (*self.reasons, doubt), (*self.cover_doubts, doubt)
        return replace(self, reasons=both[0], cover_doubts=both[1])

    @property
    def bottom_z_m(self) -> float:
        """Return the height of the underside: a hexagon reaches as far below its axis as above it."""
        return float(2 * self.centre_m[2] - self.top_z_m)

    @property
    def axes(self) -> Float64:
        """Return unit vectors (2, 2) in plan view: across the axis and along it."""
        return axes_of(self.yaw_rad)

    @property
    def corners_m(self) -> Float64:
        """Compute the corners (4, 2) of the outline in plan view, as `axes.corners` does."""
        return corners(self.centre_m[:2], self.yaw_rad, self.width_m, self.length_m)

    @property
    def direction(self) -> Float64:
        """Return the unit vector (3,) of the axis towards +y."""
        cos_pitch = np.cos(self.pitch_rad)
        return np.array(
            [-np.sin(self.yaw_rad) * cos_pitch, np.cos(self.yaw_rad) * cos_pitch, np.sin(self.pitch_rad)]
        )
