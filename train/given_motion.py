"""What poses that came with the scans, such as odometry, say of neighbours: edges weighed by their scatter.

A registration finds nothing between scans that share nothing, as when a sensor that looks ahead turns around, and it
slides along a corridor; odometry does neither. How far to trust it shows in how well it agrees with the good edges.
"""

import torch
from torch import Tensor

from bbr_layer import RigidMotion
from train.pose_graph import Edges, disagreement
from train.scans import ScanSet

# Kind of an edge that no scan was registered for.
GIVEN = 3
# An edge whose score is below this part of the chain's median found nothing.
FAINT = 0.3
# So far from the given motion, in standard deviations, a neighbour's edge must score as the median does at least: a
# scan that shares little with the one before finds another place to fit. Chosen: with it the Intel Research Lab's log
# has no rooms 2 m off their place.
FAR = 8.0
# A registered edge is taken to be right to this part of a point spacing, against which the given ones are weighed.
RIGHT_TO = 0.1
# From the median of absolute values to the standard deviation of a Gaussian.
GAUSSIAN = 1.4826


def with_given(edges: Edges, scans: ScanSet, spacing: float) -> Edges:
    """The chain without the edges that found nothing, and beside it the motions that the given poses say.

    Parameters
    ----------
    edges: the registered chain, every neighbour once.
    scans: with starting poses.
    spacing: of the points, in the data's unit.

    Returns
    -------
    Edges of kind ``GIVEN`` have score 0 and the information of their scatter about the better half of the chain.
    """
    assert scans.start is not None
    world = RigidMotion.from_matrix(torch.from_numpy(scans.start))
    motion = world.between(edges.target, edges.source)
    good = edges.score >= edges.score.median()
    away = disagreement(motion, edges).abs()
    scatter = GAUSSIAN * away[good].median(0).values
    registered = edges.information[good].diagonal(dim1=-2, dim2=-1).median(0).values
    strength = torch.minimum((RIGHT_TO * spacing / scatter.clamp(min=1e-300)).square(), registered)
    given = edges._replace(
        target_from_source=motion,
        information=torch.diag(strength).expand_as(edges.information).clone(),
        score=torch.zeros_like(edges.score),
        kind=torch.full_like(edges.kind, GIVEN),
    )
    far = (away > FAR * scatter).any(-1) & ~good
    return clear(edges.kept(~far), edges).joined(given)


def clear(edges: Edges, chain: Edges) -> Edges:
    """The registered edges that found something, beside the chain's median score."""
    return edges.kept(edges.score >= FAINT * chain.score[chain.kind == 0].median())


def without_given(edges: Edges, belief: Tensor) -> tuple[Edges, Tensor]:
    """The registered edges, and how far each is believed."""
    registered = edges.kind != GIVEN
    return edges.kept(registered), belief[registered]
