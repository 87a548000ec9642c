"""Rotations and motions: against the matrix exponential, at their singular points, and their derivatives."""

import math

import numpy as np
import pytest
import reference
import torch
from differences import gradcheck, gradgradcheck
from problems import motion

from bbr_layer import RigidMotion, angular_error, translation_error
from bbr_layer.rotations import (
    euler_from_rotation,
    rotation_from_euler,
    rotation_from_rotvec,
    rotvec_from_rotation,
    skew,
)

ANGLES = [0.0, 1e-9, 1e-3, 0.0316, 0.0317, 1.0, 3.1, math.pi]


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("k", [1, 3])
def test_exponential_and_logarithm(angle, k):
    axis = torch.randn(20, k, dtype=torch.float64)
    rotvec = axis / axis.norm(dim=-1, keepdim=True) * angle
    R = rotation_from_rotvec(rotvec)
    torch.testing.assert_close(R, torch.matrix_exp(skew(rotvec)), rtol=0, atol=1e-14)
    again = rotation_from_rotvec(rotvec_from_rotation(R))
    torch.testing.assert_close(again, R, rtol=0, atol=1e-7 if angle == math.pi else 1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, 3.1])
def test_derivatives_of_exponential_and_logarithm(angle):
    rotvec = (torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) * angle).requires_grad_()
    assert gradcheck(rotation_from_rotvec, (rotvec,))
    assert gradgradcheck(rotation_from_rotvec, (rotvec,))
    assert gradcheck(lambda w: rotvec_from_rotation(rotation_from_rotvec(w)), (rotvec,))


def test_half_turn_has_an_axis_and_a_finite_gradient():
    R = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)).requires_grad_()
    rotvec = rotvec_from_rotation(R)
    torch.testing.assert_close(rotvec.abs(), torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))
    assert torch.isfinite(torch.autograd.grad(rotvec.sum(), R)[0]).all()


def test_euler_is_the_papers():
    for a, b, c in torch.rand(5, 3).tolist():
        angles = torch.tensor([a, b, c], dtype=torch.float64)
        R = rotation_from_euler(angles)
        torch.testing.assert_close(R, reference.euler_rotation(a, b, c), rtol=0, atol=1e-7)
        torch.testing.assert_close(euler_from_rotation(R), angles)


def test_gimbal_lock_keeps_the_rotation_and_a_finite_gradient():
    R = rotation_from_euler(torch.tensor([0.3, math.pi / 2, 0.5], dtype=torch.float64)).requires_grad_()
    angles = euler_from_rotation(R)
    torch.testing.assert_close(rotation_from_euler(angles), R, rtol=0, atol=1e-12)
    assert torch.isfinite(torch.autograd.grad(angles.sum(), R)[0]).all()


@pytest.mark.parametrize("d", [2, 3])
def test_motions_compose_invert_and_carry(d):
    outer, inner = motion(d, 0.7, 2.0), motion(d, -1.2, 0.3)
    points = torch.randn(4, 5, d, dtype=torch.float64)
    torch.testing.assert_close((outer @ inner)(points), outer(inner(points)))
    torch.testing.assert_close(outer.inverse()(outer(points)), points)
    torch.testing.assert_close(RigidMotion.from_matrix(outer.matrix).matrix, outer.matrix)
    torch.testing.assert_close((outer @ inner).matrix, outer.matrix @ inner.matrix)


@pytest.mark.parametrize("d", [2, 3])
def test_errors_measure_angle_and_distance(d):
    first, second = motion(d, 0.4), motion(d, 0.4 + 1e-7, 0.2)
    torch.testing.assert_close(angular_error(first.rotation, second.rotation).item(), 1e-7, rtol=1e-6, atol=0)
    assert angular_error(first.rotation, motion(d, 0.4 + math.pi).rotation).item() == pytest.approx(math.pi)
    expected = 0.1 * math.sqrt(d)
    assert translation_error(first.translation, second.translation).item() == pytest.approx(expected)


@pytest.mark.parametrize("d", [2, 3])
def test_the_motion_between_two_poses_leads_through_their_world(d):
    poses = RigidMotion(*(torch.stack(parts) for parts in zip(*(motion(d, 0.3 * k) for k in range(4)), strict=True)))
    poses = RigidMotion(poses.rotation, torch.randn(4, d, dtype=torch.float64))
    points = torch.randn(5, d, dtype=torch.float64)
    target, source = torch.tensor([0, 3, 2]), torch.tensor([1, 1, 2])
    found = poses.between(target, source)
    for row, (i, j) in enumerate(zip(target.tolist(), source.tolist(), strict=True)):
        in_world = poses.item(j)(points)
        torch.testing.assert_close(poses.item(i)(found.item(row)(points)), in_world)
        torch.testing.assert_close(poses.between(i, j).matrix, found.item(row).matrix)
    torch.testing.assert_close(found.item(2).matrix, torch.eye(d + 1, dtype=torch.float64))


def test_whole_numbers_are_not_cut_off(as_a_user):
    motion = RigidMotion(np.eye(3), np.full(3, 0.5))
    np.testing.assert_array_equal(motion(np.array([[1, 2, 3]])), [[1.5, 2.5, 3.5]])
    quarter = RigidMotion.from_rotvec(torch.tensor([0.0, 0.0, torch.pi / 4]), torch.zeros(3))
    torch.testing.assert_close(quarter.rotate(torch.tensor([[1, 0, 0]])), torch.tensor([[0.5**0.5, 0.5**0.5, 0.0]]))
