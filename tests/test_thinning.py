"""Fewer points for a stage: even in space, as many as asked for, and differentiable in those that are kept."""

import math

import numpy as np
import pytest
import torch
from problems import bumpy, motion

from bbr_layer import (
    Adam,
    BBRLayer,
    BuddyFilter,
    CloudPair,
    Detached,
    GaussNewton,
    SoftBBS,
    Stage,
    Unrounded,
    angular_error,
)
from bbr_layer.named_stages import FINE_POINTS, REACH
from bbr_layer.thinning import evenly_thinned, thinned_pair


@pytest.mark.parametrize("most", [1, 7, 100, 900])
def test_no_more_than_asked_for_and_not_many_fewer(rng, most):
    points = rng.random((1000, 3))
    kept = evenly_thinned(points, most)
    assert most / 2 <= len(kept) <= most
    assert (np.diff(kept) > 0).all()


def test_at_least_one_point_is_left(as_a_user):
    with pytest.raises(ValueError, match="most is 0; at least one point must be left: try 1000"):
        evenly_thinned(np.zeros((5, 3)), 0)


def test_dense_places_are_thinned_most(rng):
    points = np.concatenate((rng.random((2000, 2)), 0.01 * rng.random((2000, 2)) + 5))
    kept = evenly_thinned(points, 300)
    assert (kept >= 2000).sum() < 30 < (kept < 2000).sum()


def test_few_points_are_all_kept_and_equal_ones_are_one(rng):
    assert evenly_thinned(rng.random((5, 3)), 5).tolist() == [0, 1, 2, 3, 4]
    assert evenly_thinned(np.ones((50, 3)), 10).tolist() == [0]


def test_a_pair_keeps_its_companions_and_leaves_padding_out():
    P, Q = torch.rand(2, 300, 3), torch.rand(2, 40, 3)
    mask = torch.arange(300)[None] < torch.tensor([[300], [90]])
    pair = CloudPair(P, Q, P_normals=P + 1, P_weights=P[..., 0], P_mask=mask, spacing=torch.ones(2))
    thin = thinned_pair(pair, 100)
    assert thin.Q is Q and thin.P.shape[1] <= 100 and thin.P_mask is not None
    assert thin.P_mask[1].sum() == 90
    torch.testing.assert_close(thin.P_normals, thin.P + 1)
    torch.testing.assert_close(thin.P_weights, thin.P[..., 0])
    assert set(map(tuple, thin.P[1][thin.P_mask[1]].tolist())) == set(map(tuple, P[1, :90].tolist()))
    assert (thin.spacing < pair.spacing).all()
    assert thinned_pair(pair, None) is pair and thinned_pair(pair, 300) is pair


def test_gradients_reach_the_kept_points_alone():
    P = bumpy(200, 3).requires_grad_()
    Q = motion(3, 0.1).inverse()(P.detach())
    layer = BBRLayer(Stage(SoftBBS(smoothing=0.2), Adam(5), points=50))
    (gradient,) = torch.autograd.grad(layer(P, Q).target_from_source.matrix.square().sum(), P)
    moved = gradient.abs().amax(1) > 1e-9 * gradient.abs().max()
    assert 20 < moved.sum() <= 200  # the centre hangs on all points
    assert torch.isfinite(gradient).all()


def test_a_large_pair_goes_through_all_stages_and_a_small_one_leaves_the_last_out():
    stages = [Stage(BuddyFilter(), GaussNewton(4), points=100), Stage(BuddyFilter(), GaussNewton(2), above=150)]
    layer, truth = BBRLayer(*stages, backward=Detached()), motion(3, 0.05, 0.01)
    for count, iterations in ((140, 4), (400, 6)):
        P = bumpy(count, 3)
        result = layer(P, truth.inverse()(P))
        assert result.iterations.item() == iterations
        assert angular_error(result.target_from_source.rotation, truth.rotation) < 0.02


