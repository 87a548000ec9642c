"""The layer under torch.func, torch.compile and autocast: the same answers and gradients as without."""

import pytest
import torch
from problems import noisy_pair
from torch import nn
from torch.func import functional_call, grad, hessian, jacrev, vmap
from torch.utils.checkpoint import checkpoint

from bbr_layer import Adam, Annealed, BBRLayer, Learned, RigidMotion


@pytest.fixture(params=["softBD", "F"])
def layer(request):
    return BBRLayer(request.param, inner=Adam(5, 0.05), temperature=Annealed(1.0, 0.5))


def _number(layer, P, Q, **given):
    result = layer(P, Q, **given)
    return result.target_from_source.matrix.square().sum() + result.loss.sum()


def _plain_gradient(layer, P, Q):
    P, Q = P.clone().requires_grad_(), Q.clone().requires_grad_()
    return torch.autograd.grad(_number(layer, P, Q), (P, Q))


def _close(found, wanted):
    assert all(w.norm() > 0 for w in wanted), "nothing to compare: all is 0"
    for f, w in zip(found, wanted, strict=True):
        torch.testing.assert_close(f, w, rtol=1e-10, atol=1e-12)


def test_grad(layer):
    given = noisy_pair(3)
    found = grad(lambda P, Q: _number(layer, P, Q), argnums=(0, 1))(given["P"], given["Q"])
    _close(found, _plain_gradient(layer, given["P"], given["Q"]))


def test_vmap_is_a_batch(layer):
    given = noisy_pair(3, batch=3)
    found = vmap(lambda P, Q: layer(P, Q).target_from_source.matrix)(given["P"], given["Q"])
    _close([found], [layer(given["P"], given["Q"]).target_from_source.matrix])


def test_vmap_over_a_dimension_in_the_middle(layer):
    given = noisy_pair(3, batch=3)
    P, Q = given["P"].movedim(0, 1), given["Q"].movedim(0, 2)
    found = vmap(lambda P, Q: layer(P, Q).target_from_source.matrix, in_dims=(1, 2))(P, Q)
    _close([found], [layer(given["P"], given["Q"]).target_from_source.matrix])


def test_vmap_shares_what_is_not_mapped(layer):
    given = noisy_pair(3, batch=3)
    Q = given["Q"][0]
    start = RigidMotion.identity(3)
    found = vmap(lambda P: layer(P, Q, start=start).loss)(given["P"])
    _close([found], [layer(given["P"], Q.expand(3, -1, -1), start=start).loss])


def test_gradients_per_sample(layer):
    given = noisy_pair(3, batch=3)
    P, Q = given["P"], given["Q"]
    found = vmap(grad(lambda P, Q: _number(layer, P, Q), argnums=(0, 1)))(P, Q)
    by_item = [_plain_gradient(layer, p, q) for p, q in zip(P, Q, strict=True)]
    wanted = [torch.stack(x) for x in zip(*by_item, strict=True)]
    _close(found, wanted)
    _close(grad(lambda P, Q: vmap(lambda p, q: _number(layer, p, q))(P, Q).sum(), argnums=(0, 1))(P, Q), wanted)


def test_jacobian_by_rows(layer):
    given = noisy_pair(2)
    P, Q = given["P"][0], given["Q"][0]
    found = jacrev(lambda P: layer(P, Q).target_from_source.translation)(P)
    leaf = P.clone().requires_grad_()
    shift = layer(leaf, Q).target_from_source.translation
    _close(found, [torch.autograd.grad(x, leaf, retain_graph=True)[0] for x in shift])


def test_second_derivatives_are_refused_in_words(layer):
    given = noisy_pair(2)
    with pytest.raises(RuntimeError, match=r"first derivatives only.*backward=Autograd\(\)"):
        hessian(lambda P: _number(layer, P, given["Q"]))(given["P"])


