"""Free space: where the samples lie, whose they are, and what padding does."""

import pytest
import torch
from differences import gradcheck

from models import sample_free_space


def rays(d: int, g: int = 2, n: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    mask = torch.ones(g, n, dtype=torch.bool)
    mask[1, 2] = False
    return torch.randn(g, n, d, dtype=torch.float64), mask


def fractions_of(free: torch.Tensor, points: torch.Tensor, samples: int) -> torch.Tensor:
    """How far along its ray each sample lies, ``(g, n, samples)``; fails if it is off the ray."""
    along = free.reshape(*points.shape[:2], samples, points.shape[-1])
    share = (along * points[:, :, None]).sum(-1) / points.square().sum(-1)[..., None]
    torch.testing.assert_close(along, share[..., None] * points[:, :, None])
    return share


@pytest.mark.parametrize("d", [2, 3])
def test_each_stratum_of_each_ray_has_one_sample_and_the_surface_none(d):
    points, mask = rays(d)
    mask[:] = True
    free = sample_free_space(points, mask, 4, margin=0.2)
    assert free.shape == (2, 24, d)
    share = fractions_of(free, points, 4) / (1 - 0.2)
    for stratum in range(4):
        assert (share[..., stratum] >= stratum / 4).all()
        assert (share[..., stratum] <= (stratum + 1) / 4).all()


def test_every_ray_has_its_own_fractions():
    points, mask = rays(2)
    mask[:] = True
    share = fractions_of(sample_free_space(points, mask, 3), points, 3).reshape(-1, 3)
    assert len(share[:, 0].unique()) == len(share)


def test_a_generator_repeats_the_samples():
    points, mask = rays(3)
    first, second, third = (
        sample_free_space(points, mask, 3, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


def test_padded_rays_answer_the_origin_and_pass_no_gradient():
    points, mask = rays(2)
    points[1, 2] = torch.nan
    points.requires_grad_()
    free = sample_free_space(points, mask, 3)
    assert torch.equal(free[1, 6:9], torch.zeros(3, 2, dtype=torch.float64))
    free.sum().backward()
    assert torch.equal(points.grad[1, 2], torch.zeros(2, dtype=torch.float64))
    assert points.grad.isfinite().all()


def test_the_gradient_in_the_points():
    points, mask = rays(3, n=3)
    assert gradcheck(
        lambda x: sample_free_space(x, mask, 2, torch.Generator().manual_seed(1)), (points.requires_grad_(),)
    )


@pytest.mark.parametrize(
    ("samples", "margin", "words"),
    [(0, 0.1, "samples is 0"), (3, 1.0, "margin is 1.0"), (3, -0.1, "margin is -0.1")],
)
def test_wrong_settings_are_refused_in_words(samples, margin, words):
    points, mask = rays(2)
    with pytest.raises(ValueError, match=words):
        sample_free_space(points, mask, samples, margin=margin)
