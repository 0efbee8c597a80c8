"""Define the records of lifts: the scene that they are chosen from, and a placement as assessed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

from barsight.core.arrays import Float64
from barsight.yard.events import YardEvent
from barsight.yard.lifting.set_down import SetDown
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.lifting.validity import Validity
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import BundleTable, Placement
from barsight.yard.stability.stability import Footing
from barsight.yard.thin_lines import ThinLine, find_thin_lines
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Check, Veto, vetoes_of
from barsight.yard.weight import Mass


@dataclass(frozen=True, eq=False)
class LiftScene:
    """Everything that lifts are chosen from. travel: None where the map was given instead of measured.
    now_ns: time of the assessment on the frames' clock. events: those in the yard since it was measured.
    """

    heights: HeightMap
    table: BundleTable
    footings: tuple[Footing, ...]
    travel: Travel | None = None
    now_ns: int = 0
    events: tuple[YardEvent, ...] = ()

    @cached_property
    def _thin_lines(self) -> dict[int, tuple[ThinLine, ...] | None]:
        return {}

    def thin_lines(self, bundle: Bundle) -> tuple[ThinLine, ...] | None:
        """Return the lines across a bundle, the strongest first; None where too little of it is seen."""
        if bundle.id not in self._thin_lines:
            self._thin_lines[bundle.id] = find_thin_lines(self.heights, bundle)
        return self._thin_lines[bundle.id]

    def thin_line(self, load: tuple[Bundle, ...]) -> ThinLine | None:
        """Return the line across a load that most exceeds its limit; None where a bundle isn't seen."""
        lines = [found[0] for bundle in load if (found := self.thin_lines(bundle)) is not None]
        return max(lines, key=lambda line: line.excess_ratio) if lines and len(lines) == len(load) else None


@dataclass(frozen=True)
class FurtherPass:
    """A pass that would show what was not seen of refused lifts: the cameras' body at y_m, which is shift_m
    from where the pass with the most frames had it.

    bundles: of these lifts. only_unseen: those of them whose lift nothing else is known to forbid.
    """

    y_m: float
    shift_m: float
    bundles: tuple[int, ...]
    only_unseen: tuple[int, ...]

    @property
    def where(self) -> str:
        """Describe the pass."""
        way = f"{abs(self.shift_m):.1f} m towards {'+' if self.shift_m > 0 else '-'}y"
        return f"A pass with the cameras at y {self.y_m:.1f} m (the trolley {way})"

    @property
    def sentence(self) -> str:
        """Describe the pass and what it would show."""
        rest = len(self.only_unseen)
        also = f"; nothing else is known to forbid {rest} of them" if rest else ""
        return f"{self.where} would show what was not seen of {_refused(self.bundles)}{also}."


@dataclass(frozen=True)
class UnseenPlaces:
    """Places that were not seen, for which lifts are refused. passes: those that would show them, the best
    first. in_sight: bundles of lifts of which some lie in the pictures but couldn't be measured, so that no
    pass is proposed.
    """

    passes: tuple[FurtherPass, ...]
    in_sight: tuple[int, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """Describe the passes, and what none of them would show."""
        said = [one.sentence for one in self.passes]
        if self.in_sight:
            said.append(f"What was not seen of {_refused(self.in_sight)} {_IN_SIGHT}.")
        return tuple(said)

    def sentence_for(self, bundles: Collection[int]) -> str:
        """Describe what would show what was not seen of the lift of these bundles; empty if nothing is known
        that would.
        """
        for one in self.passes:
            if set(bundles) & set(one.bundles):
                return f"{one.where} would show what was not seen."
        return f"What was not seen {_IN_SIGHT}." if set(bundles) & set(self.in_sight) else ""


_IN_SIGHT = (
    "lies in the pictures, at least in part, but too dark or too bare to be measured: a pass elsewhere is "
    "not likely to show it"
)


def _refused(bundles: tuple[int, ...]) -> str:
    ids = ", ".join(str(number) for number in bundles)
    return f"{len(bundles)} refused bundle{'s' if len(bundles) > 1 else ''} ({ids})"


@dataclass(frozen=True, eq=False)
class Lift:
    """An assessed placement. All in m, rad, N, kg; NaN where unknown.

    bundles: ids of the `count` bundles that would be taken, with `count_probability`; straddled: the same ids
    where they are too many. contact: None where nothing is known under the faces. needed_n: upper bound of
    the weight times the safety factor. offset_along_m, offset_across_m: magnet's centre minus the load's.
    overhang_m: bars beyond the outermost pole. tolerance: half sides of the box within which all this holds.
    safety: the smallest of pull over needed pull, for all poles and for each one's share, capacity over load,
    and tolerance over the crane's; at least 1 without vetoes. checks: all that were made; each one that isn't
    passed is a veto. validity: in time, None where no frame certainly saw the place. covariance: (4, 4) of
    the target's x, y, z and yaw, None without a contact. map_vetoes: those that forbid every lift of the map.
    set_down: where the load can be put, None where no place is known or none was sought; magnet_down: the
    magnet's place when the load lies there.
    """

    place: Placement
    bundles: tuple[int, ...]
    count: int
    count_probability: float
    straddled: tuple[int, ...]
    contact: Contact | None
    mass: Mass
    needed_n: float
    offset_along_m: float
    offset_across_m: float
    overhang_m: float
    tolerance: Tolerance
    safety: float
    checks: tuple[Check, ...]
    validity: Validity | None = None
    covariance: Float64 | None = None
    map_vetoes: tuple[Veto, ...] = ()
    set_down: SetDown | None = None
    magnet_down: Placement | None = None

    @property
    def vetoes(self) -> tuple[Veto, ...]:
        """List all vetoes: those of the whole map, then the failed and unknown checks."""
        said = {veto.code for veto in self.map_vetoes}
        own = (veto for veto in vetoes_of(self.checks) if veto.code not in said)
        return (*self.map_vetoes, *own)
