"""Form one frame's normal equations by points taken as known (motion-only adjustment)."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, kernel
from barsight.motion.linear.reprojection_kernels import LinearisationPoint, Observations, Rig, whitened_rows


@kernel(fastmath=True)
def frame_equations(
    rig: Rig, sights: Observations, guess: LinearisationPoint, frame: int, normal: Float64, gradient: Float64
) -> None:  # fmt: skip
    """Add to the matrix (6, 6) and gradient (6,) of the frame's pose what its used sightings say."""
    lens, mount, huber, scale = rig.lens, rig.mount, rig.huber, sights.scale
    first, node, used, stereo, weight = sights.first, sights.node, sights.used, sights.stereo, sights.weight
    camera, points, shared = guess.camera, guess.points, guess.shared
    error, q, by_shared, by_pose, by_point = (
        np.empty(3), np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 4)),
    )  # fmt: skip
    for t in range(len(first) - 1):
        for k in range(first[t], first[t + 1]):
            if not used[k] or node[k] != frame:
                continue
            whitened_rows(
                lens, mount, huber, camera, points, shared, 0.0, scale, stereo, weight, frame, k, t, error, q,
                by_pose, by_point, by_shared,
            )  # fmt: skip
            for a in range(6):
                for i in range(3):
                    gradient[a] += by_pose[i, a] * error[i]
                    for b in range(6):
                        normal[a, b] += by_pose[i, a] * by_pose[i, b]
