"""Gauss-Newton inside: its equations, its gradients in every mode, and what it does where nothing holds the pose."""

import pytest
import reference
import torch
from differences import gradcheck, gradgradcheck
from problems import as_pair, bumpy, motion, noisy_pair

from bbr_layer import (
    Annealed,
    Autograd,
    BBRLayer,
    BuddyFilter,
    Detached,
    EulerAngles,
    GaussNewton,
    Implicit,
    Learned,
    Replay,
    RigidMotion,
    SoftBBS,
    SoftBD,
    SoftBDNormals,
    Stage,
    Status,
    Truncated,
    angular_error,
    translation_error,
)
from bbr_layer.distances import point_to_point

NAMES = ["softBBS", "softBD", "N", "F"]
AS_GIVEN = "N, signs as given"
LOSSES = {
    "softBBS": SoftBBS(),
    "softBD": SoftBD(),
    "N": SoftBDNormals(),
    "F": BuddyFilter(),
    AS_GIVEN: SoftBDNormals(align_signs=False),
}
HOT = (1.0, 0.5)
NORMALS = ("P_normals", "Q_normals")


def _layer(name, steps=3, mode=None, **settings):
    inner = GaussNewton(steps, **settings)
    return BBRLayer(name, inner=inner, temperature=Annealed(*HOT), backward=mode)


class _Residuals:
    """Residual of pair (i, j) as a function of a further turn and shift: an offset, or Eq. 7, signed or as given."""

    def __init__(self, pair, at, name):
        self.pair, self.at, self.name = pair, at, name
        self.tangent = {2: 3, 3: 6}[pair.P.shape[-1]]

    def __call__(self, x, i, j):
        d = self.pair.P.shape[-1]
        turn = RigidMotion.from_rotvec(x[:-d], x[-d:])
        p, arm = self.pair.P[0, i], self.at.rotation[0] @ self.pair.Q[0, j]
        offset = turn.rotation @ arm + self.at.translation[0] + x[-d:] - p
        if self.name.startswith("soft"):
            return offset
        n_p, n_q = self.pair.P_normals[0, i], self.at.rotation[0] @ self.pair.Q_normals[0, j]
        sign = -1.0 if self.name != AS_GIVEN and torch.dot(n_p, n_q) < 0 else 1.0
        return torch.dot(offset, turn.rotation @ n_q + sign * n_p)


def _counts(name, pair, at, temperature):
    """How much every pair counts."""
    moved = pair.moved_by(at)
    D = point_to_point(moved)[0]
    weights = pair.P_weights[0][:, None] * pair.Q_weights[0]
    clouds = moved.P[0], moved.Q[0], moved.P_normals[0], moved.Q_normals[0]
    planes = reference.point_to_plane_distances(*clouds, align_signs=name != AS_GIVEN)
    if name == "F":
        B = reference.hard_buddies(D) * weights
        counts = B / B.sum() / (planes.square() + temperature**2).sqrt()
    elif name in ("N", AS_GIVEN):
        counts = reference.soft_buddies(planes, temperature, 1e-10) * weights / planes
    else:
        B = reference.soft_buddies(D, temperature, 1e-10) * weights
        counts = B / D if name == "softBD" else B
    return {(i, j): counts[i, j] for i in range(D.shape[0]) for j in range(D.shape[1]) if counts[i, j] > 0}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", LOSSES)
def test_the_normal_equations_are_the_written_ones(name, d):
    pair, temperature = as_pair(noisy_pair(d), "normals", "weights"), torch.tensor([0.3], dtype=torch.float64)
    at = RigidMotion(*(x[None] for x in motion(d, 0.1, 0.05)))
    wanted = reference.normal_equations(_Residuals(pair, at, name), _counts(name, pair, at, temperature[0]))
    squares = LOSSES[name].squares(pair)
    found = squares.equations(pair, at, temperature, squares.hold(at))
    torch.testing.assert_close(found.matrix[0], wanted[0], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(found.slope[0], wanted[1], rtol=1e-9, atol=1e-12)


def test_nothing_larger_than_all_pairs_is_kept_for_the_equations_of_n():
    pair, temperature = as_pair(noisy_pair(3, n=50, m=60), "normals"), torch.tensor([0.3], dtype=torch.float64)
    pair = pair._replace(Q=pair.Q.requires_grad_())
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x.numel()) or x, lambda x: x):
        SoftBDNormals().squares(pair).equations(pair, RigidMotion(*(x[None] for x in motion(3))), temperature, ())
    assert max(kept) == 50 * 60


