"""Buddies found by features, compiled: the layer against its plain unroll, and what must change nothing."""

import importlib.util
import warnings

import pytest
import torch
from problems import noisy_pair

from bbr_layer import Adam, Annealed, Autograd, BBRLayer, SoftBBS, SoftBD, Stage

pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.kernels import cpu, cpu_apart, cpu_batch  # noqa: E402

LOSSES = {
    "features": SoftBD(match="features"),
    "softBD, both": SoftBD(match="both", feature_weight=0.3, smoothing=0.2),
    "softBBS, both": SoftBBS(match="both", feature_weight=0.3, smoothing=0.2),
}


def _layer(name, backward=None):
    return BBRLayer(Stage(LOSSES[name], Adam(6, 0.05), Annealed(2.0, 1.0)), backward=backward)


def _given(d=3, masked=False, dtype=torch.float64):
    given = {name: x.to(dtype) for name, x in noisy_pair(d, batch=2, n=40, m=50).items()}
    if masked:
        given["P_mask"], given["Q_mask"] = torch.rand(2, 40) > 0.2, torch.rand(2, 50) > 0.2
    return given


def _answers(layer, given):
    """Pose, and its gradient by all that may have one; what has none is 0."""
    leaves = {name: x.clone().requires_grad_() for name, x in given.items() if x.is_floating_point()}
    matrix = layer(**{**given, **leaves}).target_from_source.matrix
    found = torch.autograd.grad(matrix.square().sum(), list(leaves.values()), materialize_grads=True)
    return matrix.detach(), dict(zip(leaves, found, strict=True))


def _same(found, wanted, tolerance=1e-10):
    torch.testing.assert_close(found[0], wanted[0], rtol=tolerance, atol=tolerance)
    for name, gradient in wanted[1].items():
        assert (found[1][name] - gradient).abs().max() <= tolerance * gradient.abs().max(), name


def test_the_compiled_sweeps_are_used(monkeypatch):
    used, pulled = [], cpu_apart.Features.pulled
    monkeypatch.setattr(cpu_apart.Features, "pulled", lambda self, b: used.append(b) or pulled(self, b))
    _answers(_layer("softBD, both"), _given())
    assert sorted(set(used)) == [0, 1]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", LOSSES)
def test_the_gradient_is_that_of_the_plain_unroll(name, d, masked):
    given = _given(d, masked)
    wanted = _answers(_layer(name, Autograd()), given)
    assert wanted[1]["P_features"].abs().max() > 1e-6 and wanted[1]["Q_features"].abs().max() > 1e-6
    _same(_answers(_layer(name), given), wanted)


def test_in_single_precision():
    given = _given()
    wanted = _answers(_layer("softBD, both"), given)
    found = _answers(_layer("softBD, both"), {name: x.float() for name, x in given.items()})
    assert found[1]["P_features"].dtype == torch.float32
    torch.testing.assert_close(found[0].float(), wanted[0].float(), rtol=1e-5, atol=1e-5)
    for name, gradient in wanted[1].items():
        assert (found[1][name] - gradient).norm() <= 1e-4 * gradient.norm(), name


@pytest.mark.parametrize("name", LOSSES)
def test_features_of_padded_points_do_not_matter(name):
    given = _given(masked=True)
    answers = []
    for value in (0.0, 1e6):
        other = dict(given)
        for side in "PQ":
            mask = given[f"{side}_mask"][..., None]
            other[f"{side}_features"] = torch.where(mask, given[f"{side}_features"], value)
        answers.append(_answers(_layer(name), other))
    _same(answers[0], answers[1], 1e-12)
    assert not answers[0][1]["P_features"][~given["P_mask"]].any()


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("setting", ["parts", "nothing kept", "too many pairs", "rows at a time", "no numba"])
def test_how_it_is_computed_changes_nothing(name, setting, monkeypatch):
    given = {field: x[:1] for field, x in _given().items()}
    wanted = _answers(_layer(name), given)
    if setting == "parts":
        monkeypatch.setattr(cpu_batch, "PAIRS_PER_PART", 300)
    elif setting == "nothing kept":
        monkeypatch.setattr(cpu_batch, "KEPT_PAIRS", 0)
    elif setting == "too many pairs":
        monkeypatch.setattr(cpu, "MOST_PAIRS", 100)
    elif setting == "rows at a time":
        monkeypatch.setattr(cpu_apart, "ROWS", 7)
    else:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    _same(_answers(_layer(name), given), wanted)


@pytest.mark.parametrize("name", LOSSES)
def test_points_that_are_alike_in_everything_have_finite_gradients(name):
    given = {field: x for field, x in _given().items() if "weights" not in field and "normals" not in field}
    given |= {"Q": given["P"].clone(), "Q_features": given["P_features"].clone()}
    given["Q_features"][:, :10] = given["Q_features"][:, 10:11]
    for gradient in _answers(_layer(name), given)[1].values():
        assert gradient.isfinite().all()


def test_features_that_the_last_stage_does_not_see_are_spoken_of():
    given = _given()
    given["P_features"].requires_grad_()
    with pytest.warns(
        UserWarning, match=r"features want a gradient, but the layer ends with BuddyFilter.*BBRLayer\('softBD'\)"
    ):
        BBRLayer.fast()(**given)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _layer("features")(**given)
        with torch.no_grad():
            BBRLayer.fast()(**given)


def test_features_tell_points_apart_that_lie_anywhere():
    """A quarter turn, from where the nearest points are the wrong ones."""
    given = noisy_pair(3, batch=1, n=30, m=30)
    features = torch.eye(30, dtype=torch.float64)[None]
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    layer = BBRLayer(Stage(SoftBD(match="features"), Adam(200, 0.05), Annealed(0.5, 0.1)))
    found = layer(given["P"], given["P"] @ turn, P_features=features, Q_features=features).target_from_source
    torch.testing.assert_close(found.rotation[0], turn, atol=1e-3, rtol=0)
