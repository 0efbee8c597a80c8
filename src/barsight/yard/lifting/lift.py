"""Define the records of lifts: the scene that they are chosen from, and a placement as assessed."""

from __future__ import annotations

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