@pytest.mark.parametrize("loss", [BuddyFilter(), BuddyFilter(reach=1.3)], ids=str)
def test_the_slope_of_f_is_the_gradient_of_its_loss(loss):
    pair, temperature = as_pair(noisy_pair(3), "normals", "weights"), torch.tensor([0.3], dtype=torch.float64)
    at = RigidMotion(*(x[None] for x in motion(3, 0.1, 0.05)))
    x = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    turn = RigidMotion.from_rotvec(x[:3], torch.zeros(3, dtype=torch.float64)).rotation
    moved = RigidMotion(turn @ at.rotation, at.translation + x[3:])
    (wanted,) = torch.autograd.grad(loss.objective(pair)(moved, temperature).sum(), x)
    squares = loss.squares(pair)
    found = squares.equations(pair, at, temperature, squares.hold(at)).slope[0]
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_gradcheck(name, d):
    given, begun = noisy_pair(d), motion(d, 0.1, 0.05)
    chosen = ["P", "Q", "P_weights", "Q_weights"] + (list(NORMALS) if name in ("N", "F") else [])

    def registered(*leaves):
        result = _layer(name)(**dict(zip(chosen, leaves, strict=True)), start=begun)
        return torch.cat((result.target_from_source.matrix.flatten(), result.loss.flatten()))

    leaves = tuple(given[x].requires_grad_() for x in chosen)
    assert all(g.abs().max() > 1e-6 for g in torch.autograd.grad(registered(*leaves).square().sum(), leaves))
    assert gradcheck(registered, leaves, eps=1e-6, atol=2e-5, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_replay_is_the_plain_unroll(name, masked):
    given = {k: v for k, v in noisy_pair(3, batch=2, n=20, m=24).items() if "features" not in k}
    if masked:
        given["P_mask"], given["Q_mask"] = torch.arange(20)[None] < torch.tensor([[19], [18]]), torch.rand(2, 24) > 0.2
    found = []
    for mode in (Replay(), Autograd(), Truncated(3)):
        leaves = {k: v.clone().requires_grad_() for k, v in given.items() if v.dtype == torch.float64}
        numbers = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in HOT]
        layer = BBRLayer(name, inner=GaussNewton(3), temperature=Annealed(*numbers), backward=mode)
        result = layer(**{**given, **leaves})
        assert result.buddies.min() > 6, "six unknowns: with fewer pairs only the damping keeps F's equations regular"
        total = result.target_from_source.matrix.square().sum()
        gradients = torch.autograd.grad(total, [*leaves.values(), *numbers], allow_unused=True)
        found.append(torch.cat([torch.zeros(1) if g is None else g.flatten() for g in gradients]))
    for other in found[1:]:
        assert (found[0] - other).norm() <= 1e-10 * other.norm()


def test_truncated_to_fewer_steps_is_another_gradient():
    given = noisy_pair(3)
    P = given["P"].requires_grad_()
    gradients = [
        torch.autograd.grad(_layer("F", mode=mode)(P, given["Q"]).target_from_source.matrix.square().sum(), P)[0]
        for mode in (Truncated(1), Replay())
    ]
    assert not torch.allclose(*gradients)


def test_a_second_derivative_is_refused_or_given():
    given = noisy_pair(2)
    P = given["P"].requires_grad_()
    matrix = _layer("F")(P, given["Q"]).target_from_source.matrix
    (first,) = torch.autograd.grad(matrix.square().sum(), P, create_graph=True)
    with pytest.raises(RuntimeError, match=r"first derivatives only.*backward=Autograd\(\)"):
        first.sum().backward()
    fixed = {k: given[k] for k in NORMALS}
    assert gradgradcheck(
        lambda P: _layer("F", mode=Autograd())(P, given["Q"], **fixed).target_from_source.translation,
        (P,),
        atol=1e-3,
        rtol=1e-3,
    )


