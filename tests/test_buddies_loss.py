"""The loss between clouds as they lie: the paper's values, gradients, masks, singular clouds, what it leaves alone."""

import pytest
import reference
import torch
from differences import gradcheck
from problems import bumpy, noisy_pair

from bbr_layer import BestBuddiesLoss, BuddyFilter, CloudPair, SoftBBS, SoftBD, SoftBDNormals, point_spacing
from bbr_layer import buddies_loss as module

NAMES = ["softBBS", "softBD", "N", "F"]
PLAIN = {"softBBS": SoftBBS(), "softBD": SoftBD(), "N": SoftBDNormals(), "F": BuddyFilter()}


def _given(d, *companions, batch=2):
    given = noisy_pair(d, batch=batch)
    return {k: v for k, v in given.items() if k in ("P", "Q") or k.split("_")[1] in companions}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_the_value_is_the_papers(name, d):
    given = _given(d, "normals", "weights", batch=1)
    spacing = (point_spacing(given["P"]) + point_spacing(given["Q"])).item() / 2
    found = BestBuddiesLoss(PLAIN[name], temperature=1e-9 if name == "F" else 0.5)(**given)
    P, Q, P_normals, Q_normals, P_weights, Q_weights = (x[0] for x in given.values())
    D, weights = reference.distances(P, Q), (P_weights, Q_weights)
    planes = reference.point_to_plane_distances(P, Q, P_normals, Q_normals)
    expected = {
        "softBBS": lambda: reference.soft_bbs(D, 0.5 * spacing, 1e-10, weights),
        "softBD": lambda: reference.soft_bd(D, 0.5 * spacing, 1e-10, weights),
        "N": lambda: reference.soft_bd(planes, 0.5 * spacing, 1e-10, weights),
        "F": lambda: reference.buddy_filter(D, planes, weights),
    }[name]()
    torch.testing.assert_close(found[0], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("companions", [("normals",), ("normals", "weights"), ("normals", "features")])
@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_the_plain_loss(name, companions):
    given = {k: v.requires_grad_() for k, v in _given(3, *companions).items()}
    module = BestBuddiesLoss(name)
    found = torch.autograd.grad(module(**given).sum(), given.values(), allow_unused=True)
    pair = CloudPair(**given)
    pair = pair._replace(spacing=((point_spacing(pair.P) + point_spacing(pair.Q)) / 2).detach())
    loss = module.loss(pair, module.temperature * module.loss.temperature_unit(pair).detach())
    expected = torch.autograd.grad(loss.sum(), given.values(), allow_unused=True)
    assert float(found[0].abs().max()) > 1e-3
    for of, x, y in zip(given.values(), found, expected, strict=True):
        one, other = (torch.zeros_like(of) if gradient is None else gradient for gradient in (x, y))
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_differences(name, d, monkeypatch):
    given = {k: v.requires_grad_() for k, v in _given(d, "normals", "weights", batch=1).items()}
    whole = module.prepared

    def held(*of):
        frame, pair = whole(*of)
        return frame, pair._replace(spacing=torch.full((1,), 0.5, dtype=torch.float64))

    monkeypatch.setattr(module, "prepared", held)
    loss = BestBuddiesLoss(name)

    def called(*inputs):
        return loss(**dict(zip(given, inputs, strict=True)))

    assert gradcheck(called, tuple(given.values()), fast_mode=d == 3)


@pytest.mark.parametrize("name", NAMES)
def test_masked_points_are_not_there_and_batches_are_items(name):
    given = _given(3, "normals", batch=4)
    loss = BestBuddiesLoss(name)
    each = torch.stack([loss(**{k: v[item] for k, v in given.items()}) for item in range(4)])
    torch.testing.assert_close(loss(**{k: v.reshape(2, 2, *v.shape[1:]) for k, v in given.items()}), each.reshape(2, 2))
    padded = {k: torch.cat((v, torch.full_like(v[:, :3], torch.nan)), 1) for k, v in given.items()}
    masks = {f"{side}_mask": torch.arange(padded[side].shape[1]).expand(4, -1) < given[side].shape[1] for side in "PQ"}
    torch.testing.assert_close(loss(**padded, **masks), each)


@pytest.mark.parametrize("name", NAMES)
def test_no_pairs_by_pairs_are_kept_for_the_gradient(name):
    P, Q = bumpy(90, 3).requires_grad_(), bumpy(80, 3)
    normals = {
        f"{side}_normals": torch.nn.functional.normalize(bumpy(n, 3), dim=-1) for side, n in (("P", 90), ("Q", 80))
    }
    sizes = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: sizes.append(x.numel()) or x, lambda x: x):
        BestBuddiesLoss(name)(P, Q, **normals)
    assert sizes and max(sizes) < 90 * 80 / 4


