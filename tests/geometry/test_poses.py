"""Poses against scipy's rotations and matrix exponential, over the whole range of angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from prism_edge.geometry import poses

NUMBERS = st.floats(-50.0, 50.0)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)
# Directions crossed with angles that matter: none, tiny, about the series' threshold, right, nearly pi, pi.
ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 1e-3, np.pi / 2, np.pi - 1e-3, np.pi - 1e-7, np.pi]),
    st.floats(0.0, np.pi),
)
AXES = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.05)
ROTATION_VECTORS = st.tuples(AXES, ANGLES).map(lambda p: p[0] / np.linalg.norm(p[0]) * p[1])
TWISTS = st.tuples(VECTORS, ROTATION_VECTORS).map(np.concatenate)


def hat(twist: np.ndarray) -> np.ndarray:
    """The 4x4 matrix of the Lie algebra, whose matrix exponential is the pose."""
    out = np.zeros((4, 4))
    out[:3, :3] = np.array([[0, -twist[5], twist[4]], [twist[5], 0, -twist[3]], [-twist[4], twist[3], 0]])
    out[:3, 3] = twist[:3]
    return out


@settings(max_examples=50, deadline=None)
@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(v: np.ndarray, w: np.ndarray) -> None:
    np.testing.assert_allclose(poses.skew(v) @ w, np.cross(v, w), atol=1e-9)


@settings(max_examples=150, deadline=None)
@given(ROTATION_VECTORS)
def test_so3_exp_agrees_with_scipy(vector: np.ndarray) -> None:
    np.testing.assert_allclose(poses.so3_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


@settings(max_examples=150, deadline=None)
@given(ROTATION_VECTORS)
def test_so3_log_inverts_exp(vector: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(vector).as_matrix()
    found = poses.so3_log(rotation)
    assert np.linalg.norm(found) <= np.pi + 1e-9
    np.testing.assert_allclose(Rotation.from_rotvec(found).as_matrix(), rotation, atol=1e-9)
    if np.linalg.norm(vector) < np.pi - 1e-3:  # beyond, both signs of the axis are right
        np.testing.assert_allclose(found, vector, atol=1e-9)


@settings(max_examples=150, deadline=None)
@given(TWISTS)
@example(np.array([3.0, -2.0, 1.0, 0.0, 0.0, 1.0001e-4]))
@example(np.array([3.0, -2.0, 1.0, 0.0, 0.99e-4, 0.0]))
def test_se3_exp_agrees_with_the_matrix_exponential(twist: np.ndarray) -> None:
    np.testing.assert_allclose(poses.se3_exp(twist), expm(hat(twist)), atol=1e-6)


@settings(max_examples=150, deadline=None)
@given(TWISTS)
@example(np.array([30.0, -20.0, 10.0, 0.0, 0.0, np.pi]))
@example(np.array([30.0, -20.0, 10.0, 1.2e-4, 0.0, 0.0]))
def test_se3_log_inverts_exp(twist: np.ndarray) -> None:
    pose = expm(hat(twist))
    found = poses.se3_log(pose)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(expm(hat(found)), pose, atol=1e-5)
    if np.linalg.norm(twist[3:]) < np.pi - 1e-3:
        np.testing.assert_allclose(found, twist, atol=1e-5)


@settings(max_examples=150, deadline=None)
@given(ROTATION_VECTORS)
def test_quaternions_agree_with_scipy(vector: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(vector)
    quaternion = poses.quaternion_from_rotation(rotation.as_matrix())
    assert quaternion[3] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    assert abs(quaternion @ rotation.as_quat()) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(poses.rotation_from_quaternion(quaternion), rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        poses.rotation_from_quaternion(-3.7 * quaternion), rotation.as_matrix(), atol=1e-12
    )


@settings(max_examples=100, deadline=None)
@given(ROTATION_VECTORS)
def test_rotation_angle_is_the_length_of_the_rotation_vector(vector: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(vector).as_matrix()
    assert poses.rotation_angle(rotation) == pytest.approx(np.linalg.norm(vector), abs=1e-7)


@settings(max_examples=50, deadline=None)
@given(TWISTS, TWISTS)
def test_inverse_of_one_and_of_a_stack(first: np.ndarray, second: np.ndarray) -> None:
    stack = np.stack([poses.se3_exp(first), poses.se3_exp(second)])
    np.testing.assert_allclose(poses.inverse(stack), np.linalg.inv(stack), atol=1e-9)
    np.testing.assert_allclose(poses.inverse(stack[0]), np.linalg.inv(stack[0]), atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(TWISTS, AXES, AXES)
def test_the_adjoint_tells_a_twist_in_other_axes(fixed: np.ndarray, way: np.ndarray, turn: np.ndarray):
    pose, twist = poses.se3_exp(fixed), np.concatenate([way, turn])
    there = pose @ poses.se3_exp(twist) @ poses.inverse(pose)
    np.testing.assert_allclose(poses.se3_exp(poses.adjoint(pose) @ twist), there, atol=1e-8)


@settings(max_examples=50, deadline=None)
@given(TWISTS, st.floats(0.01, 100.0))
def test_transform_and_scaled(twist: np.ndarray, factor: float) -> None:
    pose = poses.se3_exp(twist)
    points = np.random.default_rng(0).normal(size=(7, 3))
    homogeneous = np.c_[points, np.ones(7)] @ pose.T
    np.testing.assert_allclose(poses.transform(pose, points), homogeneous[:, :3], atol=1e-9)
    np.testing.assert_allclose(
        poses.transform(poses.scaled(pose, factor), factor * points),
        factor * poses.transform(pose, points),
        rtol=1e-9,
        atol=1e-9,
    )
    np.testing.assert_array_equal(pose, poses.se3_exp(twist))  # scaled() leaves its argument alone


@settings(max_examples=50, deadline=None)
@given(TWISTS, st.floats(1e-9, 1e-2))
def test_normalised_is_a_rotation_near_the_given_matrix(twist: np.ndarray, noise: float) -> None:
    pose = poses.se3_exp(twist)
    drifted = pose.copy()
    drifted[:3, :3] += np.random.default_rng(3).uniform(-noise, noise, size=(3, 3))
    rigid = poses.normalised(drifted)
    np.testing.assert_allclose(rigid[:3, :3] @ rigid[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rigid[:3, :3]) == pytest.approx(1.0)
    assert np.abs(rigid - pose).max() < 4 * noise
    np.testing.assert_array_equal(rigid[:3, 3], pose[:3, 3])


def test_rotations_are_told_from_what_is_none():
    turned = np.array([poses.so3_exp(np.array([0.1 * k, -0.4, 0.2])) for k in range(4)])
    assert poses.are_rotations(turned, 1e-9)
    assert poses.are_rotations(turned[0], 1e-9)
    assert poses.are_rotations(turned[:0], 1e-9)
    assert poses.are_rotations(1.004 * turned, 0.01)
    for wrong in (1.006 * turned[1], np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan), np.zeros((3, 3))):
        assert not poses.are_rotations(wrong, 0.01)
        assert not poses.are_rotations(np.array([turned[0], wrong]), 0.01)


@pytest.mark.parametrize("angle", [1e-11, 1e-6, 9e-5])
def test_small_turns_come_back_to_their_last_digits(angle: float) -> None:
    """As steps of a solver are, and a camera's that stands: next to a metre they count as well."""
    twist = np.array([1.0, -2.0, 0.5, *(angle * np.array([0.6, 0.0, -0.8]))])
    found = poses.se3_log(poses.se3_exp(twist))
    assert found[3:] == pytest.approx(twist[3:], rel=1e-5)
    assert found[:3] == pytest.approx(twist[:3], abs=1e-14)
