"""The layer under torch.func, torch.compile and autocast: the same answers and gradients as without."""

import pytest
import torch
from problems import noisy_pair
from torch.func import grad, hessian, jacrev, vmap

from bbr_layer import Adam, Annealed, BBRLayer, RigidMotion


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
