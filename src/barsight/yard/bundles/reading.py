"""Define a chosen outline together with the evidence for and against it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from barsight.yard.bundles.fitting.outline_fit import FittedOutline
from barsight.yard.bundles.section.flanks import Flanks, seen_flanks
from barsight.yard.bundles.section.pack_sides import PackSide
from barsight.yard.bundles.section.packs import Pack
from barsight.yard.bundles.section.seen_section import SeenSection

_SAME_RATIO, _SAME_M = 0.12, 0.005
"""Tolerance between an outline's edges and those of the pack that it describes: a fraction of the width, plus
a constant (m).
"""
_BEYOND_RATIO = 0.35
"""Minimum part of an outline's width beyond a pack's flank that may be another bundle."""


@dataclass(frozen=True, eq=False)
class Reading:
    """A chosen outline with its weight (cells explained) and the strongest rival reading of its place.

    other_packing: rings of another packing that explains the bundles of this kind as well, if there is one.
    pack: the bars that straps hold together there, None where no straps are seen. is_along_baseline: whether
    the line from camera to camera runs roughly along its bars. flanks: of the pack where its bounds are
    known, otherwise of the outline; None where too little of them is seen.
    """

    found: FittedOutline
    weight: float
    rival: FittedOutline | None
    rival_weight: float
    other_packing: int | None
    pack: Pack | None = None
    is_along_baseline: bool = False
    flanks: Flanks | None = None

    @property
    def outlines_pack(self) -> bool:
        """Check whether the fitted outline ends where the pack does, or the pack's bounds aren't known."""
        pack, width = self.pack, self.found.fit.width_m
        if pack is None or not pack.is_bounded:
            return True
        off = max(abs(pack.low_m + width / 2), abs(pack.high_m - width / 2))
        return off < self.same_m

    @property
    def same_m(self) -> float:
        """Return the maximum distance (m) between edges, or difference of widths, that count as the same."""
        return _SAME_RATIO * self.found.fit.width_m + _SAME_M

    def straps_aside_m(self, seen: SeenSection | None) -> float:
        """Return how far (m) what shows of straps puts the pack's middle aside of the outline's.

        Straps on a part of the outline that lie within it and end at one of its edges tell its place by that
        edge alone, if something else shows that it is the bundle's: its packing in the photo, or both its
        sides, which also tell its place.
        """
        pack, half, same_m = self.pack, self.found.fit.width_m / 2, self.same_m
        if pack is None:
            return 0.0
        beyond = -half - pack.low_m, pack.high_m - half
        off = [abs(one) for side, one in zip(pack.sides, beyond, strict=True) if side == PackSide.SEEN]
        if max(beyond) > same_m or not off or min(off) >= same_m:
            return abs(pack.middle_m)
        if self.found.shades is not None:
            return min(off)
        if seen is None or not seen.sides_seen or abs(seen.width_m - 2 * half) >= same_m:
            return abs(pack.middle_m)
        return max(min(off), abs(seen.middle_m))

    @property
    def ends_inside(self) -> bool:
        """Check whether straps show a flank far inside the outline, as where it covers two bundles."""
        pack, width = self.pack, self.found.fit.width_m
        if pack is None:
            return False
        inside = pack.low_m + width / 2, width / 2 - pack.high_m
        return any(
            side is PackSide.SEEN and beyond > _BEYOND_RATIO * width
            for side, beyond in zip(pack.sides, inside, strict=True)
        )

    @property
    def unended_sides(self) -> int:
        """Count the sides on which neither straps nor a flank that falls off show where the bundle ends."""
        sides = (PackSide.OPEN, PackSide.OPEN) if self.pack is None else self.pack.sides
        falls = (False, False) if self.flanks is None else self.flanks.falls_off
        return sum(
            side is PackSide.OPEN and not falls_off for side, falls_off in zip(sides, falls, strict=True)
        )

    @property
    def is_flat(self) -> bool:
        """Check whether neither flank falls off, as on a plate or wall, and no straps bound it."""
        bounded = self.pack is not None and self.pack.is_bounded
        return self.flanks is not None and self.flanks.are_flat and not bounded

    def with_flanks(self) -> Reading:
        """Return a copy of the reading with its flanks measured."""
        half, pack = self.found.fit.width_m / 2, self.pack
        if pack is None or not pack.is_bounded:
            return replace(self, flanks=seen_flanks(self.found, -half, half))
        flanks = seen_flanks(self.found, pack.low_m, pack.high_m)
        if flanks is not None:
            ended = pack.sides[0] == PackSide.SEEN, pack.sides[1] == PackSide.SEEN
            flanks = replace(flanks, ended=ended, are_flat=flanks.are_flat and not all(ended))
        return replace(self, flanks=flanks)
