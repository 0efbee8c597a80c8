"""Name the fault of a rig: the single cause that best explains the artefacts' errors and the travel."""

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
"""Noise of a plate's height in addition to the plate's own uncertainty: of disparity (px) and of the map
(mm). Rendered plates scatter by 0.4 mm where a pixel of disparity is 65 mm.
"""
SPHERE_PX, SPHERE_MM = 0.012, 0.5
"""The same for a sphere's height (px of disparity, mm); rendered spheres scatter by 0.6 mm under these
conditions.
"""
PLACE_PX, PLACE_MM = 0.2, 1.0
"""The same for horizontal position, in pixels on the ground and in mm."""
FALSE_NAMES = 0.01
"""Probability of a false alarm: that any cause at all is named for a healthy rig."""
ALIKE = 4.0
"""Difference in chi-square (two sigma) within which two causes can't be distinguished."""


@dataclass(frozen=True)
class Unknown:
    """A parameter of the rig. unit, scale: unit of the report and factor to it from SI. ordinary: its
    standard deviation in a healthy rig, SI.
    """

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
"""The last one is a nuisance parameter, not a cause: blur in matching lowers the caps of all spheres
alike.
"""


@dataclass(frozen=True)
class Cause:
    """A cause of errors. value, sigma: in `unit`. chi2: reduction of chi-square compared with a healthy rig.
    alike: other causes that explain the errors almost as well.
    """

    name: str
    value: float
    sigma: float
    unit: str
    chi2: float
    alike: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Return its name with those of the causes that can't be distinguished from it."""
        return " or ".join((self.name, *self.alike))


def name_causes(
    plan: AcceptancePlan, seen: Sequence[Observation], checks: Sequence[RigCheck | Failed],
    pictures: Sequence[tuple[PictureHealth, ...] | Failed],
) -> tuple[Cause, ...]:  # fmt: skip
    """Name the causes of errors, none where the rig is healthy."""
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
    found = _best_cause(_over_recordings(rows))
    return tuple([*causes, found] if found is not None else causes)


@dataclass(frozen=True, eq=False)
class _Row:
    """An error and its derivatives with respect to the UNKNOWNS. noise: sigma that each recording draws anew;
    shared: that of the survey or calibration, the same in all. artefact: name, empty for travel. what: name
    of the error, empty where each recording shows another one.
    """

    artefact: str
    what: str
    error: float
    noise: float
    shared: float
    answer: Float64

    @property
    def sigma(self) -> float:
        """Return the sigma of the error."""
        return float(np.hypot(self.noise, self.shared))


def _over_recordings(rows: Sequence[_Row]) -> list[_Row]:
    """Average each error over the recordings, which leaves the part of its sigma that they share."""
    groups: dict[tuple[str, str], list[_Row]] = {}
    for number, row in enumerate(rows):
        groups.setdefault((row.artefact, row.what or str(number)), []).append(row)
    return [
        replace(
            group[0],
            error=float(np.mean([row.error for row in group])),
            noise=float(np.linalg.norm([row.noise for row in group])) / len(group),
            answer=np.mean([row.answer for row in group], axis=0),
        )
        for group in groups.values()
    ]


def _best_cause(rows: Sequence[_Row]) -> Cause | None:
    """Free each unknown in turn, with the others at their priors, and leave out each artefact in turn; return
    the cause whose effect would be rarest in a healthy rig.
    """
    if not rows:
        return None
    weight = np.array([1 / row.sigma for row in rows])
    design = np.array([row.answer for row in rows]) * weight[:, None]
    error = np.array([row.error for row in rows]) * weight
    ordinary = np.array([one.ordinary for one in UNKNOWNS])
    names = sorted({row.artefact for row in rows} - {""})
    healthy, _, _ = _solved(design, error, 1 / ordinary**2)
    # The probability of a false alarm is shared by all hypotheses, whatever each leaves free.
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
            estimate = one.scale * float(value[k]), one.scale * float(sigma[k])
            best, rarest = Cause(one.name, *estimate, one.unit, healthy - chi2), rare
    for name in names:
        others = np.array([row.artefact != name for row in rows])
        chi2, told, _ = _solved(design[others], error[others], 1 / ordinary**2)
        rare = float(chi_square.logsf(healthy - chi2, int((~others).sum())))
        if rare < rarest:
            off = [1e3 * (row.error - row.answer @ told) for row in rows if row.artefact == name]
            sigma_mm = max(1e3 * row.sigma for row in rows if row.artefact == name)
            estimate = float(max(off, key=abs)), sigma_mm
            best, rarest = Cause(f"{name} stands elsewhere", *estimate, "mm", healthy - chi2), rare
    if best is None or best.name not in gains:
        return best
    alike = (name for name, gain in gains.items() if name != best.name and gain > best.chi2 - ALIKE)
    return replace(best, alike=tuple(alike))


