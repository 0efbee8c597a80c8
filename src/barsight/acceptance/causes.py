"""Name what is wrong with a rig: which single cause explains the artefacts' errors and the travel best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi_square

from barsight.acceptance.observation import Observation, ViewGeometry
from barsight.acceptance.pictures import PictureHealth
from barsight.artefacts.plan import AcceptancePlan
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.motion.rig_check.drift_check import RigCheck

PLATE_PX, PLATE_MM = 0.008, 0.2
"""Noise of a plate's height, beside what its own uncertainty is: disparity, and the map's. Rendered plates
scatter by 0.4 mm where a pixel of disparity is 65 mm."""
SPHERE_PX, SPHERE_MM = 0.012, 0.5
"""The same of a sphere's: pixels round its cap; rendered ones scatter by 0.6 mm there."""
PLACE_PX, PLACE_MM = 0.2, 1.0
"""The same across, in pixels on the ground."""
FALSE_NAMES = 0.01
"""Chance that a healthy rig has a cause named, over all that are tried together."""
ALIKE = 4.0
"""Another cause that explains the errors by so much less chi-square only, two sigma, isn't told from it."""


@dataclass(frozen=True)
class Unknown:
    """A parameter of the rig. unit and scale: how it is told. ordinary: its sigma in a healthy rig, SI."""

    name: str
    unit: str
    scale: float
    ordinary: float


UNKNOWNS = (
    Unknown("yaw between the cameras", "deg", 180 / np.pi, np.radians(0.002)),
    Unknown("baseline", "%", 100.0, 2e-4),
    Unknown("focal length", "%", 100.0, 2e-4),
    Unknown("mounting height", "mm", 1e3, 1e-3),
    Unknown("mounting along the bridge", "mm", 1e3, 1e-3),
    Unknown("mounting across the bridge", "mm", 1e3, 1e-3),
    Unknown("mounting roll", "deg", 180 / np.pi, np.radians(0.01)),
    Unknown("mounting pitch", "deg", 180 / np.pi, np.radians(0.01)),
    Unknown("flattened caps", "mm", 1e3, 3e-3),
)
"""The last is no cause: matching's blur lowers the caps of all spheres alike."""


@dataclass(frozen=True)
class Cause:
    """A cause of errors: value and sigma in `unit`; chi2: by how much it explains them better than an
    ordinary rig. alike: others that explain them nearly as well.
    """

    name: str
    value: float
    sigma: float
    unit: str
    chi2: float
    alike: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Name it, with those that it isn't told from."""
        return " or ".join((self.name, *self.alike))


def name_causes(
    plan: AcceptancePlan, seen: Sequence[Observation], checks: Sequence[RigCheck | Failed],
    pictures: Sequence[tuple[PictureHealth, ...] | Failed],
) -> tuple[Cause, ...]:  # fmt: skip
    """Name the causes, none where the rig is as it should be."""
    dirt = max(
        (one for row in pictures if not isinstance(row, Failed) for one in row),
        key=lambda h: h.dirt_pct,
        default=None,
    )
    causes = []
    if dirt is not None and dirt.dirt_pct > plan.limits.dirt_pct:
        causes.append(
            Cause(f"dirty lens of {dirt.camera}", dirt.dirt_pct, np.nan, "% of the picture", np.inf)
        )
    rows = [row for view in seen for row in _artefact_rows(plan, view)]
    rows += [row for check in checks if not isinstance(check, Failed) for row in _travel_rows(check)]
    causes += _ratio_causes(checks)
    found = _best_cause(rows)
    return tuple([*causes, found] if found is not None else causes)


@dataclass(frozen=True, eq=False)
class _Row:
    """An error, its sigma, and how it answers to the UNKNOWNS. artefact: whose it is; empty of the travel."""

    artefact: str
    error: float
    sigma: float
    answer: Float64


def _best_cause(rows: Sequence[_Row]) -> Cause | None:
    """Let each unknown go free in turn, the others as a healthy rig has them, and leave each artefact out in
    turn; take what a healthy rig would show most rarely.
    """
    if not rows:
        return None
    weight = np.array([1 / row.sigma for row in rows])
    design = np.array([row.answer for row in rows]) * weight[:, None]
    error = np.array([row.error for row in rows]) * weight
    ordinary = np.array([one.ordinary for one in UNKNOWNS])
    names = sorted({row.artefact for row in rows} - {""})
    healthy, _, _ = _solved(design, error, 1 / ordinary**2)
    # One chance of a false name for all that are tried, whatever each leaves free.
    best: Cause | None = None
    rarest = float(np.log(FALSE_NAMES / (len(UNKNOWNS) - 1 + len(names))))
    gains = {}
    for k, one in enumerate(UNKNOWNS[:-1]):
        prior = 1 / ordinary**2
        prior[k] = 0.0
        chi2, value, sigma = _solved(design, error, prior)
        gains[one.name] = healthy - chi2
        rare = float(chi_square.logsf(healthy - chi2, 1))
        if rare < rarest:
            told = one.scale * float(value[k]), one.scale * float(sigma[k])
            best, rarest = Cause(one.name, *told, one.unit, healthy - chi2), rare
    for name in names:
        others = np.array([row.artefact != name for row in rows])
        chi2, _, _ = _solved(design[others], error[others], 1 / ordinary**2)
        rare = float(chi_square.logsf(healthy - chi2, int((~others).sum())))
        if rare < rarest:
            off = [1e3 * row.error for row in rows if row.artefact == name]
            sigma_mm = max(1e3 * row.sigma for row in rows if row.artefact == name)
            told = float(max(off, key=abs)), sigma_mm
            best, rarest = Cause(f"{name} stands elsewhere", *told, "mm", healthy - chi2), rare
    if best is None or best.name not in gains:
        return best
    alike = (name for name, gain in gains.items() if name != best.name and gain > best.chi2 - ALIKE)
    return replace(best, alike=tuple(alike))


