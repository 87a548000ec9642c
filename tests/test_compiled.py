"""The compiled sweeps against those in torch, and the optimiser in numpy against the one in torch."""

import importlib.util

import numpy as np
import pytest
import torch
from problems import noisy_pair

from bbr_layer import Adam, Annealed, BBRLayer, CloudPair, Replay, RigidMotion, backend
from bbr_layer.inner.adam import Moments, adam_direction
from bbr_layer.kernels.reference import soft_directional, soft_gradient
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms

pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.inner import adam_by_hand  # noqa: E402
from bbr_layer.kernels import cpu, cpu_batch  # noqa: E402

# Sums that are 0 but for their rounding.
ROUNDING = 1e-15
TERMS = {
    "softBBS": SoftTerms(False, outlier=1e-3),
    "softBD": SoftTerms(True, outlier=1e-10),
    "N": SoftTerms(True, True, outlier=1e-3),
    "N, signs as given": SoftTerms(True, True, False, outlier=1e-3),
}


def _scene(d, masked, dtype):
    given = {k: v.to(dtype) for k, v in noisy_pair(d, batch=2, n=70, m=90).items() if "features" not in k}
    if masked:
        given["P_mask"], given["Q_mask"] = torch.rand(2, 70) > 0.2, torch.rand(2, 90) > 0.2
    pair = CloudPair(**given)
    moving = [torch.randn_like(pair.Q) for _ in range(2)]
    if masked:
        moving = [torch.where(pair.Q_mask[..., None], x, 0.0) for x in moving]
    lengths = (torch.tensor(x, dtype=torch.float64) for x in ([0.2, 0.3], [0.1, 0.2]))
    return Scene(pair, *lengths), Direction(*moving, torch.randn(2, dtype=torch.float64))


def _same(found, wanted, tolerance):
    for name in CloudPair._fields:
        f, w = getattr(found.pair, name), getattr(wanted.pair, name)
        if w is not None:
            assert (f - w).abs().max() <= tolerance * w.abs().max() + ROUNDING, name
        else:
            assert f is None or not f.any()
    for f, w in zip(found[1:], wanted[1:], strict=True):
        assert (f - w).abs().max() <= tolerance * w.abs().max() + ROUNDING


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 1e-4)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", TERMS)
def test_compiled_sweeps_are_the_reference(name, d, masked, dtype, tolerance):
    scene, direction = _scene(d, masked, dtype)
    loss, gradient = cpu.gradient(TERMS[name], scene)
    wanted_loss, wanted = soft_gradient(TERMS[name], scene)
    torch.testing.assert_close(loss, wanted_loss, rtol=tolerance, atol=0)
    _same(gradient, wanted, tolerance)
    for f, w in zip(
        cpu.directional(TERMS[name], scene, direction),
        soft_directional(TERMS[name], scene, direction),
        strict=True,
    ):
        _same(f, w, tolerance)


def test_threads_and_parts_change_nothing(monkeypatch):
    monkeypatch.setattr(cpu_batch, "PAIRS_PER_PART", 1000)
    scene, direction = _scene(3, False, torch.float64)
    one = Scene(CloudPair(*(None if x is None else x[:1] for x in scene.pair)), *(x[:1] for x in scene[1:]))
    threads, answers = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        answers.append(cpu.directional(TERMS["softBD"], one, Direction(*(x[:1] for x in direction))))
    torch.set_num_threads(threads)
    for first, second in zip(*answers, strict=True):
        assert torch.equal(first.pair.P, second.pair.P) and torch.equal(first.temperature, second.temperature)


def test_coincident_points_have_finite_derivatives():
    scene, direction = _scene(3, False, torch.float64)
    pair = scene.pair._replace(Q=scene.pair.P[:, :1].expand(-1, 90, -1).contiguous())
    coincident = Scene(pair, scene.temperature, torch.zeros(2, dtype=torch.float64))
    for f, w in zip(
        cpu.directional(TERMS["softBD"], coincident, direction),
        soft_directional(TERMS["softBD"], coincident, direction),
        strict=True,
    ):
        assert f.pair.P.isfinite().all()
        _same(f, w, 1e-10)


@pytest.mark.parametrize("name", ["softBBS", "softBD", "N", "F"])
def test_without_numba_the_answer_is_the_same(name, monkeypatch):
    given = noisy_pair(3)
    answers = []
    for installed in (True, False):
        if not installed:
            monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
            monkeypatch.setattr("bbr_layer.margins.COMPILED", False)
        P = given["P"].clone().requires_grad_()
        layer = BBRLayer(name, inner=Adam(5, 0.05), temperature=Annealed(1.0, 0.5), backward=Replay())
        matrix = layer(P, given["Q"]).target_from_source.matrix
        answers.append((matrix.detach(), *torch.autograd.grad(matrix.square().sum(), P)))
    assert backend().name == "torch" and "numba is not installed" in backend().reason
    for compiled, plain in zip(*answers, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-10, atol=1e-12)


def test_the_backend_says_what_it_is_and_may_be_named(monkeypatch):
    assert backend() == ("numba", "the points are on cpu and numba is installed")
    monkeypatch.setenv("BBR_BACKEND", "torch")
    assert backend() == ("torch", "BBR_BACKEND says so")
    monkeypatch.setenv("BBR_BACKEND", "fortran")
    with pytest.raises(ValueError, match="BBR_BACKEND is 'fortran'; it must be one of numba, triton, torch"):
        backend()


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("d", [2, 3])
def test_adam_by_hand_is_adam(d, shared, rng):
    hand = adam_by_hand.HandAdam(Adam(shared=shared), d)
    k = len(hand.axes)
    at = adam_by_hand.Point(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros((2, k)), np.zeros((2, k)))
    moments, motion = Moments.zero(torch.zeros(2, k, dtype=torch.float64)), RigidMotion.identity(3, (2,))
    for number in range(1, 4):
        gradient, rate = rng.normal(size=(2, k)), rng.uniform(0.01, 0.1, size=k)
        gradient[1, 0] = 0.0  # a component that has never moved
        blocks = (k - d, d) if shared else None
        direction, moments = adam_direction(
            torch.from_numpy(gradient), moments, betas=(0.9, 0.999), eps=1e-8, blocks=blocks
        )
        at = hand.advance(at, gradient, rate, number)
        move = torch.zeros(2, 6, dtype=torch.float64)
        move[:, hand.axes] = -torch.from_numpy(rate) * direction
        step = RigidMotion.from_rotvec(move[:, :3], move[:, 3:])
        motion = RigidMotion(step.rotation @ motion.rotation, motion.translation + step.translation)
    for found, wanted in zip(at, (*motion, moments.first, moments.second), strict=True):
        np.testing.assert_allclose(found, wanted.numpy(), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, np.pi])
def test_left_jacobian_is_the_derivative_of_the_exponential(angle):
    vector = angle * np.array([[0.6, -0.8, 0.0]])
    for axis in np.eye(3):
        step = 1e-6 * axis[None]
        ahead, behind = (adam_by_hand.exponential(vector + s) for s in (step, -step))
        turned = (ahead - behind) / 2e-6 @ adam_by_hand.transposed(adam_by_hand.exponential(vector))
        wanted = adam_by_hand.hat(adam_by_hand.left_jacobian(vector) @ axis)
        np.testing.assert_allclose(turned, wanted, atol=1e-8)