@pytest.mark.filterwarnings("ignore:no soft buddies are within reach")
@pytest.mark.parametrize("name", NAMES)
def test_singular_clouds_have_finite_losses_and_gradients(name):
    P = bumpy(20, 3)
    far = torch.cat((P, P + 1e4))
    for Q in (P.clone(), P.repeat(2, 1), torch.ones(5, 3, dtype=torch.float64), P + 1e3, far):
        for one in (P.clone(), torch.zeros(4, 3, dtype=torch.float64)):
            one.requires_grad_()
            loss = BestBuddiesLoss(name)(one, Q)
            loss.backward()
            assert torch.isfinite(loss) and torch.isfinite(one.grad).all()


def test_what_the_other_cloud_does_not_have_is_left_alone_and_the_rest_comes_near():
    """A Chamfer distance pulls the points that have no counterpart too."""
    shape = bumpy(200, 3)
    lost = shape[shape[:, 0] > 0.4]
    Q = shape[shape[:, 0] <= 0.4]
    start = torch.cat((Q + 0.05, lost + torch.tensor([10.0, 0, 0], dtype=torch.float64)))
    P = start.clone().requires_grad_()
    optimizer, loss = torch.optim.Adam([P], 0.01), BestBuddiesLoss()
    for _ in range(20):
        optimizer.zero_grad()
        loss(P, Q).backward()
        optimizer.step()
    torch.testing.assert_close(P[len(Q) :], start[len(Q) :], rtol=0, atol=1e-9)
    before, after = ((x[: len(Q)] - Q).norm(dim=1).mean() for x in (start, P))
    assert after < 0.5 * before
    chamfer = torch.cdist(P, Q).amin(1).mean()
    assert torch.autograd.grad(chamfer, P)[0][len(Q) :].abs().amax(1).min() > 1e-4


def test_modes_of_torch_and_types(as_a_user):
    P, Q = bumpy(60, 3).float(), bumpy(50, 3).float()
    loss = BestBuddiesLoss("F")
    plain = loss(P, Q)
    assert plain.dtype == torch.float32 and loss(P.double(), Q.double()).dtype == torch.float64
    for off in (torch.no_grad, torch.inference_mode):
        with off():
            assert torch.equal(loss(P, Q), plain)
    assert torch.equal(torch.compile(lambda x: loss(x, Q), backend="eager")(P), plain)
    for transformed, points in ((torch.func.grad, P), (torch.func.vmap, P.expand(2, -1, -1))):
        with pytest.raises(RuntimeError, match="does not go through torch.func: use torch.autograd.grad"):
            transformed(lambda x: loss(x, Q))(points)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(loss(P, Q), plain)
    assert repr(loss) == "BestBuddiesLoss(\n  temperature=0.1\n  (loss): BuddyFilter()\n)"


def test_wrong_settings_and_calls_get_one_sentence(as_a_user):
    for make, words in (
        (lambda: BestBuddiesLoss("softbd"), "^there is no loss 'softbd'; choose one of softBBS"),
        (lambda: BestBuddiesLoss(3), "^loss is 3; it must be one of the four losses: try 'softBD'"),
        (lambda: BestBuddiesLoss("F", 0.0), "^temperature is 0.0; it must be positive, in point spacings: try 0.1"),
        (lambda: BestBuddiesLoss()(torch.rand(3, 8), torch.rand(8, 3)), "try P.mT"),
    ):
        with pytest.raises(ValueError, match=words):
            make()


@pytest.mark.parametrize("name", ["softBBS", "softBD"])
def test_clouds_out_of_reach_are_warned_of(name):
    P = noisy_pair(3)["P"]
    with pytest.warns(UserWarning, match="no soft buddies are within reach: the loss is 0 and has no gradient"):
        assert BestBuddiesLoss(name)(P, P + 1000) == 0


@pytest.mark.parametrize("name", ["softBBS", "softBD", "N", "F"])
def test_nothing_is_warned_of_where_no_gradient_is_right(name, recwarn):
    P = noisy_pair(3)["P"]
    BestBuddiesLoss(name, 0.01)(P, P)
    BestBuddiesLoss(name)(P, P + 1000, P_weights=torch.zeros(P.shape[:-1]).double())
    BestBuddiesLoss(name)(P, P + 1000, Q_mask=torch.zeros(P.shape[:-1], dtype=torch.bool))
    assert not recwarn.list


def test_what_a_network_gives_under_autocast_is_widened():
    P, Q = (x.float()[0] for x in (noisy_pair(3)["P"], noisy_pair(3)["Q"]))
    with torch.autocast("cpu", torch.bfloat16):
        found = BestBuddiesLoss("F")(P, Q.bfloat16())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, BestBuddiesLoss("F")(P, Q.bfloat16().float()))