def _solved(design: Float64, error: Float64, prior: Float64) -> tuple[float, Float64, Float64]:
    """Solve least squares with a zero-mean prior: chi-square including the prior's part, values and
    sigmas.
    """
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
            error, answer = found.z_m - plate.z_m, _moves(view.view, place)[2]
            yield _Row(plate.name, "z", error, float(noise), plate.sigma_m, answer)
    for sphere in plan.sphere:
        seen = view.spheres[sphere.name]
        if isinstance(seen, Failed) or sphere.place_sigma_m is None:
            continue
        place = np.array([sphere.x_m, sphere.y_m, sphere.z_m])
        noise = np.hypot(1e-3 * PLACE_MM, PLACE_PX * (view.view.camera_m[2] - place[2]) / view.view.focal_px)
        noises = [noise, noise, np.hypot(1e-3 * SPHERE_MM, SPHERE_PX * view.view.px_m(place[2]))]
        for k, answer in enumerate(_moves(view.view, place)):
            answer[-1] = -1.0 if k == 2 else 0.0
            error = float(seen.centre_m[k] - place[k])
            yield _Row(sphere.name, "xyz"[k], error, float(noises[k]), sphere.place_sigma_m, answer)
    known = {s.name: s for s in plan.sphere}
    for bar in plan.sphere_bar:
        ends = [known[name] for name in bar.spheres]
        both = [view.spheres[name] for name in bar.spheres]
        if all(end.place_sigma_m is not None for end in ends) or any(isinstance(b, Failed) for b in both):
            continue  # already covered by the places of its ends
        first, second = (np.array([e.x_m, e.y_m, e.z_m]) for e in ends)
        a, b = both
        assert not isinstance(a, Failed) and not isinstance(b, Failed)
        direction = (second - first) / np.linalg.norm(second - first)
        answer = direction @ (_moves(view.view, second) - _moves(view.view, first))
        error = float(np.linalg.norm(b.centre_m - a.centre_m)) - bar.length_m * plan.conditions.expansion
        yield _Row(bar.name, "length", error, 2e-3 * PLACE_MM, bar.sigma_m, answer)


def _moves(view: ViewGeometry, place: Float64) -> Float64:
    """Differentiate the measured place (3,) with respect to the UNKNOWNS: (3, U).

    Along the bridge, the cameras pass over the place from both sides, so terms that grow with x cancel.
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
    """Yield rows for the yaw and baseline that the crane's travel shows, decorrelated, and for the yaw that
    the rows of matches show independently of the baseline.
    """
    drift, rows = check.drift, check.rows
    if not isinstance(rows, Failed):
        answer = np.zeros(len(UNKNOWNS))
        answer[0] = 1.0
        noise, sigma = float(rows.sigmas[3]), float(check.row_sigmas[3])
        yield _Row(
            "", "yaw by rows", float(rows.values[3]), noise, max(sigma**2 - noise**2, 0.0) ** 0.5, answer
        )
    if isinstance(drift, Failed):
        return
    for row, seen, variance in zip(*drift.by_travel(), strict=True):
        answer = np.zeros(len(UNKNOWNS))
        # A baseline longer than calibrated means a calibrated one that is too short: flip its sign.
        answer[:2] = row * (1, -1)
        yield _Row("", "", float(seen), float(variance**0.5), 0.0, answer)


def _ratio_causes(checks: Sequence[RigCheck | Failed]) -> Iterator[Cause]:
    """Yield causes that the rows of matches show between the cameras: pitch, roll and the ratio of focal
    lengths.
    """
    for check in checks:
        if isinstance(check, Failed):
            continue
        for line in check.lines:
            if line.name in ("pitch", "roll", "focal ratio") and line.state == "recalibrate":
                yield Cause(f"{line.name} between the cameras", line.value, line.sigma, line.unit, np.inf)
        return
