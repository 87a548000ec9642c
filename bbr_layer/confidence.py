"""The probability that an answer is right, from three shares of its pairs that no unit and no density changes.

Right means: rotation at most 5 degrees off, and the source's points at most 5 percent of its root-mean-square radius
from where they belong, on average. How well it is calibrated: docs/trust.md.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.ellipsoid import half_turned, turned_within
from bbr_layer.geometry import RigidMotion
from bbr_layer.matches import Matches, matched
from bbr_layer.neighbourhoods import nearest_neighbours
from bbr_layer.normals import estimate_normals
from bbr_layer.pair import CloudPair
from bbr_layer.thinning import thinned_pair

# Points of each cloud that are judged: with 10 000 the sensor's noise is wider than the spacing, and fewer pairs of
# right answers are close; with 1000 to 4000 it is not so.
JUDGED_POINTS = 2000
# Of two points on one surface the plane of the pair is nearer than this share of the spacing; two points of a pair are
# not farther apart than so many spacings. Chosen among 0.25, 0.5, 1 and 2.
ON_PLANE = 0.5
NEAR = 2.0
# Distinct points of the smaller cloud that the calibration begins with. Of k fewer the probability is at most k over
# this: a handful of points fits nearly anything closely, and all three shares may be 1 by chance.
FULLY_JUDGED = 100
# Degrees that the source is turned by to see what fits anywhere, beside half a turn, and the logits by which an answer
# must exceed the worse of the two: a box fits itself turned by half a turn, and a street one turned by a little, but
# neither both. Chosen: surfaces and curves lie below -6 logits, which doubts nothing, whereas clouds that fill a volume
# lie about 0, and a few logits higher once they are fitted to each other: `python -m benchmarks.volumes`.
ELSEWHERE_DEG = 40.0
ELSEWHERE_LOGITS = 6.0
# Logistic regression: of 1, share of the smaller cloud with a buddy, share of pairs on one plane, share of them near.
# `python -m benchmarks.reliability` fits them.
COEFFICIENTS = (-75.91, 19.45, 40.96, 36.26)


@torch.no_grad()
def judged_clouds(pair: CloudPair) -> CloudPair:
    """At most 2000 points of each cloud, spread evenly, and their normals; those given, where all points are judged.

    Of points in one place one is judged: the others are no evidence of their own, and no measure of spacing. Normals
    of a dense cloud follow its noise; those of the judged points are like those of the fit.
    """
    thin = thinned_pair(pair._replace(P_features=None, Q_features=None), JUDGED_POINTS)
    thin = thin._replace(P_mask=_distinct(thin.P, thin.P_mask), Q_mask=_distinct(thin.Q, thin.Q_mask))
    P_normals, Q_normals = (
        kept if few.shape[1] == all_points.shape[1] else None
        for few, all_points, kept in ((thin.P, pair.P, pair.P_normals), (thin.Q, pair.Q, pair.Q_normals))
    )
    return thin._replace(
        P_normals=_with_normals(thin.P, P_normals, thin.P_mask),
        Q_normals=_with_normals(thin.Q, Q_normals, thin.Q_mask),
        P_weights=None,
        Q_weights=None,
    )


@torch.no_grad()
def confidence(pair: CloudPair, motion: RigidMotion, found: Matches) -> Float[Tensor, "batch"]:
    """Probability that the answer is right, in [0, 1], float64; 0 where no two points are buddies.

    At most k / 100 where the smaller cloud has k < 100 distinct points, and less where the source, turned within its
    own ellipsoid, would fit about as well: that says nothing for the answer.

    Parameters
    ----------
    pair: as ``judged_clouds`` has it.
    motion, found: the answer, and the pairs there.
    """
    gaps = point_gaps(pair)
    at_answer, elsewhere = _logits(_shares(pair, found, gaps)), fit_elsewhere(pair, motion, gaps)
    probability = torch.sigmoid(at_answer - (elsewhere + ELSEWHERE_LOGITS).clamp(min=0.0))
    most = (torch.minimum(*pair.real_counts()).double() / FULLY_JUDGED).clamp(max=1.0)
    return torch.where(found.mutual.any(-1), torch.nan_to_num(probability, nan=0.0).minimum(most), 0.0)


@torch.no_grad()
def statistics(pair: CloudPair, found: Matches) -> Float[Tensor, "batch 3"]:
    """Shares in [0, 1]: of the smaller cloud's points that have a buddy; of the pairs on one plane; of the near ones.

    A pair's spacing is the mean of its two points' distances to the next points of their own clouds.
    """
    return _shares(pair, found, point_gaps(pair))


@torch.no_grad()
def fit_elsewhere(pair: CloudPair, motion: RigidMotion, gaps: tuple[Tensor, Tensor]) -> Float[Tensor, "batch"]:
    """Logits of the source turned within its own ellipsoid, by half a turn or a little: of both the worse.

    Only half a turn where that alone says that there is nothing to doubt: a stretched cloud needs a tree of its own.
    """
    half = _logits(_shares(pair, matched(pair, half_turned(pair, motion)), gaps))
    if not (half > -ELSEWHERE_LOGITS).any():
        return half
    away = turned_within(pair, ELSEWHERE_DEG)
    return torch.minimum(half, _logits(_shares(away, matched(away, motion), gaps)))


@torch.no_grad()
def point_gaps(pair: CloudPair) -> tuple[Float[Tensor, "batch n"], Float[Tensor, "batch m"]]:
    """Distance of each point of P, and of Q, to the next one of its own cloud, float64."""
    return _gaps(pair.P, pair.P_mask), _gaps(pair.Q, pair.Q_mask)


def _gaps(points: Tensor, mask: Tensor | None) -> Tensor:
    index = nearest_neighbours(points, 2, mask)[..., 1:]
    next_ones = points.gather(1, index.expand_as(points))
    return torch.linalg.vector_norm((points - next_ones).double(), dim=-1)


def _logits(shares: Tensor) -> Tensor:
    weights = torch.tensor(COEFFICIENTS, dtype=torch.float64, device=shares.device)
    return weights[0] + shares @ weights[1:]


def _shares(pair: CloudPair, found: Matches, gaps: tuple[Tensor, Tensor]) -> Tensor:
    """The statistics, from the gaps of the points of P and of Q."""
    spacing = (gaps[1] + gaps[0].gather(1, found.nearest)) / 2
    normals, _ = found.normal_parts()
    on_plane = (found.offsets * normals).sum(-1).abs() <= ON_PLANE * spacing
    near = torch.linalg.vector_norm(found.offsets, dim=-1) <= NEAR * spacing
    pairs = found.mutual.sum(-1)
    smaller = torch.minimum(*pair.real_counts())
    shares = [(found.mutual & which).sum(-1) / pairs.clamp(min=1) for which in (on_plane, near)]
    return torch.stack((pairs / smaller.clamp(min=1), *shares), -1).double()


def _distinct(points: Tensor, mask: Tensor | None) -> Tensor | None:
    """The mask without all but the first of coincident points; as it is where there are none."""
    clouds = points.detach().cpu().numpy()
    # Sorting one axis costs little, and tells that there are none of nearly all clouds that have none.
    if not any((np.diff(np.sort(cloud[:, 0])) == 0).any() for cloud in clouds):
        return mask
    real = np.ones(clouds.shape[:2], bool) if mask is None else mask.cpu().numpy()
    kept = np.zeros_like(real)
    for rows, cloud, own in zip(kept, clouds, real, strict=True):
        numbers = np.flatnonzero(own)
        rows[numbers[np.unique(cloud[numbers], axis=0, return_index=True)[1]]] = True
    return mask if (kept == real).all() else torch.from_numpy(kept).to(points.device)


def _with_normals(points: Tensor, normals: Tensor | None, mask: Tensor | None) -> Tensor:
    return estimate_normals(points, mask=mask) if normals is None else normals
