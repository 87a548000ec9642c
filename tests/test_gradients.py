"""gradcheck of the whole layer: every loss, every input it has, 2D and 3D, with masks and in every mode."""

import pytest
import torch
from differences import gradcheck
from problems import motion, noisy_pair
from torch import nn

from bbr_layer import (
    Adam,
    Annealed,
    Autograd,
    BBRLayer,
    Detached,
    GaussNewton,
    Learned,
    RigidMotion,
    SoftBBS,
    SoftBD,
    SoftBDNormals,
    Stage,
    Truncated,
)
from bbr_layer.named_stages import named_stage

NAMES = ["softBBS", "softBD", "N", "F"]
STEPS = 4
# Hot enough that seven noisy points have soft buddies at all, so that no gradient is trivially 0.
HOT = (1.0, 0.5)


def _layer(name, steps=STEPS, **inner):
    inner = {"rate": 0.05, **inner}
    return BBRLayer(name, inner=Adam(steps, **inner), temperature=Annealed(*HOT))


def _outputs(result):
    return torch.cat((result.target_from_source.matrix.flatten(), result.loss.flatten()))


def _checked(function, *inputs):
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    value = function(*inputs)
    gradients = torch.autograd.grad(value.square().sum(), inputs)
    assert all(g.abs().max() > 1e-6 for g in gradients), "an input without influence proves nothing"
    return gradcheck(function, inputs, eps=1e-6, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_points(name, d):
    given = noisy_pair(d)
    normals = {k: given[k] for k in ("P_normals", "Q_normals")}
    start = motion(d, 0.1, 0.05)
    assert _checked(lambda P, Q: _outputs(_layer(name)(P, Q, start=start, **normals)), given["P"], given["Q"])


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", ["N", "F"])
def test_normals(name, d):
    given = noisy_pair(d)
    P, Q = given["P"], given["Q"]
    assert _checked(
        lambda a, b: _outputs(_layer(name)(P, Q, P_normals=a, Q_normals=b)),
        given["P_normals"],
        given["Q_normals"],
    )


@pytest.mark.parametrize("name", ["N", "F"])
def test_estimated_normals(name):
    given = noisy_pair(3, n=9)
    assert _checked(lambda P, Q: _outputs(_layer(name, steps=3)(P, Q)), given["P"], given["Q"])


@pytest.mark.parametrize("name", NAMES)
def test_weights(name):
    given = noisy_pair(3)
    fixed = {k: given[k] for k in ("P", "Q", "P_normals", "Q_normals")}
    assert _checked(
        lambda u, v: _outputs(_layer(name)(**fixed, P_weights=u, Q_weights=v)),
        given["P_weights"],
        given["Q_weights"],
    )


@pytest.mark.parametrize("loss", [SoftBBS(match="both"), SoftBD(match="both"), SoftBD(match="features")])
def test_features(loss):
    given = noisy_pair(3)
    layer = BBRLayer(Stage(loss, Adam(STEPS, 0.05), Annealed(*HOT)))
    assert _checked(
        lambda u, v: _outputs(layer(given["P"], given["Q"], P_features=u, Q_features=v)),
        given["P_features"],
        given["Q_features"],
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_start(name, d):
    given = noisy_pair(d)
    fixed = {k: given[k] for k in ("P", "Q", "P_normals", "Q_normals")}
    begun = motion(d, 0.1, 0.05)

    def registered(rotvec, translation):
        return _outputs(_layer(name)(**fixed, start=RigidMotion.from_rotvec(rotvec, translation)))

    assert _checked(registered, begun.rotvec, begun.translation)


@pytest.mark.parametrize("name", NAMES)
def test_temperature_and_learning_rates(name):
    given = noisy_pair(3)
    fixed = {k: given[k] for k in ("P", "Q", "P_normals", "Q_normals")}

    def registered(hot, cold, rate, translation_rate):
        inner = Adam(STEPS, rate, translation_rate=translation_rate)
        return _outputs(BBRLayer(name, inner=inner, temperature=Annealed(hot, cold))(**fixed))

    assert _checked(registered, *(torch.tensor(x, dtype=torch.float64) for x in (*HOT, 0.05, 0.04)))


@pytest.mark.parametrize("loss", [SoftBBS(), SoftBD(), SoftBDNormals()])
def test_learned_temperature_and_its_rate(loss):
    given = noisy_pair(3)
    fixed = {k: given[k] for k in ("P", "Q", "P_normals", "Q_normals")}

    def registered(start, rate):
        stage = Stage(loss, Adam(STEPS, 0.05, temperature_rate=rate), Learned(start))
        result = BBRLayer(stage)(**fixed)
        return torch.cat((_outputs(result), result.temperature.flatten()))

    assert _checked(registered, *(torch.tensor(x, dtype=torch.float64) for x in (0.8, 0.03)))


@pytest.mark.parametrize("name", NAMES)
def test_masked_points_have_exactly_no_gradient(name):
    given = noisy_pair(3)
    normals = {k: given[k] for k in ("P_normals", "Q_normals")}
    P_mask, Q_mask = torch.arange(7)[None] < 6, torch.arange(9)[None] < 7

    def registered(P, Q):
        return _outputs(_layer(name)(P, Q, **normals, P_mask=P_mask, Q_mask=Q_mask))

    P, Q = given["P"].requires_grad_(), given["Q"].requires_grad_()
    gradients = torch.autograd.grad(registered(P, Q).square().sum(), (P, Q))
    assert torch.equal(gradients[0][~P_mask], torch.zeros(1, 3, dtype=torch.float64))
    assert torch.equal(gradients[1][~Q_mask], torch.zeros(2, 3, dtype=torch.float64))
    assert gradients[0][P_mask].abs().max() > 1e-6
    assert gradcheck(registered, (P, Q), eps=1e-6, atol=2e-5, rtol=1e-4)


def test_papers_parametrisation():
    given = noisy_pair(3)
    layer = BBRLayer.paper("softBD")
    layer.stages[0].inner.steps, layer.stages[0].temperature.start = 3, 0.5
    assert _checked(lambda P, Q: _outputs(layer(P, Q)), given["P"], given["Q"])


def test_both_default_stages_hand_the_gradient_on():
    given = noisy_pair(3, n=9)
    layer = BBRLayer(*(_short(name) for name in ("softBBS", "F")))
    assert _checked(lambda P, Q: _outputs(layer(P, Q)), given["P"], given["Q"])


def _short(name):
    return named_stage(name, Adam(3, 0.05), Annealed(*HOT))


def test_truncated_is_the_unroll_of_the_last_steps():
    given = noisy_pair(3)
    gradients = {}
    for mode in (Autograd(), Truncated(STEPS), Truncated(1), Detached()):
        P = given["P"].clone().requires_grad_()
        layer = BBRLayer("softBD", inner=Adam(STEPS, 0.05), temperature=Annealed(*HOT), backward=mode)
        matrix = layer(P, given["Q"], start=motion(3, 0.1)).target_from_source.matrix
        tied = matrix.sum() + 0 * P.sum()
        gradients[mode] = torch.autograd.grad(tied, P)[0]
    torch.testing.assert_close(gradients[Truncated(STEPS)], gradients[Autograd()], rtol=1e-12, atol=1e-12)
    assert not torch.allclose(gradients[Truncated(1)], gradients[Autograd()])
    assert gradients[Detached()].abs().max() < gradients[Truncated(1)].abs().max()


def test_learned_settings_are_parameters_of_the_layer():
    rate = nn.Parameter(torch.tensor(0.05, dtype=torch.float64))
    layer = BBRLayer("softBD", inner=Adam(STEPS, rate), temperature=Annealed(*HOT))
    given = noisy_pair(3)
    layer(given["P"], given["Q"]).loss.sum().backward()
    assert [name for name, _ in layer.named_parameters()] == ["stages.0.inner.rate"]
    assert rate.grad is not None and rate.grad.abs() > 0


@pytest.mark.parametrize("value", [-0.1, 0.0, float("nan")])
@pytest.mark.parametrize("temperature", [Annealed, Learned])
def test_a_temperature_that_training_took_below_0_is_named(temperature, value):
    layer = BBRLayer("softBD", inner=Adam(2), temperature=temperature(nn.Parameter(torch.tensor(0.5))))
    given = noisy_pair(3)
    layer(given["P"], given["Q"])
    with torch.no_grad():
        layer.stages[0].temperature.start.fill_(value)
    with pytest.raises(ValueError, match="^start is Parameter.*; a temperature must be positive: try 1.0"):
        layer(given["P"], given["Q"])


def test_a_rate_that_training_took_below_0_is_named():
    rate = nn.Parameter(torch.tensor(0.05))
    layer, given = BBRLayer("softBD", inner=Adam(2, rate)), noisy_pair(3)
    with torch.no_grad():
        rate.fill_(-0.1)
    with pytest.raises(ValueError, match="^rate is -0.1.*; a learning rate must be positive: try 0.1"):
        layer(given["P"], given["Q"])


def test_a_setting_changed_to_nonsense_is_named():
    layer, given = BBRLayer("F", inner=GaussNewton(2)), noisy_pair(3)
    layer.stages[0].inner.steps = 0
    with pytest.raises(ValueError, match="^steps is 0; the inner registration needs a whole number"):
        layer(given["P"], given["Q"])
