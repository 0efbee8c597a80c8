"""Form one frame's normal equations with the points taken as known (motion-only adjustment)."""

from __future__ import annotations

from barsight.core.arrays import Float64, kernel
from barsight.motion.linear.reprojection_kernels import (
    POSE,
    LinearisationPoint,
    Observations,
    PointTerms,
    Rig,
    empty_rows,
    whitened_rows,
)


@kernel()
def frame_equations(
    rig: Rig,
    observations: Observations,
    guess: LinearisationPoint,
    frame: int,
    normal: Float64,
    gradient: Float64,
) -> None:
    """Add the frame's used sightings to the normal matrix (6, 6) and gradient (6,) of its pose."""
    lens, mount, camera, points, rows = rig.lens, rig.mount, guess.camera, guess.points, empty_rows()
    stereo, weight, node, last = (
        observations.stereo,
        observations.weight,
        observations.node,
        len(guess.shared) - 1,
    )
    given = PointTerms(rig.huber, observations.scale, 0.0, guess.shared[last - 1], guess.shared[last])
    for t in range(len(observations.first) - 1):
        for k in range(observations.first[t], observations.first[t + 1]):
            if not observations.used[k] or node[k] != frame:
                continue
            whitened_rows(lens, mount, camera, points, stereo, weight[k], given, (frame, k, t), rows)
            for a in range(6):
                for i in range(3):
                    gradient[a] += rows[i, POSE + a] * rows[i, 0]
                    for b in range(6):
                        normal[a, b] += rows[i, POSE + a] * rows[i, POSE + b]
