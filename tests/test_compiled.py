"""The compiled sweeps against those in torch, and the compiled optimiser against the one in torch."""

import importlib.util

import numpy as np
import pytest
import torch
from problems import noisy_pair
from scipy.spatial.transform import Rotation

from bbr_layer import (
    Adam,
    Annealed,
    BBRLayer,
    CloudPair,
    EulerAngles,
    Learned,
    Replay,
    RigidMotion,
    SoftBD,
    Stage,
    backend,
)
from bbr_layer.inner.adam import Moments, adam_direction, without_rounding
from bbr_layer.kernels.choice import sweeps_for, tell_slow
from bbr_layer.kernels.reference import soft_directional, soft_gradient
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms

pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.inner.walk import AXES  # noqa: E402
from bbr_layer.kernels import cpu, cpu_adam, cpu_batch, cpu_turns  # noqa: E402

# Sums that are 0 but for their rounding.
ROUNDING = 1e-15
TERMS = {
    "softBBS": SoftTerms(False, outlier=1e-3),
    "softBD": SoftTerms(True, outlier=1e-10),
    "N": SoftTerms(True, True, outlier=1e-3),
    "N, signs as given": SoftTerms(True, True, False, outlier=1e-3),
    "N, clipped": SoftTerms(True, True, False, outlier=1e-3, clip=1.0),
    "by features": SoftTerms(True, outlier=1e-3, match="features"),
    "softBD, by both": SoftTerms(True, outlier=1e-10, match="both", feature_weight=0.3),
    "softBBS, by both": SoftTerms(False, outlier=1e-3, match="both", feature_weight=0.3),
}


def _given(d, by_features, **sizes):
    return {k: v for k, v in noisy_pair(d, **sizes).items() if by_features or "features" not in k}


def _scene(name, d, masked, dtype):
    by_features = TERMS[name].match != "points"
    given = {k: v.to(dtype) for k, v in _given(d, by_features, batch=2, n=70, m=90).items()}
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
    scene, direction = _scene(name, d, masked, dtype)
    lacking = cpu.lacks(TERMS[name], scene)
    if lacking:
        assert (masked, name, lacking) == (True, "N, clipped", "clipped distances with padded points")
        return
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


@pytest.mark.parametrize("name", ["softBD", "N, clipped", "softBD, by both"])
def test_threads_and_parts_change_nothing(name, monkeypatch):
    monkeypatch.setattr(cpu_batch, "PAIRS_PER_PART", 1000)
    scene, direction = _scene(name, 3, False, torch.float64)
    one = Scene(CloudPair(*(None if x is None else x[:1] for x in scene.pair)), *(x[:1] for x in scene[1:]))
    threads, answers = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        answers.append(cpu.directional(TERMS[name], one, Direction(*(x[:1] for x in direction))))
    torch.set_num_threads(threads)
    for first, second in zip(*answers, strict=True):
        assert torch.equal(first.pair.P, second.pair.P) and torch.equal(first.temperature, second.temperature)
        if "both" in name:
            assert torch.equal(first.pair.P_features, second.pair.P_features)
    for found, wanted in zip(answers[0], cpu.directional(TERMS[name], scene, direction), strict=True):
        torch.testing.assert_close(found.pair.Q, wanted.pair.Q[:1], rtol=1e-11, atol=1e-14)


def test_coincident_points_have_finite_derivatives():
    scene, direction = _scene("softBD", 3, False, torch.float64)
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


def test_what_is_left_to_torch_is_told_once(caplog):
    scene, _ = _scene("softBD", 3, False, torch.float64)
    terms = TERMS["softBD"]._replace(outlier=3e-14)
    sentence = "an epsilon of 3e-14, below 1e-12 is computed by torch, slower than what numba has compiled"
    assert [sweeps_for(terms, scene).name for _ in range(2)] == ["torch", "torch"]
    assert [record.getMessage() for record in caplog.records] == [sentence]
    assert sweeps_for(TERMS["softBD"], scene).name == "numba"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"inner": Adam(2, keep="best")}, "a walk with keep='best'"),
        ({"inner": Adam(2), "temperature": Learned(1.0)}, "a walk with a learned temperature"),
        ({"inner": Adam(2), "chart": EulerAngles()}, "a walk in EulerAngles()"),
    ],
)
def test_steps_that_are_not_compiled_are_told_of_once(settings, words, caplog):
    tell_slow.cache_clear()
    layer, given = BBRLayer(Stage(SoftBD(), **settings)), noisy_pair(3)
    for _ in range(2):
        layer(given["P"], given["Q"])
    assert [record.getMessage().split(" is computed")[0] for record in caplog.records] == [words]


