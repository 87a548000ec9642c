"""The verdict on an answer: pairs counted, and one sentence from the confidence and the status."""

import numpy as np
import pytest
import torch

from bbr_layer import Adam, BBRLayer, RigidMotion, Status
from bbr_layer.directions import named
from bbr_layer.verdict import BELIEVED, give_verdict


@pytest.fixture
def found(rng):
    """Twelve points, nine, and an answer on them whose pairs are counted below."""
    P, Q = (torch.from_numpy(rng.normal(size=(n, 3))) for n in (12, 9))
    return P, Q, BBRLayer("softBD", inner=Adam(1, 1e-9))(P, Q, start=RigidMotion.identity(3))


def test_pairs_are_counted_as_loops_would(found):
    P, Q, answer = found
    D = (P[:, None] - Q).norm(dim=-1)
    pairs = [(i, j) for i in range(12) for j in range(9) if D[i, j] == D[i].min() == D[:, j].min()]
    verdict = give_verdict(answer, 9)
    assert verdict.buddies == len(pairs)
    assert verdict.buddy_share == len(pairs) / 9
    squares = [float(D[i, j]) ** 2 for i, j in pairs]
    assert verdict.residual_rms == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-6)


def test_confidence_decides_and_is_said(found):
    converged = found[2]._replace(status=torch.tensor(Status.CONVERGED))
    sure, doubtful = (
        give_verdict(converged._replace(confidence=torch.tensor(BELIEVED + step)), 9) for step in (0.01, -0.01)
    )
    assert sure.trustworthy and sure.sentence == "Trustworthy: the probability that it is right is 0.51."
    assert not doubtful.trustworthy and "the probability that it is right is 0.49" in doubtful.sentence


def test_words_other_than_converged_forbid_trust(found):
    moving = found[2]._replace(status=torch.tensor(Status.ITERATION_LIMIT), confidence=torch.tensor(1.0))
    verdict = give_verdict(moving, 9)
    assert not verdict.trustworthy
    assert "the pose was still moving at the last step." in verdict.sentence.replace(". Try", ".")


def test_deviation_is_that_of_a_mean():
    """400 unit residuals along z: the mean is known to 1 / 20 of one; other directions far better."""
    information = torch.diag(torch.tensor([5e3, 5e3, 5e3, 5e3, 5e3, 400.0], dtype=torch.float64))
    weakest = named(information, 1.0, 1.0)[0]
    assert not weakest.turning and weakest.deviation == pytest.approx(1 / 20)
    np.testing.assert_allclose(weakest.axis, [0, 0, 1], atol=1e-6)
    turning = named(information.flip(0, 1) * 4, 2.0, 1.0)[0]
    assert turning.turning and turning.deviation == pytest.approx(1 / 40)


def test_slides_and_turns_of_one_strength_are_told_apart():
    """A cylinder's slide and turn, which an eigenvector may mix in any way."""
    mixed = torch.tensor([[0, 0, 1, 0, 0, 1], [0, 0, -1, 0, 0, 1]], dtype=torch.float64) / 2**0.5
    strengths = torch.tensor([1.0, 0.999], dtype=torch.float64)[:, None]  # the eigenvectors are the mixtures
    information = torch.eye(6, dtype=torch.float64) - mixed.mT @ (strengths * mixed)
    found = [direction for direction in named(information, 1.0, 1.0) if direction.free]
    assert [direction.words for direction in found] == [
        "turning about (0.00, 0.00, 1.00), held by nothing",
        "sliding along (0.00, 0.00, 1.00), held by nothing",
    ]
