"""Read a magnet's description as the judge needs it, from its TOML file or from `lifts.json`."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float64


@dataclass(frozen=True, eq=False)
class JudgedMagnet:
    """poles: (P, 4) along, across, length, width. beam: length, width, height over the faces. pull: (K, 2)
    gap and Pa. tolerance: half sides in yard axes and rad. carries_kg: the least of magnet and crane.
    """

    poles: Float64
    beam: tuple[float, float, float]
    pull: Float64
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
        """Return the gap from which on nothing is pulled."""
        return float(self.pull[-1, 0])

    @property
    def half_span_m(self) -> float:
        """Return the way from the centre to the outermost pole's outer edge."""
        return float((np.abs(self.poles[:, 0]) + self.poles[:, 2] / 2).max())

    def pressure(self, gap_m: Float64) -> Float64:
        """Compute the pull per area at each gap, Pa: the data sheet's line, 0 beyond its end."""
        return np.interp(gap_m, self.pull[:, 0], self.pull[:, 1], right=0.0)


def read_magnet(path: Path) -> JudgedMagnet:
    """Read a magnet's TOML file, or the magnet that a `lifts.json` was made for."""
    text = path.read_text(encoding="utf-8")
    return magnet_of(json.loads(text)["magnet"] if path.suffix == ".json" else tomllib.loads(text))


def magnet_of(description: Mapping[str, Any]) -> JudgedMagnet:
    """Take over a description that was read."""
    beam, limits, tolerance = (description[name] for name in ("beam", "limits", "tolerance"))
    pull = description["pull"]
    names = ("along_m", "across_m", "length_m", "width_m")
    poles = [[pole[name] for name in names] for pole in description["poles"]]
    return JudgedMagnet(
        poles=np.array(poles, dtype=np.float64),
        beam=(beam["length_m"], beam["width_m"], beam["above_faces_m"]),
        pull=np.column_stack([pull["gap_m"], np.multiply(pull["kilopascal"], 1e3)]),
        factor=description["safety_factor"],
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
