"""Check equations numerically: the printed Eq. 20 against the true minimiser."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.registration.rigid import align_rigid


def printed_rotation(source: Float64, target: Float64) -> Float64:
    """Compute U V^T (3, 3) of [paper Eq. 19-20] as printed, from points (N, 3)."""
    moment = (source - source.mean(0)).T @ (target - target.mean(0))
    left, _, right = np.linalg.svd(moment)
    rotation: Float64 = left @ right
    return rotation


def rotation_errors_deg(turn_deg: float = 10.0, seed: int = 20) -> tuple[float, float]:
    """Compute the errors of Eq. 20, as printed and as corrected, for a known rotation about Z, degrees."""
    rng = np.random.default_rng(seed)
    truth = Rotation.from_euler("z", turn_deg, degrees=True)
    source = rng.normal(size=(50, 3))
    target = truth.apply(source) + rng.normal(size=3)
    found = align_rigid(source, target, ("new", "old"))
    assert not isinstance(found, Failed)
    off = [
        np.degrees((truth.inv() * Rotation.from_matrix(rotation)).magnitude())
        for rotation in (printed_rotation(source, target), found.target_from_source.rotation)
    ]
    return float(off[0]), float(off[1])
