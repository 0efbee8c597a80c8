"""Hold a load by faces at rest, on its bars alone or on a label that lies under one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.contact import Contact, FaceHeights
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import (
    WeakestPole,
    hold_load,
    pried_ratio,
    share_checks,
    weakest_bundle,
    weakest_pole,
)
from barsight.yard.placement.checks import face_checks
from barsight.yard.placement.clearance import FacePlane, clearance_checks
from barsight.yard.placement.labels import SeenLabel, rests_on_label
from barsight.yard.placement.load import leaning_checks, resting_checks
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Check, check_true, nearest_to_limit, vetoes_of

SEVERAL = "several labels or other bright plates may be under the faces"


@dataclass(frozen=True, eq=False)
class Hold:
    """Hold of a load by resting faces: their contact with its pull, the weakest pole, `pried_ratio` and
    `weakest_bundle`.
    """

    contact: Contact
    weakest: WeakestPole | None
    pried: float
    worst: float

    @classmethod
    def of(
        cls, contact: Contact, place: Placement, magnet: Magnet, load: tuple[Bundle, ...], needed_n: float,
        settings: LiftSettings,
    ) -> Hold:  # fmt: skip
        """Compute it from a contact without a pull."""
        contact = hold_load(contact, magnet, load, settings.strap_m)
        return cls(
            contact, weakest_pole(contact, needed_n, magnet, place, load),
            pried_ratio(contact, needed_n, magnet, place, load),
            weakest_bundle(contact, magnet, place, load, settings.strap_m),
        )  # fmt: skip

    def weaker(self, other: Hold) -> Hold:
        """Keep this rest's plane and gaps, with the smaller pull, contact share and each minimum ratio."""
        both = self.contact, other.contact
        weak, bare = min(both, key=lambda one: one.pull_low_n), min(both, key=lambda one: one.contact_share)
        parts = zip(self.contact.poles, weak.poles, bare.poles, strict=True)
        poles = tuple(
            replace(
                own,
                pull_n=pulling.pull_n,
                pull_low_n=pulling.pull_low_n,
                contact_share=touching.contact_share,
            )
            for own, pulling, touching in parts
        )
        weakest = [one.weakest for one in (self, other) if one.weakest]
        return Hold(
            replace(self.contact, poles=poles), min(weakest, key=lambda pole: pole.ratio, default=None),
            min(self.pried, other.pried), min(self.worst, other.worst),
        )  # fmt: skip

    def off_by(self, off_m: float) -> Hold:
        """Add to the height's sigma that the faces may rest as far (m) from it."""
        own = self.contact
        sigma, over = (math.hypot(one, off_m) for one in (own.sigma_m, own.over_map_sigma_m))
        return replace(self, contact=replace(own, sigma_m=sigma, over_map_sigma_m=over))

    def checks(
        self, place: Placement, magnet: Magnet, load: tuple[Bundle, ...], needed_n: float,
        settings: LiftSettings,
    ) -> list[Check]:  # fmt: skip
        """Check how the faces lie and pull, and that they rest on the load."""
        return [
            *face_checks(self.contact, needed_n, magnet, load, settings),
            *share_checks(self.weakest, self.pried, self.worst),
            *resting_checks(place, magnet, self.contact, load, settings.strap_m),
        ]


@dataclass(frozen=True, eq=False)
class Task:
    """Task of the faces: the load that they are to hold, where, and by how much."""

    place: Placement
    heights: HeightMap
    magnet: Magnet
    load: tuple[Bundle, ...]
    needed_n: float
    settings: LiftSettings

    def hold(self, contact: Contact) -> Hold:
        """Hold the load by faces at rest."""
        return Hold.of(contact, self.place, self.magnet, self.load, self.needed_n, self.settings)

    def checks(self, hold: Hold) -> list[Check]:
        """Check how the faces lie, pull and lean."""
        place, magnet, load, settings = self.place, self.magnet, self.load, self.settings
        return [
            *hold.checks(place, magnet, load, self.needed_n, settings),
            *leaning_checks(place, magnet, hold.contact, load, settings.strap_m),
        ]

    def clearance(self, bare: Contact, others: Iterable[Contact] = ()) -> list[Check]:
        """Check that nothing is in the way of the faces, wherever they rest."""
        planes, stanchions = FacePlane.of(bare, others), self.settings.stanchions
        return clearance_checks(self.place, self.heights, self.magnet, planes, self.load, stanchions)

    def rests(self, faces: FaceHeights, bare: Contact, labels: Iterable[SeenLabel]) -> Iterator[Contact]:
        """Yield the other ways in which the faces may rest: on each part of a label."""
        for label in labels:
            yield from rests_on_label(label, self.place, faces, bare, self.magnet, self.settings)


def hold_on_labels(
    hold: Hold, checks: list[Check], task: Task, faces: FaceHeights, labels: tuple[SeenLabel, ...]
) -> tuple[Hold, list[Check], str]:
    """Hold the load wherever a label under a face may bear the faces; the reason if it isn't held there.

    checks: of `Task.checks` and `Task.clearance` for the bare rest, all passed. The faces' place stays that
    of the bare rest, and its sigma contains how far off the others are; pull and ratios are the least of all
    rests, and each check is that of the rest which is nearest to its limit.
    """
    least, rests, found = hold, list[Contact](), list[list[Check]]()
    if len(labels) > 1:
        return hold, checks, SEVERAL
    for contact in task.rests(faces, hold.contact, labels):
        one = task.hold(contact)
        found.append(task.checks(one))
        for veto in vetoes_of(found[-1]):
            return hold, checks, veto.reason
        rests.append(one.contact)
        least = least.weaker(one)
    if not rests:
        return hold, checks, ""
    clear = task.clearance(hold.contact, rests)
    for veto in vetoes_of(clear):
        return hold, checks, veto.reason
    nearest = (nearest_to_limit(ways) for ways in zip(checks, *found, strict=False))
    off_m = max(abs(one.centre_z_m - hold.contact.centre_z_m) for one in rests)
    return least.off_by(off_m), [*nearest, *clear], ""


def label_check(place: Placement, labels: tuple[SeenLabel, ...], reason: str) -> Check:
    """Check that a label leaves the load held. reason: of `hold_on_labels`."""
    if reason:
        along, across = labels[0].place_under(place)
        reason = (
            f"a label or another bright plate is under a face, {along:+.2f} m along and {across:+.2f} m "
            f"across the beam, and may hold the faces off the bars: {reason}"
        )
    return check_true("gap", "a label under a face leaves the load held", not reason, reason)
