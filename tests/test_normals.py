"""Normals and the axes they come from: compiled against torch, and where the thinnest direction is not unique."""

import numpy as np
import pytest
import torch
from differences import gradcheck

from bbr_layer import estimate_normals, normals, point_spacing
from bbr_layer.neighbourhoods import nearest_neighbours

CLOUDS = {
    "scattered": lambda: torch.randn(200, 3, dtype=torch.float64),
    "far and small": lambda: 1e4 + 1e-3 * torch.randn(200, 3, dtype=torch.float64),
    "a plane": lambda: torch.rand(200, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0]),
    "a line": lambda: torch.rand(200, 1, dtype=torch.float64) * torch.tensor([1.0, 2.0, 3.0]),
    "one place": lambda: torch.ones(20, 3, dtype=torch.float64),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_compiled_axes_are_those_of_torch(name):
    points = CLOUDS[name]()[None]
    index = nearest_neighbours(points, 8)
    variances, axes = normals._axes(points, index)
    covariance = normals._covariance(points, index)
    scale = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).max()
    torch.testing.assert_close(
        variances, torch.linalg.eigvalsh(covariance), atol=1e-14 * float(scale) + 1e-30, rtol=1e-9
    )
    rebuilt = axes @ torch.diag_embed(variances) @ axes.mT
    torch.testing.assert_close(rebuilt, covariance, atol=1e-13 * float(scale) + 1e-30, rtol=1e-9)
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3, dtype=torch.float64).expand_as(axes), atol=1e-12, rtol=0)


@pytest.mark.parametrize("d", [2, 3])
def test_the_gradient_is_that_of_differences_and_asking_for_it_changes_nothing(d):
    points = torch.randn(12, d, dtype=torch.float64)
    plain = estimate_normals(points, 5)
    assert torch.equal(estimate_normals(points.clone().requires_grad_(), 5), plain)
    assert gradcheck(lambda x: estimate_normals(x, 5), (points.requires_grad_(),), eps=1e-7, atol=1e-5)


def test_an_arbitrary_normal_has_no_gradient():
    line = (torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, 3.0])).requires_grad_()
    found = estimate_normals(line)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(20, dtype=torch.float64))
    assert np.abs((found @ torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)).detach().numpy()).max() < 1e-6
    (gradient,) = torch.autograd.grad((found * torch.randn_like(found)).sum(), line)
    assert torch.isfinite(gradient).all()


def test_a_second_derivative_is_refused_in_words():
    P = torch.randn(20, 3, dtype=torch.float64, requires_grad=True)
    (first,) = torch.autograd.grad(estimate_normals(P).pow(3).sum(), P, create_graph=True)
    with pytest.raises(RuntimeError, match=r"first derivatives only.*its normals given"):
        first.sum().backward()


def test_no_points_have_no_normals_and_whole_numbers_have_some(as_a_user):
    assert estimate_normals(torch.zeros(0, 3)).shape == (0, 3)
    grid = torch.cartesian_prod(torch.arange(4), torch.arange(4), torch.arange(1))
    torch.testing.assert_close(estimate_normals(grid).abs(), torch.tensor([0.0, 0.0, 1.0]).double().expand(16, 3))


def test_what_is_written_past_torch_is_seen():
    first, second = torch.randn(2, 1, 30, 3, dtype=torch.float64)
    wanted = estimate_normals(second), point_spacing(second)
    for write in (lambda x: x.data.copy_(second), lambda x: x.numpy().__setitem__(..., second.numpy())):
        points = first.clone()
        estimate_normals(points), point_spacing(points)
        write(points)
        assert torch.equal(estimate_normals(points), wanted[0]) and torch.equal(point_spacing(points), wanted[1])


def test_padding_does_not_turn_normals():
    points = torch.nn.functional.normalize(torch.randn(60, 3, dtype=torch.float64), dim=-1)
    padded, mask = torch.cat((points, torch.full((60, 3), 50.0).double())), torch.arange(120) < 60
    torch.testing.assert_close(estimate_normals(padded, mask=mask)[:60], estimate_normals(points))
