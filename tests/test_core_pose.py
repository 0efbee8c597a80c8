"""Poses: the group's axioms, the frames' names, and what a pose refuses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from barsight.core.errors import FrameMismatchError
from barsight.core.pose import Pose, nearest_rotation

angle = st.floats(-4, 4)
length = st.floats(-100, 100)


def poses(target: str, source: str) -> st.SearchStrategy[Pose]:
    return st.builds(
        lambda turn, place: Pose(target, source, Rotation.from_rotvec(turn).as_matrix(), np.array(place)),
        st.tuples(angle, angle, angle),
        st.tuples(length, length, length),
    )


def assert_close(one: Pose, other: Pose) -> None:
    assert (one.target, one.source) == (other.target, other.source)
    np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-10)


@given(poses("a", "b"), poses("b", "c"), poses("c", "d"))
def test_chaining_is_associative(a_from_b: Pose, b_from_c: Pose, c_from_d: Pose) -> None:
    assert_close((a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d))


@given(poses("a", "b"))
def test_identity_and_inverse(a_from_b: Pose) -> None:
    assert_close(a_from_b @ Pose.identity("b", "b"), a_from_b)
    assert_close(Pose.identity("a", "a") @ a_from_b, a_from_b)
    assert_close(a_from_b @ a_from_b.inverse(), Pose.identity("a", "a"))
    assert_close(a_from_b.inverse() @ a_from_b, Pose.identity("b", "b"))


@given(poses("a", "b"), poses("b", "c"), st.tuples(length, length, length))
def test_apply_follows_the_chain(a_from_b: Pose, b_from_c: Pose, point: tuple[float, ...]) -> None:
    points = np.array([point, (0, 0, 0)])
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points), a_from_b.apply(b_from_c.apply(points)), atol=1e-10
    )
    homogeneous = np.column_stack([points, np.ones(2)])
    np.testing.assert_allclose((homogeneous @ a_from_b.matrix.T)[:, :3], a_from_b.apply(points), atol=1e-10)


@given(poses("a", "b"))
def test_quaternion_round_trip(pose: Pose) -> None:
    quaternion = pose.quaternion_xyzw
    assert quaternion[3] >= 0
    assert abs(np.linalg.norm(quaternion) - 1) < 1e-12
    assert_close(Pose.from_quaternion_xyzw("a", "b", quaternion, pose.translation), pose)
    assert_close(Pose.from_quaternion_xyzw("a", "b", -2 * quaternion, pose.translation), pose)


def test_quaternion_order_is_tums() -> None:
    """A quarter turn about z takes x to y: qz = qw."""
    pose = Pose.from_quaternion_xyzw("a", "b", [0, 0, 1, 1], [0, 0, 0])
    np.testing.assert_allclose(pose.apply(np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-15)


def test_a_wrong_chain_raises() -> None:
    yard_from_body = Pose.identity("yard", "body")
    with pytest.raises(FrameMismatchError, match="yard_from_body @ cam0_from_rect0: body is not cam0"):
        yard_from_body @ Pose.identity("cam0", "rect0")
    other = Pose.identity("yard", "cam0")
    for compare in (yard_from_body.angle_to, yard_from_body.distance_to):
        with pytest.raises(FrameMismatchError, match="can't be compared"):
            compare(other)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.diag([1.0, 1, -1]), "yard_from_body is a reflection"),
        (np.diag([1.0, 1, 1.01]), "is not a rotation"),
        (np.zeros((3, 3)), "is not a rotation"),
        (np.full((3, 3), np.nan), "is not finite"),
        (np.eye(4), "expected 3x3"),
    ],
)
def test_what_is_no_rotation_is_refused(rotation: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Pose("yard", "body", rotation, np.zeros(3))


def test_matrix_shapes() -> None:
    matrix = np.hstack([np.eye(3), [[1], [2], [3]]])
    np.testing.assert_array_equal(Pose.from_matrix("a", "b", matrix).translation, [1, 2, 3])
    with pytest.raises(ValueError, match="4x4 or 3x4"):
        Pose.from_matrix("a", "b", np.eye(3))
    with pytest.raises(ValueError, match="last row"):
        Pose.from_matrix("a", "b", np.ones((4, 4)))


def test_rounding_is_projected_away() -> None:
    """A rotation printed with six digits becomes the nearest exact one."""
    exact = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    pose = Pose("a", "b", exact.round(6), np.zeros(3))
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(pose.rotation, exact, atol=1e-6)


def test_a_pose_neither_shares_nor_gives_away_its_arrays() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    pose = Pose("a", "b", rotation, translation)
    rotation[0, 0], translation[0] = 7, 7
    assert pose.rotation[0, 0] == 1
    assert pose.translation[0] == 0
    for array in (pose.rotation, pose.translation):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7
    pose.matrix[0, 0] = 7
    assert pose.matrix[0, 0] == 1


def test_the_nearest_rotation_is_kabschs_even_where_points_are_mirrored() -> None:
    rng = np.random.default_rng(3)
    source, turn = rng.normal(size=(20, 3)) * [1.0, 0.7, 0.1], Rotation.from_rotvec([0.3, -1.2, 2.0])
    found = nearest_rotation(turn.apply(source).T @ source)
    np.testing.assert_allclose(found, turn.as_matrix(), atol=1e-14)
    mirrored = nearest_rotation((turn.apply(source) * [1, 1, -1]).T @ source)
    kabsch, _ = Rotation.align_vectors(turn.apply(source) * [1, 1, -1], source)
    np.testing.assert_allclose(mirrored, kabsch.as_matrix(), atol=1e-12)
    assert np.linalg.det(mirrored) == pytest.approx(1)