@pytest.mark.parametrize("name", ["softBBS", "softBD", "F"])  # N ends in a small cycle
def test_implicit_is_replay_where_it_has_converged(name):
    P = bumpy(60, 3)
    Q = motion(3, 0.1, 0.02).inverse()(P + 0.01 * torch.randn_like(P))
    gradients = []
    for mode in (Replay(), Implicit(on_unconverged="raise")):
        # The temperature, which Implicit holds, does not depend on the weights.
        leaf = torch.ones(60, dtype=torch.float64, requires_grad=True)
        layer = BBRLayer(name, inner=GaussNewton(200), temperature=Annealed(1.0, 1.0), backward=mode)
        matrix = layer(P, Q, P_weights=leaf).target_from_source.matrix
        gradients.append(torch.autograd.grad(matrix.square().sum(), leaf)[0])
    assert (gradients[0] - gradients[1]).norm() <= 1e-6 * gradients[0].norm()


@pytest.mark.parametrize("name", NAMES)
def test_a_small_turn_is_found(name):
    P, truth = bumpy(150, 3), motion(3, 0.1, 0.02)
    found = BBRLayer(name, inner=GaussNewton(60), backward=Detached())(P, truth.inverse()(P)).target_from_source
    assert angular_error(found.rotation, truth.rotation) < 1e-3
    assert translation_error(found.translation, truth.translation) < 1e-3


def test_no_buddies_leave_the_start():
    nobody = torch.zeros(1, 20, dtype=torch.bool)
    P = bumpy(20, 3)[None].requires_grad_()
    result = _layer("F")(P, bumpy(20, 3)[None], Q_mask=nobody, start=RigidMotion(*(x[None] for x in motion(3))))
    assert result.status.item() == Status.NO_BUDDIES
    torch.testing.assert_close(result.target_from_source.matrix, motion(3).matrix[None])
    (gradient,) = torch.autograd.grad(
        result.target_from_source.matrix.sum(), P, allow_unused=True, materialize_grads=True
    )
    assert torch.isfinite(gradient).all()


def test_a_plane_does_not_slide_away():
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 12, dtype=torch.float64)] * 2)
    P = torch.cat((grid, 0.001 * torch.randn(len(grid), 1, dtype=torch.float64)), 1)
    Q = (P + torch.tensor([0.0, 0.0, 0.1])).requires_grad_()
    result = BBRLayer("F", inner=GaussNewton(20))(P, Q)
    assert result.status.item() == Status.DEGENERATE
    assert result.target_from_source.translation.norm() < 0.3
    assert torch.isfinite(torch.autograd.grad(result.target_from_source.translation.sum(), Q)[0]).all()


def test_two_coincident_clouds_stay_with_a_finite_gradient():
    P = bumpy(30, 3)
    Q = P.clone().requires_grad_()
    result = _layer("F")(P, Q)
    torch.testing.assert_close(result.target_from_source.matrix, torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0)
    assert torch.isfinite(torch.autograd.grad(result.target_from_source.translation.sum(), Q)[0]).all()


def test_wrong_settings_are_refused_where_they_are_given():
    with pytest.raises(ValueError, match="steps is 0; .* try 20"):
        GaussNewton(0)
    with pytest.raises(ValueError, match="damping is -1; it must not be negative"):
        GaussNewton(damping=-1)
    with pytest.raises(ValueError, match=r"Learned.* goes with Adam\(\) alone"):
        Stage(SoftBD(), GaussNewton(), Learned())
    with pytest.raises(ValueError, match=r"EulerAngles\(\) goes with Adam\(\) alone"):
        Stage(SoftBD(), GaussNewton(), chart=EulerAngles())
    with pytest.raises(ValueError, match="clip is 3.0; GaussNewton cannot clip"):
        BBRLayer(Stage(SoftBDNormals(clip=3.0), GaussNewton()))(bumpy(9, 3), bumpy(9, 3))


def test_it_is_shown_as_it_was_made():
    assert repr(GaussNewton(7, damping=0.1)) == "GaussNewton(steps=7, damping=0.1)"
    assert "GaussNewton(steps=8)" in repr(BBRLayer.fast())
