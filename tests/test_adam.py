"""The inner Adam against torch.optim.Adam driven by hand, and its derivative where the second moment is 0."""

import pytest
import torch
from problems import noisy_pair

from bbr_layer import (
    Adam,
    Autograd,
    BBRLayer,
    CloudPair,
    Constant,
    Cosine,
    EulerAngles,
    Learned,
    Replay,
    RigidMotion,
    SoftBBS,
    SoftBD,
    Stage,
    StepDown,
)
from bbr_layer.inner.adam import Moments, adam_direction, without_rounding
from bbr_layer.rotations import rotation_from_euler

STEPS = 100


def _by_hand(P, Q, loss, schedule, alpha):
    """The paper's loop with the optimiser every user knows."""
    angles, shift = (torch.zeros(1, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    heat = torch.tensor([alpha], dtype=torch.float64, requires_grad=True)
    groups = [
        {"params": [angles], "lr": 1e-2},
        {"params": [shift], "lr": 5e-3},
        {"params": [heat], "lr": 1e-3},
    ]
    optimizer = torch.optim.Adam(groups)
    fall = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda t: schedule.factor(t, STEPS))
    for _ in range(STEPS):
        optimizer.zero_grad()
        moved = Q @ rotation_from_euler(angles).mT + shift[:, None]
        loss(CloudPair(P, moved), heat).sum().backward()
        optimizer.step()
        fall.step()
    return rotation_from_euler(angles), shift, heat


@pytest.mark.parametrize("schedule", [Constant(), Cosine(), StepDown(50, 0.1)])
@pytest.mark.parametrize("loss", [SoftBBS(), SoftBD()])
def test_unroll_is_torch_adam(loss, schedule):
    given = noisy_pair(3, n=20, m=25)
    P, Q = given["P"], given["Q"]
    inner = Adam(STEPS, 1e-2, translation_rate=5e-3, temperature_rate=1e-3, schedule=schedule, shared=False)
    result = BBRLayer(Stage(loss, inner, Learned(0.3), EulerAngles()))(P, Q)
    rotation, shift, heat = _by_hand(P, Q, loss, schedule, 0.3)
    torch.testing.assert_close(result.target_from_source.rotation, rotation, rtol=0, atol=1e-12)
    torch.testing.assert_close(result.target_from_source.translation, shift, rtol=0, atol=1e-12)
    torch.testing.assert_close(result.temperature, heat, rtol=0, atol=1e-12)


def test_derivative_at_zero_second_moment_is_zero():
    gradient = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    direction, moments = adam_direction(gradient, Moments.zero(gradient), betas=(0.9, 0.999), eps=1e-8)
    slope = torch.autograd.grad(direction.sum(), gradient)[0]
    assert torch.equal(slope, torch.zeros_like(slope))
    assert torch.equal(direction, torch.zeros_like(direction))
    assert torch.equal(moments.second, torch.zeros_like(direction))


def test_shared_moments_have_no_special_axis():
    gradient = torch.tensor([[3.0, 4.0, 0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
    direction, _ = adam_direction(gradient, Moments.zero(gradient), betas=(0.9, 0.999), eps=0.0, blocks=(3, 3))
    expected = torch.cat((gradient[:, :3] / 5, gradient[:, 3:]), -1) * 3**0.5
    torch.testing.assert_close(direction, expected)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"steps": 1.5}, "steps is 1.5"),
        ({"rate": -0.1}, "rate is -0.1"),
        ({"keep": "first"}, "keep is 'first'"),
    ],
)
def test_wrong_settings_are_refused(settings, sentence, as_a_user):
    with pytest.raises(ValueError, match=sentence):
        Adam(**settings)


def test_a_gradient_that_is_rounding_is_none_with_its_derivative():
    gradient = torch.tensor([[3e-13, 4e-13, 7.0], [3e-12, 4e-12, 7.0]], requires_grad=True)
    kept = without_rounding(gradient, torch.full((len(gradient),), 1e-12), 2)
    torch.testing.assert_close(kept, torch.tensor([[0.0, 0.0, 7.0], [3e-12, 4e-12, 7.0]]), rtol=0, atol=0)
    (derivative,) = torch.autograd.grad(kept.sum(), gradient)
    assert derivative.tolist() == [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]


@pytest.mark.parametrize("backward", [Replay(), Autograd()], ids=["replay", "autograd"])
def test_a_pair_at_its_optimum_stays_there(backward):
    P = torch.randn(30, 3, dtype=torch.float64)
    Q = P.clone().requires_grad_()
    for name in ("softBBS", "F"):
        result = BBRLayer(name, inner=Adam(5), backward=backward)(P, Q)
        assert torch.equal(result.target_from_source.matrix, torch.eye(4, dtype=torch.float64))
        found = torch.autograd.grad(result.target_from_source.rotation.sum(), Q)[0]
        assert found.abs().max() < 1e-9, "Adam heard the rounding"


@pytest.mark.parametrize("backward", [Replay(), Autograd()], ids=["replay", "autograd"])
@pytest.mark.parametrize("weights", [{"P": 1e-3}, {"P": 1 / 40, "Q": 1 / 40}], ids=["one side", "shares of one"])
def test_small_weights_are_not_taken_for_rounding(weights, backward):
    P = torch.randn(40, 3) * torch.tensor([1.0, 0.7, 0.5])
    Q = P @ RigidMotion.from_rotvec(torch.tensor([0.3, 0.1, 0.0]), torch.zeros(3)).rotation.float()
    layer, answers = BBRLayer("softBBS", inner=Adam(20, 0.05), backward=backward), []
    for sizes in ({}, weights):
        given = {f"{side}_weights": torch.full((40,), size, requires_grad=True) for side, size in sizes.items()}
        source = Q.clone().requires_grad_()
        matrix = layer(P, source, **given).target_from_source.matrix
        answers.append((matrix.detach(), *torch.autograd.grad(matrix.square().sum(), source)))
    assert answers[0][1].abs().max() > 1e-3
    torch.testing.assert_close(answers[0], answers[1], rtol=1e-2, atol=1e-4)
