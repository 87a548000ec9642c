"""Several starting rotations: where one start fails, and what the choice does not touch."""

import math

import pytest
import torch
from problems import bumpy, motion

from bbr_layer import (
    Annealed,
    BBRLayer,
    CloudPair,
    Detached,
    GaussNewton,
    RigidMotion,
    Stage,
    angular_error,
    hard_buddies,
)
from bbr_layer.fit_score import score
from bbr_layer.inner.adam import Adam
from bbr_layer.losses import BuddyFilter
from bbr_layer.named_stages import ALIKE_ITERATIONS, default_stages, named_stage
from bbr_layer.preparation import prepared
from bbr_layer.starts import AROUND_ITERATIONS, HOT, TURN, best_start, most_starts, turns
from benchmarks.paper_experiments import EXPERIMENTS
from benchmarks.reliability_trials import Trial, clouds


def _turned(d, degrees, seed):
    torch.manual_seed(seed)
    P = bumpy(150, d)
    axis = torch.randn(d * (d - 1) // 2, dtype=torch.float64)
    vector = axis / axis.norm() * math.radians(degrees)
    truth = RigidMotion.from_rotvec(vector, torch.zeros(d, dtype=torch.float64))
    return P, truth.inverse()(P) + 0.01 * torch.randn_like(P), truth


def _error(result, truth):
    return torch.rad2deg(angular_error(result.target_from_source.rotation, truth.rotation))


@pytest.mark.parametrize(("d", "degrees", "seed"), [(3, 90, 1), (3, 90, 8), (2, 100, 0)])
def test_several_starts_find_what_one_misses(d, degrees, seed):
    P, Q, truth = _turned(d, degrees, seed)
    assert _error(BBRLayer(backward=Detached(), starts=1)(P, Q), truth) > 20
    assert _error(BBRLayer.robust(Detached())(P, Q), truth) < 1


def test_an_easy_pair_is_registered_as_from_one_start():
    P, Q, _ = _turned(3, 20, 0)
    one, several = BBRLayer(backward=Detached())(P, Q), BBRLayer.robust(Detached())(P, Q)
    assert _error(several, one.target_from_source) < 0.01
    assert several.iterations == AROUND_ITERATIONS + ALIKE_ITERATIONS < one.iterations
    stages = named_stage("softBBS"), named_stage("F")
    plain = [BBRLayer(*stages, backward=Detached(), starts=starts) for starts in (1, 7)]
    assert torch.equal(*(layer(P, Q).target_from_source.matrix for layer in plain))


@pytest.mark.parametrize(("name", "cell", "seed"), [("fig4", 0, 1019), ("fig5", 1, 2002)])
def test_what_f_from_afar_pulls_past_is_found_from_about_the_answer(name, cell, seed, real_data, monkeypatch):
    experiment = next(experiment for experiment in EXPERIMENTS if experiment.name == name)
    trial = experiment.cells("disjoint")[cell].make(seed)
    layer = BBRLayer.robust(Detached())
    assert trial.errors(layer(trial.P, trial.Q).target_from_source)[0] < 2
    monkeypatch.setattr("bbr_layer.starts.AROUND", 0.0)
    assert trial.errors(layer(trial.P, trial.Q).target_from_source)[0] > 5


@pytest.mark.parametrize(("name", "cell", "seed", "degrees"), [("fig5", 2, 4, 1.0), ("lidar", 2, 6, 0.2)])
def test_of_more_points_than_are_tried_the_stages_that_see_more_go_on(name, cell, seed, degrees, real_data):
    experiment = next(experiment for experiment in EXPERIMENTS if experiment.name == name)
    trial = experiment.cells("disjoint")[cell].make(seed)
    result = BBRLayer.robust(Detached())(trial.P, trial.Q)
    assert len(trial.P) > 1000 and trial.errors(result.target_from_source)[0] < degrees


def test_the_last_stage_goes_on_where_none_sees_more_points_than_are_tried():
    P, Q, truth = _turned(3, 20, 0)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    last = Stage(BuddyFilter(reach=50.0), GaussNewton(2), Annealed(0.03, 0.03), points=100)
    stages = [named_stage("softBBS", points=100), last]
    found = best_start(3, stages, (pair, frame), RigidMotion.identity(3, (1,)))
    assert not found.whole and found.stages == [last]
    assert torch.rad2deg(angular_error(found.motion.rotation, truth.rotation)) < 3


def test_only_an_f_of_finite_reach_in_space_is_begun_again_about_its_answer():
    P, Q, _ = _turned(3, 20, 0)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    last = Stage(BuddyFilter(reach=50.0), GaussNewton(2), Annealed(0.03, 0.03))
    for stages, kinds in (([named_stage("F")], [Adam]), ([named_stage("F"), last], [GaussNewton, GaussNewton])):
        found = best_start(3, stages, (pair, frame), RigidMotion.identity(3, (1,)))
        assert [type(stage.inner) for stage in found.stages] == kinds
    P, Q, _ = _turned(2, 20, 0)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    found = best_start(3, [named_stage("F"), last], (pair, frame), RigidMotion.identity(2, (1,)))
    assert [type(stage.inner) for stage in found.stages] == [Adam, GaussNewton]


def test_only_other_starts_begin_hotter():
    P, Q, _ = _turned(3, 90, 1)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    begun = RigidMotion.identity(3, (1,))
    far = best_start(7, [named_stage("softBBS")], (pair, frame), begun)
    assert not torch.equal(far.motion.rotation, begun.rotation)
    assert far.stages[0].temperature.start == HOT
    assert best_start(7, [named_stage("F")], (pair, frame), begun).stages[0].temperature.start == 0.3
    easy = best_start(7, [named_stage("softBBS")], (pair, frame), BBRLayer.robust(Detached())(P[None], Q[None])[0])
    assert easy.stages[0].temperature.start == named_stage("softBBS").temperature.start


def test_the_chosen_stage_sees_as_few_points_as_it_was_to():
    P, Q, _ = _turned(3, 90, 1)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    stage = named_stage("softBBS", points=50)
    assert best_start(7, [stage], (pair, frame), RigidMotion.identity(3, (1,))).stages[0].points == 50


class _Seen(Stage):
    """F that notes how many points it saw, of how many pairs."""

    def forward(self, pair, *rest, **named):
        self.seen = tuple(pair.P.shape[:2])
        return super().forward(pair, *rest, **named)


def test_starts_are_compared_on_few_points_and_without_the_stages_for_many():
    P, Q, _ = _turned(3, 90, 1)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    fine, large = _Seen(BuddyFilter(), Adam(3, 0.005)), _Seen(BuddyFilter(), Adam(3, 0.005), above=100)
    best_start(7, [named_stage("softBBS", points=50), fine, large], (pair, frame), RigidMotion.identity(3, (1,)))
    assert 1 <= fine.seen[0] <= 7 and 40 <= fine.seen[1] <= 50
    assert not hasattr(large, "seen")


def test_starts_are_compared_on_the_points_that_the_second_stage_sees():
    P, Q, _ = _turned(3, 90, 1)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    soft, fine = named_stage("softBBS", points=50), _Seen(BuddyFilter(), Adam(3, 0.005), points=100)
    last = _Seen(BuddyFilter(), Adam(3, 0.005))
    best_start(7, [soft, fine, last], (pair, frame), RigidMotion.identity(3, (1,)))
    assert 80 <= fine.seen[1] <= 100 and last.seen[1] == fine.seen[1]


def test_the_score_counts_buddies_on_each_others_planes():
    P, Q, truth = _turned(3, 20, 3)
    _, pair = prepared(CloudPair(P[None], Q[None]), True, False)
    motion = RigidMotion(*(x[None] for x in truth))
    moved, normals = motion(pair.Q)[0], motion.rotate(pair.Q_normals)[0]
    spacing, wanted = pair.known_spacing().item(), 0.0
    for i, j in hard_buddies(torch.cdist(pair.P[0], moved)).nonzero():
        other = normals[j] * (1 if pair.P_normals[0, i] @ normals[j] >= 0 else -1)
        offset = moved[j] - pair.P[0, i]
        off_plane = offset @ (pair.P_normals[0, i] + other) / 2
        wanted += math.exp(-((off_plane / (0.3 * spacing)) ** 2)) if offset.norm() < 2 * spacing else 0.0
    assert score(pair, motion).item() == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("seed", [21, 36])
def test_scans_of_which_a_wrong_start_finds_nearly_as_many_buddies(seed, real_data):
    fig7 = next(experiment for experiment in EXPERIMENTS if experiment.name == "fig7")
    trial = fig7.cells("disjoint")[0].make(seed)
    result = BBRLayer.robust(Detached())(trial.P, trial.Q)
    assert trial.errors(result.target_from_source)[0] < 2


def test_features_keep_the_gradient_that_soft_buddies_give_them():
    P, Q, _ = _turned(3, 20, 0)
    features = P.clone().requires_grad_()
    with pytest.warns(UserWarning, match="features want a gradient"):
        result = BBRLayer.robust()(P, Q, P_features=features, Q_features=P)
    (gradient,) = torch.autograd.grad(result.target_from_source.translation.sum(), features)
    assert gradient.abs().max() > 0


def test_a_start_without_a_score_is_not_chosen(monkeypatch):
    P, Q, _ = _turned(3, 20, 0)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    scores = torch.tensor([torch.nan, 1.0, 2.0], dtype=torch.float64)
    monkeypatch.setattr("bbr_layer.starts.score", lambda *_: scores)
    found = best_start(3, [named_stage("F", Adam(2, 0.005))], (pair, frame), RigidMotion.identity(3, (1,)))
    torch.testing.assert_close(found.motion.rotation[0], turns(3, 3)[2])


@pytest.mark.parametrize(("other", "chosen"), [(1.04, 0), (1.06, 1)])
def test_the_first_start_stays_where_another_is_hardly_better(other, chosen, monkeypatch):
    P, Q, _ = _turned(3, 20, 0)
    frame, pair = prepared(CloudPair(P[None], Q[None]), True, True)
    scores = torch.tensor([1.0, other], dtype=torch.float64)
    monkeypatch.setattr("bbr_layer.starts.score", lambda *_: scores)
    found = best_start(2, [named_stage("F", Adam(2, 0.005))], (pair, frame), RigidMotion.identity(3, (1,)))
    torch.testing.assert_close(found.motion.rotation[0], turns(2, 3)[chosen])


def test_every_item_keeps_its_own_best():
    pairs = [_turned(3, 90, seed) for seed in (1, 2)]
    P, Q, truths = zip(*pairs, strict=True)
    together = BBRLayer.robust(Detached())(torch.stack(P), torch.stack(Q))
    for b in range(2):
        alone = BBRLayer.robust(Detached())(P[b], Q[b])
        torch.testing.assert_close(together.target_from_source.matrix[b], alone.target_from_source.matrix)
        assert _error(alone, truths[b]) < 2


def test_masked_points_and_weights_follow_their_item():
    P, Q, truth = _turned(3, 90, 1)
    mask = torch.arange(200) < 150
    padded = [torch.cat((x, torch.full((50, 3), 9.0, dtype=x.dtype))) for x in (P, Q)]
    result = BBRLayer.robust(Detached())(*padded, P_mask=mask, Q_mask=mask, Q_weights=torch.ones(200).double())
    plain = BBRLayer.robust(Detached())(P, Q)
    torch.testing.assert_close(result.target_from_source.matrix, plain.target_from_source.matrix, rtol=0, atol=1e-6)


def _two_stages(points):
    return BBRLayer(named_stage("softBBS", points=points), named_stage("F", Adam(20, 0.005)), starts=7)


@pytest.mark.parametrize("layer", [_two_stages(None), _two_stages(60), BBRLayer.robust()], ids=["all", "60", "robust"])
def test_the_answer_is_the_same_with_and_without_a_gradient(layer):
    P, Q, _ = _turned(3, 90, 1)
    with torch.no_grad():
        plain = layer(P, Q)
    kept = layer(P.clone().requires_grad_(), Q)
    assert kept.target_from_source.rotation.requires_grad
    for one, other in zip(plain, kept, strict=True):
        if isinstance(one, torch.Tensor):
            torch.testing.assert_close(one, other.detach(), rtol=0, atol=1e-9)
    torch.testing.assert_close(
        plain.target_from_source.matrix, kept.target_from_source.matrix.detach(), atol=1e-9, rtol=0
    )


def test_the_gradient_is_that_of_the_run_from_the_chosen_start():
    P, Q, _ = _turned(3, 40, 2)
    P.requires_grad_()
    layer = BBRLayer("softBBS", starts=7)
    found = torch.autograd.grad(layer(P, Q).target_from_source.translation.sum(), P)[0]
    direction, step = torch.randn_like(P), 1e-6
    with torch.no_grad():
        ahead, behind = (layer(P + s * direction, Q).target_from_source.translation.sum() for s in (step, -step))
    torch.testing.assert_close((found * direction).sum(), (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-6)


def test_on_more_points_than_are_tried_the_gradient_is_that_from_one_start():
    torch.manual_seed(1)
    P, Q = bumpy(1200, 3), bumpy(1200, 3)
    found = []
    for layer in (BBRLayer(), BBRLayer.robust()):
        source = Q.clone().requires_grad_()
        moved = layer(P, source).target_from_source(torch.eye(3, dtype=torch.float64))
        found.append(torch.autograd.grad(moved.sum(), source)[0].flatten())
    assert torch.nn.functional.cosine_similarity(*found, dim=0) > 0.99
    assert abs(found[1].norm() / found[0].norm() - 1) < 0.1


@pytest.mark.parametrize("d", [2, 3])
def test_turns_are_all_different_and_no_longer_than_half_a_turn(d):
    count = most_starts(d)
    rotations = turns(count, d)
    assert torch.equal(rotations[0], torch.eye(d, dtype=torch.float64))
    apart = angular_error(rotations[:, None], rotations[None, :]) + 9 * torch.eye(count)
    assert apart.min() > TURN / 2
    assert angular_error(rotations[0], rotations).max() < math.pi


@pytest.mark.parametrize("starts", [0, -1, 1.5, "many"])
def test_wrong_starts_are_refused(starts, as_a_user):
    with pytest.raises(ValueError, match=f"starts is {starts}; it must be a whole number of at least 1"):
        BBRLayer(starts=starts)


def test_more_starts_than_there_are_is_refused():
    P, Q, _ = _turned(2, 10, 0)
    with pytest.raises(ValueError, match="starts is 10; in 2D there are 9 of them at most"):
        BBRLayer(starts=10)(P, Q)


def test_repr_names_the_starts():
    assert repr(BBRLayer("F", inner=Adam(2), starts=3)).endswith("starts=3)")
    assert "starts" not in repr(BBRLayer())


def test_planar_scans_that_half_a_turn_fits_nearly_as_well(real_data):
    # Pairs past the overlap pulled the right start 0.4 degrees off, and half a turn counted more buddies on planes.
    trial = Trial("2D", "seq_deepmapping2d_v1_pose0 0 1", "shared", 256, 90.0, 1)
    given = clouds(trial)
    result = BBRLayer.robust(Detached())(given.P, given.Q, P_normals=given.P_normals, Q_normals=given.Q_normals)
    assert _error(result, given.truth) < 0.1


def test_the_default_tries_several_starts_in_the_plane_alone_and_only_where_none_is_given():
    P = bumpy(150, 2)
    Q = motion(2, math.radians(110)).inverse()(P) + 0.005 * torch.randn_like(P)
    wanted = motion(2, math.radians(110)).rotation
    for layer in (BBRLayer(), BBRLayer.fast(), BBRLayer(*default_stages())):
        assert angular_error(layer(P, Q).target_from_source.rotation, wanted) < 0.05
    away = RigidMotion.identity(2)
    for alone in (BBRLayer(starts=1)(P, Q), BBRLayer()(P, Q, start=away)):
        assert angular_error(alone.target_from_source.rotation, wanted) > 0.5
