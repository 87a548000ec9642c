"""How gradients reach the inputs: every mode against the plain unroll, and the guards of those that assume."""

import pytest
import torch
from differences import gradgradcheck
from problems import motion, noisy_pair

from bbr_layer import (
    Adam,
    Annealed,
    Autograd,
    BBRLayer,
    Detached,
    Implicit,
    Learned,
    Replay,
    RigidMotion,
    SoftBBS,
    SoftBD,
    Stage,
    Truncated,
    register,
)

HOT = (1.0, 0.5)
STEPS = 6
INPUTS = ["P", "Q", "P_normals", "Q_normals", "P_weights", "Q_weights"]


def _gradients(layer, given, chosen, start=None):
    """Gradients of a number that depends on every differentiable output."""
    leaves = {name: given[name].clone().requires_grad_() for name in chosen}
    fields = {k: v for k, v in given.items() if "features" not in k} | leaves
    result = layer(**fields, start=start)
    weights = torch.linspace(0.5, 1.5, result.target_from_source.matrix.numel(), dtype=torch.float64)
    value = (result.target_from_source.matrix.flatten() * weights).sum() + result.loss.sum() + result.temperature.sum()
    return torch.autograd.grad(value, list(leaves.values()), allow_unused=True)


def _agree(found, wanted, tolerance=1e-10):
    assert any(w is not None and w.norm() > 0 for w in wanted), "nothing to compare: every gradient is 0"
    for f, w in zip(found, wanted, strict=True):
        w = torch.zeros_like(f) if w is None else w
        assert (f - w).norm() <= tolerance * w.norm().clamp(min=1e-30), (f - w).norm() / w.norm()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", ["softBBS", "softBD", "N", "F"])
def test_replay_is_the_plain_unroll(name, d, masked):
    given = noisy_pair(d, batch=2)
    if masked:
        given["P_mask"], given["Q_mask"] = torch.rand(2, 7) > 0.2, torch.rand(2, 9) > 0.2
    chosen = INPUTS if name in ("N", "F") else [x for x in INPUTS if "normals" not in x]
    begun = motion(d, 0.1, 0.05)
    modes = [
        BBRLayer(name, inner=Adam(STEPS, 0.05), temperature=Annealed(*HOT), backward=mode)
        for mode in (Replay(), Autograd())
    ]
    _agree(*(_gradients(layer, given, chosen, begun) for layer in modes))


@pytest.mark.parametrize("loss", [SoftBBS(match="both"), SoftBD(match="both"), SoftBD(match="features")])
def test_replay_through_features(loss):
    given = noisy_pair(3)
    gradients = []
    for mode in (Replay(), Autograd()):
        P, Q = (given[f"{side}_features"].clone().requires_grad_() for side in "PQ")
        layer = BBRLayer(Stage(loss, Adam(STEPS, 0.05), Annealed(*HOT)), backward=mode)
        matrix = layer(given["P"], given["Q"], P_features=P, Q_features=Q).target_from_source.matrix
        gradients.append(torch.autograd.grad(matrix.square().sum(), (P, Q)))
    _agree(*gradients)


@pytest.mark.parametrize("name", ["softBD", "N", "F"])
def test_replay_through_start_rates_and_temperature(name):
    given = noisy_pair(3)
    fixed = {k: given[k] for k in ("P", "Q", "P_normals", "Q_normals")}
    begun = motion(3, 0.1, 0.05)
    gradients = []
    for mode in (Replay(), Autograd()):
        numbers = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (*HOT, 0.05, 0.04)]
        rotvec, shift = (x.clone().requires_grad_() for x in (begun.rotvec, begun.translation))
        inner = Adam(STEPS, numbers[2], translation_rate=numbers[3])
        layer = BBRLayer(name, inner=inner, temperature=Annealed(*numbers[:2]), backward=mode)
        result = layer(**fixed, start=RigidMotion.from_rotvec(rotvec, shift))
        value = result.target_from_source.matrix.square().sum() + result.loss
        gradients.append(torch.autograd.grad(value, (*numbers, rotvec, shift)))
    _agree(*gradients)


