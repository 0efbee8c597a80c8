"""Judge errors against limits by the rule of ISO 14253-1: passed only if |error| + U is within the limit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import inf, isfinite, nan

import numpy as np
from scipy.stats import chi2

from barsight.acceptance.observation import Observation
from barsight.acceptance.uncertainty import CombinedUncertainty, UncertaintyPart, combine
from barsight.artefacts.plan import (
    AcceptancePlan,
    Artefact,
    DummyBundle,
    HeightStep,
    Plate,
    Sphere,
    SphereBar,
    TouchDown,
)
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.yard.magnet.description import MagnetOffset
from barsight.yard.types import Bundle
from barsight.yard.weight import bundle_mass

AXES = {"height": "z", "x": "x", "y": "y", "z": "z", "lift across": "x", "lift z": "z"}
"""Axis along which a quantity, by the end of its name, is a place; a dummy bundle lies across X."""
REPEATED = ("height_mm", "position_mm", "length_mm", "step_mm", "lift_mm")
"""Groups of lengths whose repeatability over the recordings is judged."""


class Decision(StrEnum):
    """Passed: the error with its uncertainty is within the limit. Failed: it is outside. Not proven: the
    limit is within the uncertainty. Not measured: the artefact wasn't found, or no value was given.
    """

    PASSED = "passed"
    FAILED = "failed"
    UNPROVEN = "not proven"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class JudgedQuantity:
    """A judged quantity.

    errors: one per recording, in `unit`, NaN where not measured. error: the largest in magnitude (for the
    laser, the least equivalent), NaN where a recording lacks it. uncertainty: test value uncertainty [ISO/TS
    23165]. limit, decision: as in `decide`. group: the limit's name in the plan.
    """

    name: str
    group: str
    unit: str
    errors: tuple[float, ...]
    error: float
    uncertainty: CombinedUncertainty
    parts: tuple[UncertaintyPart, ...]
    limit: float
    decision: Decision
    reason: str = ""


def judge_all(
    plan: AcceptancePlan, seen: Sequence[Observation], offset: MagnetOffset | None = None
) -> tuple[JudgedQuantity, ...]:
    """Judge every quantity in the plan over all recordings. offset: of the magnet, added to the crane's
    readings.
    """
    judge = _Judge(plan, seen, offset)
    judged = [
        *(q for one in plan.plate for q in judge.plate(one)),
        *(q for one in plan.sphere for q in judge.sphere(one)),
        *(judge.bar(one) for one in plan.sphere_bar),
        *(judge.step(one) for one in plan.step),
        *(q for one in plan.dummy_bundle for q in judge.dummy(one)),
        *(q for one in plan.touch_down for q in judge.touch(one)),
        *judge.laser(),
    ]
    return (*judged, *judge.repeats(judged))


def decide(error: float, expanded: float, limit: float) -> Decision:
    """Decide by ISO 14253-1; an error of NaN counts as not measured."""
    if not isfinite(error):
        return Decision.NOT_MEASURED
    if abs(error) + expanded <= limit:
        return Decision.PASSED
    return Decision.FAILED if abs(error) - expanded > limit else Decision.UNPROVEN


class _Judge:
    def __init__(
        self, plan: AcceptancePlan, seen: Sequence[Observation], offset: MagnetOffset | None
    ) -> None:
        self._plan, self._seen, self._limits, self._offset = plan, seen, plan.limits, offset

    def plate(self, one: Plate) -> Iterator[JudgedQuantity]:
        found = [view.plates[one.name] for view in self._seen]
        z = [nan if isinstance(f, Failed) else 1e3 * (f.z_m - one.z_m) for f in found]
        flat = [nan if isinstance(f, Failed) else 1e3 * f.flatness_m for f in found]
        yield self._judged(f"{one.name}: height", "height_mm", z, [self._own(one.sigma_m)], _why(found))
        parts = [self._own(one.flatness_sigma_m)]
        yield self._judged(f"{one.name}: flatness", "flatness_mm", flat, parts, _why(found))

    def sphere(self, one: Sphere) -> Iterator[JudgedQuantity]:
        found = [view.spheres[one.name] for view in self._seen]
        place = np.array([one.x_m, one.y_m, one.z_m])
        if one.place_sigma_m is not None:
            off = [np.full(3, nan) if isinstance(f, Failed) else 1e3 * (f.centre_m - place) for f in found]
            for k, axis in enumerate("xyz"):
                group = "height_mm" if axis == "z" else "position_mm"
                survey = self._own(one.place_sigma_m, "survey of its place")
                yield self._judged(f"{one.name}: {axis}", group, [o[k] for o in off], [survey], _why(found))
        if one.probing:
            wanted = one.diameter_m * self._expansion
            form = [nan if isinstance(f, Failed) else 1e3 * f.form_m for f in found]
            size = [nan if isinstance(f, Failed) else 1e3 * (f.diameter_m - wanted) for f in found]
            parts = [self._own(one.diameter_sigma_m), self._thermal(one.diameter_m)]
            yield self._judged(f"{one.name}: form", "form_mm", form, parts[:1], _why(found))
            yield self._judged(f"{one.name}: size", "size_mm", size, parts, _why(found))

    def bar(self, one: SphereBar) -> JudgedQuantity:
        errors, found = [], []
        for view in self._seen:
            first, second = (view.spheres[name] for name in one.spheres)
            found += [first, second]
            missing = isinstance(first, Failed) or isinstance(second, Failed)
            length = nan if missing else float(np.linalg.norm(first.centre_m - second.centre_m))  # type: ignore[union-attr]
            errors.append(1e3 * (length - one.length_m * self._expansion))
        parts = [self._own(one.sigma_m), self._thermal(one.length_m)]
        return self._judged(f"{one.name}: length", "length_mm", errors, parts, _why(found))

    def step(self, one: HeightStep) -> JudgedQuantity:
        errors, found = [], []
        for view in self._seen:
            low, high = view.plates[one.lower], view.plates[one.upper]
            found += [low, high]
            missing = isinstance(low, Failed) or isinstance(high, Failed)
            height = nan if missing else high.z_m - low.z_m  # type: ignore[union-attr]
            errors.append(1e3 * (height - one.height_m * self._expansion))
        parts = [self._own(one.sigma_m), self._thermal(one.height_m)]
        return self._judged(f"{one.name}: height", "step_mm", errors, parts, _why(found))

    def dummy(self, one: DummyBundle) -> Iterator[JudgedQuantity]:
        found = [view.bundles[one.name] for view in self._seen]
        nothing = np.full(7, nan)
        rows = np.array([nothing if isinstance(f, Failed) else _bundle_errors(f, one) for f in found])
        own, yaw = self._own(one.sigma_m), self._own(one.yaw_sigma_deg, unit=1.0)
        for k, (what, group, part) in enumerate((
            ("lift across", "lift_mm", own), ("lift along", "lift_along_mm", own), ("lift z", "lift_mm", own),
            ("yaw", "yaw_deg", yaw), ("width", "width_mm", own), ("length", "bundle_length_mm", own),
        )):  # fmt: skip
            yield self._judged(f"{one.name}: {what}", group, rows[:, k].tolist(), [part], _why(found))
        if one.mass_kg is not None:
            part = self._own(one.mass_sigma_kg / one.mass_kg, "weighing", unit=100.0)
            yield self._judged(f"{one.name}: mass", "mass_pct", rows[:, 6].tolist(), [part], _why(found))

    def touch(self, one: TouchDown) -> Iterator[JudgedQuantity]:
        tops = [_top(view, one.on, self._plan.artefacts) for view in self._seen]
        crane = np.array([one.x_m, one.y_m, one.z_m])
        if self._offset is not None:
            crane = crane + self._offset.place_m(np.radians(one.yaw_deg))
        off = [np.full(3, nan) if isinstance(top, Failed) else 1e3 * (top - crane) for top in tops]
        parts = [[self._own(one.sigma_m, "the crane's place at the touch-down")] for _ in range(3)]
        if self._offset is not None:
            for row, sigma_m in zip(parts, self._offset.sigma_m(np.radians(one.yaw_deg)), strict=True):
                row.append(
                    UncertaintyPart("offset of the magnet", 1e3 * sigma_m, measured_by="calibrate magnet")
                )
        for k, axis in enumerate("xyz"):
            errors = [o[k] for o in off]
            if all(np.isnan(errors)) and not all(isinstance(top, Failed) for top in tops):
                continue  # only its height is seen
            yield self._judged(f"{one.name}: {axis}", "touch_mm", errors, parts[k], _why(tops))

    def laser(self) -> Iterator[JudgedQuantity]:
        for profile in sorted({row.profile for view in self._seen for row in view.laser}):
            rows = [row for view in self._seen for row in view.laser if row.profile == profile]
            worst = max(rows, key=lambda row: row.equivalence_mm)
            # The equivalence margin of two one-sided tests is the bias plus this.
            half = worst.equivalence_mm - abs(worst.bias_mm)
            part = UncertaintyPart("independent samples of the profile", half / 2, "t", inf, "this test")
            yield self._judged(
                f"laser profile {profile}: equivalence", "laser_mm", [row.bias_mm for row in rows], [part],
                "", expanded=half, error=worst.bias_mm,
            )  # fmt: skip

    def repeats(self, judged: Sequence[JudgedQuantity]) -> Iterator[JudgedQuantity]:
        """Judge twice the pooled standard deviation over the recordings; U extends to its upper 95 %
        bound.
        """
        rows = [q for q in judged if q.group in REPEATED and np.isfinite(q.errors).all()]
        if len(self._seen) < 2 or not rows:
            return
        off = np.array([q.errors for q in rows])
        scatter, free = float(np.sqrt(off.var(axis=1, ddof=1).mean())), _repeat_freedom(rows)
        upper = 2 * scatter * (np.sqrt(free / chi2.ppf(0.05, free)) - 1)
        part = UncertaintyPart("few repeats", upper / 2, "chi-square", free, "this test")
        yield self._judged("repeatability, 2 s", "repeat_mm", [2 * scatter], [part], "", expanded=upper)

    def _judged(
        self, name: str, group: str, errors: Sequence[float], parts: Sequence[UncertaintyPart], reason: str,
        *, expanded: float | None = None, error: float | None = None,
    ) -> JudgedQuantity:  # fmt: skip
        limit = float(getattr(self._limits, group))
        known = [e for e in errors if isfinite(e)]
        worst = error if error is not None else (max(known, key=abs) if known else nan)
        if len(known) < len(errors):
            worst = nan  # every recording must have measured it
        whole = combine(parts)
        if expanded is not None:
            whole = CombinedUncertainty(whole.sigma, whole.degrees_of_freedom, 2.0, expanded)
        decision = decide(worst, whole.expanded, limit)
        return JudgedQuantity(
            name, group, group.rpartition("_")[2].replace("pct", "%"), tuple(float(e) for e in errors), worst,
            whole, tuple(parts), limit, decision, reason if decision is Decision.NOT_MEASURED else "",
        )  # fmt: skip

    def _own(
        self, sigma: float, source: str = "calibration of the artefact", unit: float = 1e3
    ) -> UncertaintyPart:
        free = self._plan.conditions.degrees_of_freedom
        return UncertaintyPart(source, unit * sigma, "normal", free, "the plan")

    def _thermal(self, length_m: float) -> UncertaintyPart:
        about = self._plan.conditions
        sigma = 1e3 * length_m * about.expansion_per_k * about.temperature_sigma_c
        return UncertaintyPart("temperature of the artefact", sigma, "normal", inf, "the plan")

    @property
    def _expansion(self) -> float:
        return self._plan.conditions.expansion


def _repeat_freedom(rows: Sequence[JudgedQuantity]) -> float:
    """Estimate the degrees of freedom of a scatter over recordings [Welch 1947]. A recording shifts all
    places alike along an axis, which counts once; distances follow from the places and don't count where
    there are any.
    """
    axes = [AXES.get(q.name.rpartition(": ")[2], "") if q.group != "step_mm" else "" for q in rows]
    if not any(axes):
        axes = [q.name for q in rows]
    squares, squared = 0.0, 0.0
    for axis in {*axes} - {""}:
        off = np.array([q.errors for q, own in zip(rows, axes, strict=True) if own == axis])
        off = off - off.mean(axis=1, keepdims=True)
        common, count = len(off) * float((off.mean(axis=0) ** 2).sum()), off.shape[1] - 1
        rest = float((off**2).sum()) - common
        squares += common + rest
        squared += common**2 / count + (rest**2 / count / (len(off) - 1) if len(off) > 1 else 0.0)
    return squares**2 / squared if squared > 0 else float(len(rows[0].errors) - 1)


def _why(found: Sequence[object]) -> str:
    return "; ".join(dict.fromkeys(str(one) for one in found if isinstance(one, Failed)))


def _bundle_errors(bundle: Bundle, dummy: DummyBundle) -> Float64:
    """Compute a bundle's errors (7,): across, along, up (mm), yaw (deg), width, length (mm), mass (%)."""
    turn = (np.degrees(bundle.yaw_rad) - dummy.yaw_deg + 90) % 180 - 90
    ended = not any(bundle.ends_open)
    kg, yaw = bundle_mass(bundle).kg, np.radians(dummy.yaw_deg)
    off = bundle.centre_m[:2] - (dummy.x_m, dummy.y_m)
    return np.array([
        1e3 * float(off @ (np.cos(yaw), np.sin(yaw))),
        1e3 * float(off @ (-np.sin(yaw), np.cos(yaw))) if ended else nan,
        1e3 * (bundle.top_z_m - dummy.top_z_m), turn, 1e3 * (bundle.width_m - dummy.width_m),
        1e3 * (bundle.length_m - dummy.length_m) if ended else nan,
        nan if dummy.mass_kg is None or not ended else 100 * (kg / dummy.mass_kg - 1),
    ])  # fmt: skip


def _top(view: Observation, name: str, artefacts: Sequence[Artefact]) -> Float64 | Failed:
    """Find the point (3,) m at which a magnet touches an artefact; NaN for the x and y of a plate, or of a
    bundle with an open end, whose middle isn't seen.
    """
    if name in view.plates:
        plate = view.plates[name]
        return plate if isinstance(plate, Failed) else np.array([nan, nan, plate.z_m])
    if name in view.bundles:
        bundle = view.bundles[name]
        if isinstance(bundle, Failed):
            return bundle
        middle = (nan, nan) if any(bundle.ends_open) else bundle.centre_m[:2]
        return np.array([*middle, bundle.top_z_m])
    sphere = view.spheres[name]
    if isinstance(sphere, Failed):
        return sphere
    (own,) = (one for one in artefacts if one.name == name)
    assert isinstance(own, Sphere)
    top: Float64 = sphere.centre_m + np.array([0.0, 0.0, own.diameter_m / 2])
    return top
