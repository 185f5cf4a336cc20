"""Rigid transforms, the best-fit plane and the patient frame, against exact answers and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import (
    apply,
    check_rigid,
    fit_plane,
    inverse,
    patient_from_base,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    unroll_quaternion_signs,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return rotation_from_quaternion(rng.standard_normal(4))


@given(SEEDS)
def test_quaternions_agree_with_an_independent_program(seed: int) -> None:
    quaternion = np.random.default_rng(seed).standard_normal((5, 4))
    theirs = Rotation.from_quat(np.roll(quaternion, -1, axis=1)).as_matrix()  # scipy is scalar-last
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), theirs, atol=1e-14)


@given(SEEDS)
def test_rotation_and_quaternion_undo_each_other(seed: int) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    quaternion = quaternion_from_rotation(rotation)
    assert quaternion[0] >= 0
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_quaternions_too(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-14)


def test_unrolled_neighbours_share_a_hemisphere() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0], [-0.99, 0.1, 0.0, 0.0], [0.98, -0.2, 0.0, 0.0]])
    unrolled = unroll_quaternion_signs(q)
    assert (np.einsum("ij,ij->i", unrolled[1:], unrolled[:-1]) > 0).all()
    np.testing.assert_allclose(rotation_from_quaternion(unrolled), rotation_from_quaternion(q))


@given(SEEDS)
def test_a_transform_and_its_inverse_leave_points_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    transform = rigid(random_rotation(rng), 100 * rng.standard_normal(3))
    check_rigid(transform, name="t")
    points = 100 * rng.standard_normal((7, 3))
    np.testing.assert_allclose(apply(inverse(transform), apply(transform, points)), points, atol=1e-10)


def plane_of(points: np.ndarray, *, head_x: np.ndarray, head_z: np.ndarray) -> np.ndarray:
    covariance = np.cov(points.T, bias=True)
    return fit_plane(points.mean(axis=0), covariance, head_x=head_x, head_z=head_z).plane_from_base


@given(SEEDS)
def test_the_plane_moves_with_the_points(seed: int) -> None:
    """Turning and shifting the base frame leaves coordinates in the plane as they were."""
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((200, 3)) * [30.0, 20.0, 0.5]
    x, z = np.array([1.0, 0.1, 0.0]), np.array([0.0, 0.05, 1.0])
    base = rigid(random_rotation(rng), 100 * rng.standard_normal(3))
    still = apply(plane_of(points, head_x=x, head_z=z), points)
    moved = apply(base, points)
    turned = plane_of(moved, head_x=base[:3, :3] @ x, head_z=base[:3, :3] @ z)
    np.testing.assert_allclose(apply(turned, moved), still, atol=1e-9)


def test_the_normal_follows_the_head_and_not_the_eigenvector() -> None:
    points = np.random.default_rng(0).standard_normal((100, 3)) * [30.0, 20.0, 0.1]
    for sign in (1.0, -1.0):
        plane = plane_of(points, head_x=np.array([1.0, 0.0, 0.0]), head_z=np.array([0.0, 0.0, sign]))
        assert plane[2, 2] * sign > 0.99
        assert np.linalg.det(plane[:3, :3]) == pytest.approx(1.0)


def test_a_line_spans_no_plane() -> None:
    points = np.linspace(0, 30, 50)[:, None] * [1.0, 0.0, 0.0]
    with pytest.raises(BadDataError, match="lie on a line"):
        plane_of(points, head_x=np.array([1.0, 0, 0]), head_z=np.array([0, 0, 1.0]))


def test_a_head_on_edge_is_a_convention_error() -> None:
    points = np.random.default_rng(0).standard_normal((100, 3)) * [30.0, 20.0, 0.1]
    with pytest.raises(BadDataError, match="degrees apart"):
        plane_of(points, head_x=np.array([0, 0, 1.0]), head_z=np.array([1.0, 0, 0]))


def test_the_patient_frame_has_its_origin_at_the_xiphoid_and_y_to_the_notch() -> None:
    notch, xiphoid = np.array([10.0, 180.0, 5.0]), np.array([10.0, 0.0, 5.0])
    patient = patient_from_base(notch, xiphoid, normal=np.array([0.0, 0.3, -1.0]))
    check_rigid(patient, name="patient")
    np.testing.assert_allclose(apply(patient, xiphoid), 0.0, atol=1e-12)
    np.testing.assert_allclose(apply(patient, notch), [0.0, 180.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(patient[2, :3], [0.0, 0.0, -1.0], atol=1e-12)  # the normal, made square to y


@pytest.mark.parametrize(
    ("notch", "normal", "words"),
    [([0.0, 0.5, 0.0], [0.0, 0.0, 1.0], "0.50 mm apart"), ([0.0, 100.0, 0.0], [0.0, 1.0, 0.0], "along the plane")],
)
def test_landmarks_that_fix_no_frame_are_refused(notch: list[float], normal: list[float], words: str) -> None:
    with pytest.raises(BadDataError, match=words):
        patient_from_base(np.array(notch), np.zeros(3), normal=np.array(normal))


@pytest.mark.parametrize("head_x", [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.01, 0.0, 1.0]])
def test_a_head_axis_without_direction_on_the_plane_is_refused(head_x: list[float]) -> None:
    with pytest.raises(BadDataError, match=r"perpendicular to the plane of motion .*scanhead_from_tracker"):
        fit_plane(np.zeros(3), np.diag([9.0, 4.0, 0.1]), head_x=np.array(head_x), head_z=np.array([0.0, 0.0, 1.0]))