@pytest.mark.parametrize("layer", [BBRLayer(backward=Detached()), BBRLayer.fast(Detached())], ids=["default", "fast"])
def test_f_begins_as_the_papers_on_at_most_1000_points_and_goes_on_with_a_reach(layer):
    stages = [stage for stage in layer.sequence if stage.dimension == 3]
    truth, P = motion(3, 0.05, 0.01), bumpy(1010, 3)
    for count in (1000, 1010):
        result = layer(P[:count], truth.inverse()(P[:count]))
        assert result.iterations.item() == sum(stage.inner.steps for stage in stages if stage.above < count)
        assert all(stage.upto in (None, FINE_POINTS) for stage in stages)
        assert angular_error(result.target_from_source.rotation, truth.rotation) < 1e-3
    assert (stages[1].points, stages[1].above, stages[1].loss.reach) == (1000, 0, math.inf)
    assert all(stage.loss.reach == REACH for stage in stages[2:])
    assert {stage.above for stage in stages[2:-2]} <= {0, 1000, FINE_POINTS} and stages[-1].points is None
    assert [stage.loss.alike for stage in stages[2:]] == [stage.upto is not None for stage in stages[2:]]
    assert (stages[-2].loss.alike, stages[-2].above, stages[-1].above) == (True, 0, FINE_POINTS)


@pytest.mark.parametrize("layer", [BBRLayer(backward=Detached()), BBRLayer.fast(Detached())], ids=["default", "fast"])
def test_in_the_plane_few_points_show_the_way_and_all_decide(layer, monkeypatch):
    seen = []
    forward = Stage.forward

    def spy(stage, pair, *rest, **named):
        seen.append((stage.dimension, type(stage.inner), thinned_pair(pair, stage.points).P.shape[1]))
        return forward(stage, pair, *rest, **named)

    monkeypatch.setattr(Stage, "forward", spy)
    truth, P = motion(2, 0.3, 0.05), bumpy(500, 2)
    result = layer(P, truth.inverse()(P))
    assert angular_error(result.target_from_source.rotation, truth.rotation) < 1e-6
    assert {dimension for dimension, _, _ in seen} == {2}
    assert all(points <= 64 for _, _, points in seen[:-1]) and seen[-1] == (2, GaussNewton, 500)


def test_a_stage_is_left_out_for_clouds_of_another_dimension():
    layer = BBRLayer(Stage(BuddyFilter(), Adam(3), dimension=2), Stage(BuddyFilter(), Adam(5), dimension=3))
    for d, steps in ((2, 3), (3, 5)):
        assert layer(bumpy(50, d), bumpy(50, d)).iterations.item() == steps


def test_settings_of_a_stage_that_cannot_work_are_refused(as_a_user):
    with pytest.raises(ValueError, match="points is many; a stage needs"):
        Stage(BuddyFilter(), points="many")
    with pytest.raises(ValueError, match="above is -1; it must be a whole number of points"):
        Stage(BuddyFilter(), above=-1)
    with pytest.raises(ValueError, match=r"inner is 'gn'; it must be Adam\(...\) or GaussNewton"):
        BBRLayer("F", inner="gn")
    with pytest.raises(ValueError, match=r"temperature is Unrounded\(\), and SoftBBS.* divides by it"):
        Stage(SoftBBS(), temperature=Unrounded())
    with pytest.raises(ValueError, match=r"no loss 'fast'; .* or BBRLayer.fast\(\)"):
        BBRLayer("fast")
    with pytest.raises(ValueError, match="points is 3; a stage needs at least 4"):
        Stage(BuddyFilter(), points=3)
    with pytest.raises(ValueError, match="the first stage has above=10"):
        BBRLayer(Stage(BuddyFilter(), above=10))
    with pytest.raises(ValueError, match="the first stage has above=10"):
        BBRLayer(Stage(BuddyFilter(), dimension=2), Stage(BuddyFilter(), above=10, dimension=3))
    with pytest.raises(ValueError, match="dimension is 4; a stage is for clouds in 2 or 3 dimensions"):
        Stage(BuddyFilter(), dimension=4)
    with pytest.raises(ValueError, match="no stage of the layer is for 2D clouds of up to 9 points"):
        BBRLayer(Stage(BuddyFilter(), dimension=3))(torch.rand(9, 2), torch.rand(9, 2))


def test_nearly_all_points_are_thinned_to_nearly_as_many_as_asked(rng):
    assert len(evenly_thinned(rng.random((3000, 3)), 2850)) > 0.7 * 2850  # without the least growth: 1
    grid = np.stack(np.meshgrid(*[np.arange(11.0)] * 3), -1).reshape(-1, 3)
    assert len(evenly_thinned(grid, 1264)) > 0.7 * 1264  # without the way back between two guesses: 0.58


def test_a_point_far_off_leaves_a_grid_with_more_cells_than_numbers(rng):
    points = rng.random((3000, 3))
    points[0] = 1e9
    assert 500 < len(evenly_thinned(points, 1000)) <= 1000