def test_replay_with_a_learned_temperature_and_the_papers_parametrisation():
    given = noisy_pair(3)
    gradients = []
    for mode in (Replay(), Autograd()):
        layer = BBRLayer.paper("softBD", mode)
        layer.stages[0].inner.steps, layer.stages[0].temperature = STEPS, Learned(0.5)
        gradients.append(_gradients(layer, given, ["P", "Q"]))
    _agree(*gradients)


@pytest.mark.parametrize("steps", [1, 3, STEPS])
def test_replay_of_the_last_steps_is_truncated(steps):
    given = noisy_pair(3)
    wanted, found = (
        _gradients(BBRLayer("softBD", inner=Adam(STEPS, 0.05), backward=mode), given, ["P", "Q"])
        for mode in (Truncated(steps), Replay(steps))
    )
    _agree(found, wanted, 0.0)


def _converging(mode, steps):
    # The temperature is a number of the user's: it does not depend on the weights.
    return BBRLayer("softBD", inner=Adam(steps, 0.05), temperature=Annealed(1.0, 1.0), backward=mode)


def test_implicit_is_replay_where_it_has_converged():
    given = noisy_pair(3, n=30, m=30)
    wanted, found = (
        _gradients(_converging(mode, 900), given, ["P_weights", "Q_weights"])
        for mode in (Replay(), Implicit(on_unconverged="raise"))
    )
    _agree(found, wanted, 1e-6)


def test_implicit_speaks_where_it_has_not_converged():
    given = noisy_pair(3, n=30, m=30)
    with pytest.warns(UserWarning, match="have not converged; give the layer more steps, or use Replay"):
        _gradients(_converging(Implicit(on_unconverged="warn"), 5), given, ["P"])
    with pytest.raises(RuntimeError, match="not to be trusted"):
        _gradients(_converging(Implicit(on_unconverged="raise"), 5), given, ["P"])
    found, wanted = (_gradients(_converging(mode, 5), given, ["P"]) for mode in (Implicit(), Replay()))
    _agree(found, wanted, 0.0)


def test_settings_of_modes_are_refused_where_they_are_given():
    with pytest.raises(ValueError, match="last_steps is 0; keep at least 1"):
        Replay(0)
    with pytest.raises(ValueError, match="damping is -1"):
        Implicit(-1.0)
    with pytest.raises(ValueError, match="on_unconverged is 'ask'"):
        Implicit(on_unconverged="ask")


@pytest.mark.parametrize("name", ["softBD", "F"])
@pytest.mark.parametrize("layer_mode", [Replay(), Truncated(2)])
def test_a_second_derivative_is_refused_in_words(name, layer_mode):
    given = noisy_pair(3)
    P = given["P"].requires_grad_()
    matrix = BBRLayer(name, inner=Adam(4, 0.05), backward=layer_mode)(P, given["Q"]).target_from_source.matrix
    (first,) = torch.autograd.grad(matrix.square().sum(), P, create_graph=True)
    with pytest.raises(RuntimeError, match=r"first derivatives only.*backward=Autograd\(\)"):
        first.sum().backward()


def test_autograd_has_second_derivatives():
    given = noisy_pair(2)
    layer = BBRLayer("softBD", inner=Adam(3, 0.05), temperature=Annealed(*HOT), backward=Autograd())
    P = given["P"].requires_grad_()
    assert gradgradcheck(
        lambda P: layer(P, given["Q"], start=motion(2, 0.1)).target_from_source.translation, (P,), atol=1e-3, rtol=1e-3
    )


@pytest.mark.parametrize("mode", [Replay(), Implicit(), Autograd(), Detached()])
def test_nothing_is_stored_where_nothing_needs_a_gradient(mode):
    given = noisy_pair(3)
    layer = BBRLayer("softBD", inner=Adam(4), backward=mode)
    result = layer(given["P"], given["Q"])
    assert not any(x.requires_grad for x in (*result.target_from_source, *result[1:]))
    with torch.no_grad():
        result = layer(given["P"].requires_grad_(), given["Q"])
    assert not any(x.requires_grad for x in (*result.target_from_source, *result[1:]))
    assert register(given["P"].detach(), given["Q"], layer=layer).loss.grad_fn is None
