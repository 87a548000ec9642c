"""The losses in closed form against plain differentiation: values, gradients, directional derivatives."""

import pytest
import torch
from problems import motion, noisy_pair

from bbr_layer import BuddyFilter, CloudPair, RigidMotion, SoftBBS, SoftBD, SoftBDNormals
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.kernels import blocks
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.kernels.scene import SoftTerms
from bbr_layer.kernels.soft import SoftKernel
from bbr_layer.neighbours import MutualNeighbours

# Large enough that some of seven points have hardly a buddy.
EPS = 1e-3
LOSSES = {
    "softBBS": (SoftBBS(outlier=EPS, match="points"), SoftTerms(False, outlier=EPS)),
    "softBD": (SoftBD(outlier=EPS, match="points"), SoftTerms(True, outlier=EPS)),
    "softBD, no epsilon": (SoftBD(outlier=0, match="points"), SoftTerms(True)),
    "softBD, rounded": (SoftBD(smoothing=0.2, match="points"), SoftTerms(True, outlier=1e-10)),
    "N": (SoftBDNormals(outlier=EPS, smoothing=0.2), SoftTerms(True, True, outlier=EPS)),
    "N, the authors'": (
        SoftBDNormals(outlier=EPS, align_signs=False, clip=1.0),
        SoftTerms(True, True, False, outlier=EPS, clip=1.0),
    ),
    "features": (SoftBD(outlier=EPS, match="features"), SoftTerms(True, outlier=EPS, match="features")),
    "softBD, both": (
        SoftBD(outlier=EPS, match="both", feature_weight=0.7, smoothing=0.1),
        SoftTerms(True, outlier=EPS, match="both", feature_weight=0.7),
    ),
    "softBBS, both": (
        SoftBBS(outlier=EPS, match="both", feature_weight=0.7),
        SoftTerms(False, outlier=EPS, match="both", feature_weight=0.7),
    ),
    "F": (BuddyFilter(), None),
    "F, reach": (BuddyFilter(reach=1.3), None),
}


def _scene(d, masked):
    given = noisy_pair(d, batch=2)
    if masked:
        given["P_mask"], given["Q_mask"] = torch.rand(2, 7) > 0.2, torch.rand(2, 9) > 0.2
    pair = CloudPair(**given, spacing=torch.tensor([0.5, 0.4], dtype=torch.float64))
    moved = motion(d, 0.1, 0.05)
    at = RigidMotion(moved.rotation.expand(2, d, d).clone(), moved.translation.expand(2, d).clone())
    temperature = torch.tensor([0.5, 0.3], dtype=torch.float64)
    for field in (*pair[:8], pair.spacing, *at, temperature):
        field.requires_grad_()
    return pair, at, temperature


def _relative_error(found, wanted):
    wanted = torch.zeros_like(found) if wanted is None else wanted
    return (found - wanted).abs().max() / wanted.abs().max().clamp(min=1e-30)


@pytest.mark.parametrize("rows", ["whole", "in blocks"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", LOSSES)
def test_closed_form_is_plain_differentiation(name, d, masked, rows, monkeypatch):
    if rows == "in blocks":
        monkeypatch.setattr(blocks, "PAIRS_PER_BLOCK", 40)
    loss, terms = LOSSES[name]
    pair, at, temperature = _scene(d, masked)
    search = MutualNeighbours(pair.P, pair.Q, pair.P_mask, pair.Q_mask)
    kernel = MatchedKernel(search, loss.reach) if terms is None else SoftKernel(terms)
    found = PairKernel(kernel, pair, loss.smoothing * pair.spacing).slope(at, temperature)
    value = loss.objective(pair)(at, temperature)
    wanted = (value, *torch.autograd.grad(value.sum(), (*at, temperature), create_graph=True))
    assert all(_relative_error(f, w) < 1e-12 for f, w in zip(found, wanted, strict=True))

    leaves = [*pair[:8], pair.spacing, *at, temperature]
    cotangents = [torch.randn_like(x) for x in wanted]
    for chosen in (slice(0, 1), slice(1, 4), slice(0, 4)):
        first, second = (
            torch.autograd.grad(slopes[chosen], leaves, cotangents[chosen], allow_unused=True, retain_graph=True)
            for slopes in (found, wanted)
        )
        for f, w in zip(first, second, strict=True):
            if f is None:
                assert w is None or not w.any()
            else:
                assert f.isfinite().all()
                assert not (w is None or not w.any()) or not f.any()
                assert w is None or not w.any() or _relative_error(f, w) < 1e-10