def _solved(design: Float64, error: Float64, prior: Float64) -> tuple[float, Float64, Float64]:
    """Solve least squares with a prior about 0: chi-square with the prior's part, values and sigmas."""
    normal = design.T @ design + np.diag(prior)
    scale = 1 / np.sqrt(np.diag(normal).clip(1e-300))
    inverse = scale[:, None] * np.linalg.pinv(normal * scale[:, None] * scale) * scale
    value = inverse @ (design.T @ error)
    off = error - design @ value
    return float(off @ off + prior @ value**2), value, np.sqrt(np.diag(inverse).clip(0))


def _artefact_rows(plan: AcceptancePlan, view: Observation) -> Iterator[_Row]:
    for plate in plan.plate:
        found = view.plates[plate.name]
        if not isinstance(found, Failed):
            place = np.array([plate.x_m, plate.y_m, plate.z_m])
            noise = np.hypot(1e-3 * PLATE_MM, PLATE_PX * view.view.px_m(plate.z_m))
            error, own = found.z_m - plate.z_m, float(np.hypot(noise, plate.sigma_m))
            yield _Row(plate.name, error, own, _moves(view.view, place)[2])
    for sphere in plan.sphere:
        seen = view.spheres[sphere.name]
        if isinstance(seen, Failed) or sphere.place_sigma_m is None:
            continue
        place = np.array([sphere.x_m, sphere.y_m, sphere.z_m])
        noise = np.hypot(1e-3 * PLACE_MM, PLACE_PX * (view.view.camera_m[2] - place[2]) / view.view.focal_px)
        noises = [noise, noise, np.hypot(1e-3 * SPHERE_MM, SPHERE_PX * view.view.px_m(place[2]))]
        for k, answer in enumerate(_moves(view.view, place)):
            own = float(np.hypot(noises[k], sphere.place_sigma_m))
            answer[-1] = -1.0 if k == 2 else 0.0
            yield _Row(sphere.name, float(seen.centre_m[k] - place[k]), own, answer)
    known = {s.name: s for s in plan.sphere}
    for bar in plan.sphere_bar:
        ends = [known[name] for name in bar.spheres]
        both = [view.spheres[name] for name in bar.spheres]
        if all(end.place_sigma_m is not None for end in ends) or any(isinstance(b, Failed) for b in both):
            continue  # their places say it already
        first, second = (np.array([e.x_m, e.y_m, e.z_m]) for e in ends)
        a, b = both
        assert not isinstance(a, Failed) and not isinstance(b, Failed)
        way = (second - first) / np.linalg.norm(second - first)
        answer = way @ (_moves(view.view, second) - _moves(view.view, first))
        error = float(np.linalg.norm(b.centre_m - a.centre_m)) - bar.length_m * plan.conditions.expansion
        yield _Row(bar.name, error, float(np.hypot(2e-3 * PLACE_MM, bar.sigma_m)), answer)


def _moves(view: ViewGeometry, place: Float64) -> Float64:
    """Compute how the measured place (3,) answers to each of the UNKNOWNS (3, U).

    Along the bridge the cameras pass over it from both sides: what grows with x cancels.
    """
    down = float(view.camera_m[2] - place[2])
    aside = float(place[1] - view.camera_m[1])
    ray = np.array([0.0, aside / down, -1.0])
    return np.column_stack([
        -(down**2) / view.baseline_m * ray,
        down * ray,
        np.array([0.0, 0.0, -down]),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        np.array([0.0, down, aside]),
        np.array([-down, 0.0, 0.0]),
        np.zeros(3),
    ])  # fmt: skip


def _travel_rows(check: RigCheck) -> Iterator[_Row]:
    """Take yaw and baseline as the crane's travel shows them, together, as they are known together, and the
    yaw that rows of matches show, whatever the baseline is.
    """
    drift, rows = check.drift, check.rows
    if not isinstance(rows, Failed):
        answer = np.zeros(len(UNKNOWNS))
        answer[0] = 1.0
        yield _Row("", float(rows.values[3]), float(check.row_sigmas[3]), answer)
    if isinstance(drift, Failed):
        return
    known = np.linalg.inv(drift.covariance)
    told = known @ np.array([drift.yaw_rad, drift.scale])
    # What was held possible before isn't the travel's word.
    weight, axes = np.linalg.eigh(known - np.diag(drift.prior_sigma**-2.0))
    for k in range(2):
        if weight[k] > 1e-3 * known.max():
            answer = np.zeros(len(UNKNOWNS))
            # A rig longer than calibrated was calibrated too short: what is off is the calibration.
            answer[:2] = axes[:, k] * (1, -1)
            yield _Row("", float(axes[:, k] @ told / weight[k]), float(weight[k] ** -0.5), answer)


def _ratio_causes(checks: Sequence[RigCheck | Failed]) -> Iterator[Cause]:
    """Take what rows of matches show between the cameras: pitch, roll and the ratio of focal lengths."""
    for check in checks:
        if isinstance(check, Failed):
            continue
        for line in check.lines:
            if line.name in ("pitch", "roll", "focal ratio") and line.state == "recalibrate":
                yield Cause(f"{line.name} between the cameras", line.value, line.sigma, line.unit, np.inf)
        return
