"""Read the parts of a magnet's description that the judge needs, from its TOML file or from `lifts.json`."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float64

SATURATED_TESLA = 1.6
LEFT_OUT = {"grade_ratio": 0.7, "heat_ratio": 0.5, "duty_ratio": 0.7}
"""Default share of the pull that remains, for a magnet file that doesn't state it."""
UNTYPED_FACTOR = 3.0
_MU0 = 4e-7 * math.pi


@dataclass(frozen=True, eq=False)
class JudgedMagnet:
    """poles: (P, 4) along, across, length, width, m. beam: length, width, height over the faces, m. pull:
    (K, 2) gap, m, and pull per area on a thick plate, Pa. plates: (T, 1 + K) thickness and the pull per area
    on it, from the thinnest plate to that of `pull`; empty if no thickness is given. rounds: (R, 2) diameter
    of a single bar, and its pull over the thick plate's. left: share of the pull left by the steel's grade,
    heat and duty. tolerance: half sides along the yard's axes, m, and rad. carries_kg: the smaller capacity
    of magnet and crane.
    """

    poles: Float64
    beam: tuple[float, float, float]
    pull: Float64
    plates: Float64
    rounds: Float64
    left: float
    factor: float
    carries_kg: float
    tolerance: tuple[float, float, float]
    pitch_rad: float
    roll_rad: float
    offset_along_m: float
    offset_across_m: float
    overhang_m: float
    gap_m: float
    contact_share: float

    @property
    def reach_m(self) -> float:
        """Return the gap beyond which the magnet pulls nothing, m."""
        return float(self.pull[-1, 0])

    @property
    def half_span_m(self) -> float:
        """Return the distance from the centre to the outer edge of the outermost pole, m."""
        return float((np.abs(self.poles[:, 0]) + self.poles[:, 2] / 2).max())

    def pressure(self, gap_m: Float64) -> Float64:
        """Interpolate the pull per area at each gap, Pa, from the data sheet; 0 beyond its last gap."""
        return np.interp(gap_m, self.pull[:, 0], self.pull[:, 1], right=0.0)

    def bar_pressure(self, gap_m: Float64, diameter_m: float, face_m: float) -> Float64:
        """Compute the pull per area at each gap over round bars, Pa, under a face so wide.

        A bar lets as much flux through as a plate pi/4 as thick, and one alone in the middle of the face is
        pulled no more than the maker says.
        """
        gaps, curve = self.pull[:, 0], self._on_plate(math.pi / 4 * diameter_m, face_m)
        if self.rounds.size:
            aside = face_m * ((np.arange(2000) + 0.5) / 2000 - 0.5)
            under = np.abs(aside) < diameter_m / 2
            depth = diameter_m / 2 - np.sqrt(diameter_m**2 / 4 - aside[under] ** 2)
            summed = np.interp(depth, gaps, curve).sum() / 2000
            rated = np.interp(diameter_m, *self.rounds.T) * min(diameter_m / self.rounds[0, 0], 1.0)
            curve = curve * min(rated * self.left * self.pull[0, 1] / summed, 1.0)
        return np.interp(gap_m, gaps, curve, right=0.0)

    def _on_plate(self, thickness_m: float, face_m: float) -> Float64:
        """Compute the pull per area at the sheet's gaps (K,) on a flat plate, Pa."""
        if not self.plates.size:
            needed = math.sqrt(2 * _MU0 * self.pull[0, 1])
            passes = 2 * thickness_m * SATURATED_TESLA / face_m / needed
            return np.asarray(self.left * min(passes, 1.0) ** 2 * self.pull[:, 1])
        known, curves = self.plates[:, 0], self.plates[:, 1:]
        found = np.array([np.interp(thickness_m, known, at_gap) for at_gap in curves.T])
        return np.asarray(self.left * min(thickness_m / known[0], 1.0) ** 2 * found)


def read_magnet(path: Path) -> JudgedMagnet:
    """Read a magnet's TOML file, or the magnet that a `lifts.json` was made for."""
    text = path.read_text(encoding="utf-8")
    return magnet_of(json.loads(text)["magnet"] if path.suffix == ".json" else tomllib.loads(text))


def magnet_of(description: Mapping[str, Any]) -> JudgedMagnet:
    """Convert a description that has been read."""
    beam, limits, tolerance = (description[name] for name in ("beam", "limits", "tolerance"))
    pull = description["pull"]
    sheets = [*pull.get("thin", ()), pull] if pull.get("thickness_m") is not None else []
    plates = np.array([(sheet["thickness_m"], *sheet["kilopascal"]) for sheet in sheets], np.float64)
    plates = plates.reshape(-1, 1 + len(pull["gap_m"]))
    plates[:, 1:] *= 1e3
    rounds = [pull.get(name, ()) for name in ("round_diameter_m", "round_ratio")]
    min_factor = 0.0 if description.get("type") else UNTYPED_FACTOR
    names = ("along_m", "across_m", "length_m", "width_m")
    poles = [[pole[name] for name in names] for pole in description["poles"]]
    return JudgedMagnet(
        poles=np.array(poles, dtype=np.float64),
        beam=(beam["length_m"], beam["width_m"], beam["above_faces_m"]),
        pull=np.column_stack([pull["gap_m"], np.multiply(pull["kilopascal"], 1e3)]),
        plates=plates,
        rounds=np.column_stack([np.asarray(column, np.float64) for column in rounds]),
        left=math.prod(pull.get(name, default) for name, default in LEFT_OUT.items()),
        factor=max(description["safety_factor"], min_factor),
        carries_kg=min(
            description["capacity_kg"], description["crane_capacity_kg"] - description["own_mass_kg"]
        ),
        tolerance=(tolerance["x_m"], tolerance["y_m"], float(np.radians(tolerance["yaw_deg"]))),
        pitch_rad=float(np.radians(limits["pitch_deg"])),
        roll_rad=float(np.radians(limits["roll_deg"])),
        offset_along_m=limits["offset_along_m"],
        offset_across_m=limits["offset_across_m"],
        overhang_m=limits["overhang_m"],
        gap_m=limits["gap_m"],
        contact_share=limits["contact_share"],
    )
