"""Define rigid poses that carry their frames: `yard_from_cam0 = yard_from_body @ body_from_cam0`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, expect_shape
from barsight.core.errors import FrameMismatchError

ORTHONORMAL_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Pose:
    """The rigid motion `x_target = rotation @ x_source + translation`.

    target, source: names of the frames; the pose is called `target_from_source`.
    rotation: (3, 3) float64, orthonormal, determinant +1. translation: (3,) float64, metres.
    Raises ValueError for a rotation that is none (beyond rounding, which is projected away).
    """

    target: str
    source: str
    rotation: Float64
    translation: Float64

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64).reshape(-1)
        expect_shape("rotation", rotation, (3, 3))
        expect_shape("translation", translation, (3,))
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ValueError(f"{self.target}_from_{self.source} is not finite")
        largest = float(np.abs(rotation).max())
        defect = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if largest < 10 else largest
        if defect > ORTHONORMAL_TOLERANCE:
            raise ValueError(
                f"{self.target}_from_{self.source} is not a rotation: |R R^T - 1| = {defect:.2g}"
            )
        if np.linalg.det(rotation) < 0:
            raise ValueError(f"{self.target}_from_{self.source} is a reflection (determinant -1)")
        if defect > 1e-12:
            rotation = nearest_rotation(rotation)
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls, target: str, source: str) -> Pose:
        """Return the pose of two frames that coincide."""
        return cls(target, source, np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, target: str, source: str, matrix: ArrayLike) -> Pose:
        """Build from a 4x4 (or 3x4) homogeneous matrix."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"a pose needs a 4x4 or 3x4 matrix, not {m.shape}")
        if m.shape == (4, 4) and not np.allclose(m[3], (0, 0, 0, 1), atol=1e-9):
            raise ValueError(f"the last row of a pose must be 0 0 0 1, not {m[3]}")
        return cls(target, source, m[:3, :3], m[:3, 3])

    @classmethod
    def from_quaternion_xyzw(
        cls, target: str, source: str, quaternion: ArrayLike, translation: ArrayLike
    ) -> Pose:
        """Build from a quaternion in TUM's order `qx qy qz qw` (normalised here) and a translation (m)."""
        rotation = Rotation.from_quat(np.asarray(quaternion, dtype=np.float64)).as_matrix()
        return cls(target, source, rotation, np.asarray(translation, dtype=np.float64))

    @property
    def matrix(self) -> Float64:
        """Return the homogeneous matrix (4, 4)."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation
        return m

    @property
    def quaternion_xyzw(self) -> Float64:
        """Return the unit quaternion (4,) `qx qy qz qw` with qw >= 0."""
        return Rotation.from_matrix(self.rotation).as_quat(canonical=True)

    def __matmul__(self, other: Pose) -> Pose:
        if self.source != other.target:
            raise FrameMismatchError(
                f"{self.target}_from_{self.source} @ {other.target}_from_{other.source}: "
                f"{self.source} is not {other.target}"
            )
        return Pose(
            self.target,
            other.source,
            self.rotation @ other.rotation,
            self.rotation @ other.translation + self.translation,
        )

    def inverse(self) -> Pose:
        """Invert to `source_from_target`."""
        return Pose(self.source, self.target, self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Float64) -> Float64:
        """Transform points (..., 3) in `source` to points (..., 3) in `target`, metres."""
        moved: Float64 = points @ self.rotation.T + self.translation
        return moved

    def angle_to(self, other: Pose) -> float:
        """Compute the rotation angle between two poses of the same two frames, radians."""
        self._expect_same_frames(other)
        return float(Rotation.from_matrix(self.rotation.T @ other.rotation).magnitude())

    def distance_to(self, other: Pose) -> float:
        """Compute the distance between two poses' origins, metres."""
        self._expect_same_frames(other)
        return float(np.linalg.norm(self.translation - other.translation))

    def _expect_same_frames(self, other: Pose) -> None:
        if (self.target, self.source) != (other.target, other.source):
            raise FrameMismatchError(
                f"{self.target}_from_{self.source} can't be compared with {other.target}_from_{other.source}"
            )


def skew(vectors: Float64) -> Float64:
    """Build skew matrices (..., 3, 3) of vectors (..., 3): `skew(v) @ w = v x w`."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def nearest_rotation(matrix: Float64) -> Float64:
    """Project a matrix (3, 3) onto SO(3): U diag(1, 1, det U V^T) V^T of its singular vectors U, V.

    Of the moment `sum target source^T` of centred points this is the rotation target from source with the
    least squares [Kabsch 1976, Arun 1987, Umeyama 1991].
    """
    u, _, vt = np.linalg.svd(matrix)
    rotation: Float64 = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation
