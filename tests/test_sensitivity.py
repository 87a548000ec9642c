"""On a cloud and its exact copy the default layer's gradient is the sensitivity of the alignment, and no more.

Moving one source point by a unit of its pair's plane moves a least-squares pose by ``information^-1 J^T``; over all
points the derivative of pose component k has the norm ``sqrt((information^-1)_kk)``. Past convergence an unrolled
loop at a constant rate reaches 1e8 times that.
"""

import math

import numpy as np
import pytest
import torch
from problems import bumpy
from torch import Tensor

from bbr_layer import Adam, BBRLayer, Implicit, RigidMotion
from benchmarks.planar import tangent

FACTOR = 2.0


def exact_copy(P: Tensor) -> Tensor:
    """The cloud turned by 20 degrees and shifted."""
    d = P.shape[1]
    axis = torch.tensor([1.0] if d == 2 else [0.6, 0.0, 0.8], dtype=torch.float64)
    shift = 0.05 * P.std() * torch.ones(d, dtype=torch.float64)
    return RigidMotion.from_rotvec(math.radians(20) * axis, shift).inverse()(P)


def shares_of_sensitivity(layer: BBRLayer, P: Tensor, Q: Tensor | None = None) -> Tensor:
    """For each component of the pose the norm of its gradient over the analytic one; ``Q`` is an exact copy."""
    Q = (exact_copy(P) if Q is None else Q.clone()).requires_grad_()
    result = layer(P, Q)
    wanted = torch.linalg.inv(result.information).diagonal().sqrt()
    found = [torch.autograd.grad(x, Q, retain_graph=True)[0].norm() for x in tangent(result, Q)]
    return torch.stack(found) / wanted


def assert_honest(shares: Tensor) -> None:
    assert ((shares > 1 / FACTOR) & (shares < FACTOR)).all(), shares


@pytest.mark.parametrize("n", [100, 500])
def test_an_exact_copy_of_a_surface(n):
    assert_honest(shares_of_sensitivity(BBRLayer(), bumpy(n, 3)))


@pytest.mark.parametrize("layer", [BBRLayer(), BBRLayer.fast(), BBRLayer.robust()], ids=["default", "fast", "robust"])
@pytest.mark.parametrize("shift", [0.0, 0.01], ids=["itself", "moved"])
def test_an_exact_copy_begun_where_it_ends(shift, layer):
    # Centroid on centroid is the answer here: nothing is left of the gradient but its rounding. Every fourth point lies
    # anywhere, with a normal of its own.
    P = torch.cat((bumpy(300, 3), 2 * torch.rand(100, 3, dtype=torch.float64) - 1))
    assert_honest(shares_of_sensitivity(layer, P, P - shift))


@pytest.mark.parametrize("layer", [BBRLayer(), BBRLayer.fast()], ids=["default", "fast"])
@pytest.mark.parametrize("n", [50, 100, 500, 2000])
def test_an_exact_copy_of_a_curve(n, layer):
    assert_honest(shares_of_sensitivity(layer, bumpy(n, 2)))


def test_an_exact_copy_of_a_curve_registered_by_f():
    assert_honest(shares_of_sensitivity(BBRLayer("F"), bumpy(100, 2)))


def test_soft_buddies_of_a_dense_curve_alone_are_another_matter():
    # At a rate far above the spacing of the points their unroll is chaotic: what the default layer avoids.
    shares = shares_of_sensitivity(BBRLayer("softBBS"), bumpy(500, 2))
    assert shares.max() > 1e3


@pytest.mark.parametrize("n", [100, 500])
def test_an_exact_copy_of_a_curve_through_the_optimum(n):
    assert_honest(shares_of_sensitivity(BBRLayer(backward=Implicit()), bumpy(n, 2)))


@pytest.mark.parametrize("name", ["bun_zipper", "horse", "dragon_vrip_res3"])
def test_an_exact_copy_of_a_real_surface(real_data, name):
    points = torch.from_numpy(np.load(real_data / f"model_{name}.npz")["points"]).double()
    for n in (100, 500):
        assert_honest(shares_of_sensitivity(BBRLayer(), points[torch.randperm(len(points))[:n]]))


def test_a_registration_cut_short_is_another_matter():
    shares = shares_of_sensitivity(BBRLayer("F", inner=Adam(20)), bumpy(250, 3))
    assert not ((shares > 1 / FACTOR) & (shares < FACTOR)).all()


@pytest.mark.parametrize("layer", [BBRLayer(), BBRLayer.fast(), BBRLayer.robust()], ids=["default", "fast", "robust"])
@pytest.mark.parametrize("kind", ["another sample", "an exact copy"])
def test_the_gradient_through_all_stages_is_that_of_central_differences(layer, kind):
    P = bumpy(100, 3)
    Q = exact_copy(P if kind == "an exact copy" else bumpy(100, 3))
    mix = torch.randn(6, dtype=torch.float64)

    def pose(P: Tensor, Q: Tensor) -> Tensor:
        found = layer(P, Q).target_from_source
        return (torch.cat((found.rotvec, found.translation)) * mix).sum()

    leaves = P.clone().requires_grad_(), Q.clone().requires_grad_()
    gradients = torch.autograd.grad(pose(*leaves), leaves)
    step = 1e-9  # wider ones measure buddies that change hands
    for _ in range(4):
        along = [torch.randn_like(x) for x in (P, Q)]
        ahead, behind = (pose(P + s * step * along[0], Q + s * step * along[1]).item() for s in (1, -1))
        own = sum((g * a).sum().item() for g, a in zip(gradients, along, strict=True))
        assert own == pytest.approx((ahead - behind) / (2 * step), rel=1e-2, abs=1e-3 * gradients[1].norm().item())