def test_the_backend_says_what_it_is_and_may_be_named(monkeypatch):
    assert backend() == ("numba", "the points are on cpu and numba is installed")
    monkeypatch.setenv("BBR_BACKEND", "torch")
    assert backend() == ("torch", "BBR_BACKEND says so")
    monkeypatch.setenv("BBR_BACKEND", "fortran")
    with pytest.raises(ValueError, match="BBR_BACKEND is 'fortran'; it must be one of numba, triton, torch"):
        backend()


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("d", [2, 3])
def test_compiled_adam_is_adam(d, shared, noise, rng):
    steps, axes = 4, AXES[d]
    k, free = len(axes), np.isin(np.arange(6), axes).astype(float)
    rates = np.zeros((steps, 6))
    rates[:, axes] = rng.uniform(0.01, 0.1, size=(steps, k))
    course = cpu_adam.Course(np.ones(steps), rates, free, (0.9, 0.999, 1e-8), shared, 0, noise, False)
    shapes = (steps + 1, 3, 3), (steps + 1, 3), (steps + 1, 6), (steps + 1, 6), (steps, 6)
    trace = cpu_adam.Trace(*map(np.zeros, shapes))
    trace.rotations[0] = np.eye(3)
    moments, motion = Moments.zero(torch.zeros(1, k, dtype=torch.float64)), RigidMotion.identity(3, (1,))
    for step in range(steps):
        trace.gradients[step] = rng.normal(size=6)
        trace.gradients[step, 2] = 0.0  # a component that has never moved
        trace.gradients[step] *= 1e-3 if step == 2 else 1.0
        gradient = torch.from_numpy(trace.gradients[step : step + 1, axes].copy())
        direction, moments = adam_direction(
            without_rounding(gradient, torch.tensor([noise]), k),
            moments,
            betas=(0.9, 0.999),
            eps=1e-8,
            blocks=(k - d, d) if shared else None,
        )
        cpu_adam.advance(course, trace, step, 0.0)
        move = torch.zeros(1, 6, dtype=torch.float64)
        move[:, axes] = -torch.from_numpy(rates[step, axes]) * direction
        turn = RigidMotion.from_rotvec(move[:, :3], move[:, 3:])
        motion = RigidMotion(turn.rotation @ motion.rotation, motion.translation + turn.translation)
    wanted = (*motion, moments.first, moments.second)
    found = trace.rotations[-1], trace.translations[-1], trace.firsts[-1, axes], trace.seconds[-1, axes]
    for f, w in zip(found, wanted, strict=True):
        np.testing.assert_allclose(f, w[0].numpy(), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 9.9e-3, 1.01e-2, 1.0, np.pi])
def test_the_exponential_and_its_derivative(angle):
    vector = angle * np.array([0.6, -0.8, 0.0])
    turn = cpu_turns.exponential(tuple(vector))
    np.testing.assert_allclose(turn, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    for axis in np.eye(3):
        ahead, behind = (cpu_turns.exponential(tuple(vector + s)) for s in (1e-6 * axis, -1e-6 * axis))
        turned = (ahead - behind) / 2e-6 @ turn.T
        for torque in np.eye(3):
            found = axis @ np.array(cpu_turns.through_exponential(tuple(vector), tuple(torque)))
            wanted = torque @ np.array(cpu_turns.axial(turned)) / 2
            np.testing.assert_allclose(found, wanted, atol=1e-8)


@pytest.mark.parametrize("name", ["softBBS", "softBD", "N"])
def test_a_large_pair_in_parts_is_the_same(name, monkeypatch):
    given, answers = noisy_pair(3, batch=1), []
    for pairs in (cpu_batch.PAIRS_PER_PART, 100):
        monkeypatch.setattr(cpu_batch, "PAIRS_PER_PART", pairs)
        P = given["P"].clone().requires_grad_()
        matrix = BBRLayer(name, inner=Adam(5, 0.05))(P, given["Q"]).target_from_source.matrix
        answers.append((matrix.detach(), *torch.autograd.grad(matrix.square().sum(), P)))
    for whole, parted in zip(*answers, strict=True):
        torch.testing.assert_close(whole, parted, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("name", ["softBD", "N"])
def test_what_is_kept_of_the_pairs_changes_nothing(name, monkeypatch):
    given, answers = noisy_pair(3), []
    for pairs in (cpu_batch.KEPT_PAIRS, 0):
        monkeypatch.setattr(cpu_batch, "KEPT_PAIRS", pairs)
        P = given["P"].clone().requires_grad_()
        matrix = BBRLayer(name, inner=Adam(5, 0.05))(P, given["Q"]).target_from_source.matrix
        answers.append((matrix.detach(), *torch.autograd.grad(matrix.square().sum(), P)))
    for kept, computed in zip(*answers, strict=True):
        torch.testing.assert_close(kept, computed, rtol=1e-11, atol=1e-13)