# Dynamo looks at the .grad of what it hands over to the layer.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
def test_a_compiled_model_with_the_layer_in_it(layer):
    given = noisy_pair(3)

    def model(P, Q):
        return _number(layer, 2 * P, 2 * Q) * 3

    P = given["P"].requires_grad_()
    found = torch.autograd.grad(torch.compile(model, backend="aot_eager")(P, given["Q"]), P)
    _close(found, torch.autograd.grad(model(P, given["Q"]), P))


def test_autocast_changes_nothing(layer):
    given = {k: v.float() for k, v in noisy_pair(3).items()}
    P = given["P"].requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = torch.autograd.grad(_number(layer, P, given["Q"]), P)
    assert torch.equal(found[0], torch.autograd.grad(_number(layer, P, given["Q"]), P)[0])


def test_what_networks_give_under_autocast_is_widened():
    given = {k: v.float() for k, v in noisy_pair(3).items()}
    P, Q, features = given["P"], given["Q"], [given[k].bfloat16() for k in ("P_features", "Q_features")]
    layer = BBRLayer("softBD", inner=Adam(3))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = layer(P, Q.bfloat16(), P_features=features[0], Q_features=features[1])
    plain = layer(P, Q.bfloat16().float(), P_features=features[0].float(), Q_features=features[1].float())
    assert torch.equal(found.target_from_source.matrix, plain.target_from_source.matrix)
    with pytest.raises(ValueError, match="Q has dtype torch.bfloat16"):
        layer(P, Q.bfloat16())


def _learning():
    rate = nn.Parameter(torch.tensor(0.05, dtype=torch.float64))
    layer = BBRLayer("softBD", inner=Adam(5, rate), temperature=Learned(1.0))
    return layer, dict(layer.named_parameters())


def _of_settings(layer):
    return lambda settings, P, Q: functional_call(layer, settings, (P, Q)).target_from_source.matrix.square().sum()


def test_settings_that_are_learned_are_differentiated_too():
    given, (layer, settings) = noisy_pair(3), _learning()
    P, Q, number = given["P"], given["Q"], _of_settings(layer)
    wanted = torch.autograd.grad(number(settings, P, Q), list(settings.values()))
    before = {name: x.clone() for name, x in settings.items()}
    _close(grad(number)(settings, P, Q).values(), wanted)
    assert all(torch.equal(settings[name], x) for name, x in before.items())
    assert all(isinstance(x, nn.Parameter) for x in layer.parameters())


def test_settings_per_sample_and_over_a_map():
    given, (layer, settings) = noisy_pair(3, batch=3), _learning()
    P, Q, number = given["P"], given["Q"], _of_settings(layer)
    by_item = [torch.autograd.grad(number(settings, p, q), list(settings.values())) for p, q in zip(P, Q, strict=True)]
    wanted = [torch.stack(x) for x in zip(*by_item, strict=True)]
    _close(vmap(grad(number), in_dims=(None, 0, 0))(settings, P, Q).values(), wanted)
    vmap(lambda p, q: number(settings, p, q))(P, Q).sum().backward()
    _close([x.grad for x in settings.values()], [x.sum(0) for x in wanted])


def test_a_layer_per_setting():
    given, (layer, settings) = noisy_pair(3), _learning()
    P, Q, number = given["P"][0], given["Q"][0], _of_settings(layer)
    several = {name: torch.stack((x, 0.9 * x)).detach() for name, x in settings.items()}
    found = vmap(number, in_dims=(0, None, None))(several, P, Q)
    _close(found, [number({name: x[k] for name, x in several.items()}, P, Q) for k in range(2)])


@pytest.mark.parametrize("name", [None, "fast", "softBD", "F"])
def test_within_a_checkpoint(name):
    given = {field: x for field, x in noisy_pair(3, n=40, m=40).items() if field in "PQ"}
    layer = BBRLayer.fast() if name == "fast" else BBRLayer(*[name] if name else [])
    gradients = []
    for call in (_number, lambda *given: checkpoint(_number, *given, use_reentrant=False)):
        P, Q = given["P"].clone().requires_grad_(), given["Q"].clone().requires_grad_()
        gradients.append(torch.autograd.grad(call(layer, P, Q), (P, Q)))
    _close(*gradients)
