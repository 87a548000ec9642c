"""Blocks of rows of the n x m distances, with everything a sweep needs of them."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.buddies import MASKED_LOGIT
from bbr_layer.distances import normal_signs, smooth_root
from bbr_layer.kernels.scene import Scene, SoftTerms
from bbr_layer.pair import CloudPair

# Pairs in one block; some 25 intermediate arrays of this many numbers live at once, 0.2 GB in float32.
PAIRS_PER_BLOCK = 2**21


class Block(NamedTuple):
    """A block of rows: the pair with P cut to it, and all that is computed from its distances, ``(batch, r, m)``."""

    pair: CloudPair
    offsets: list[Tensor]  # q - p, per coordinate
    normals: list[Tensor] | None  # n_q + s n_p, per coordinate
    signs: Tensor | float
    residual: Tensor | None  # of Eq. 7, before the absolute value
    distances: Tensor
    matched: Tensor  # the distances that buddies are found by
    free: Tensor | None  # False where the distance was clipped
    logits: Tensor


def blocks(terms: SoftTerms, scene: Scene, limit: Tensor | None) -> Iterator[tuple[Block, slice]]:
    """The blocks in order, each with the rows it holds; ``limit`` cuts distances, see ``clipping_distance``."""
    batch, n = scene.pair.P.shape[:2]
    rows = max(1, PAIRS_PER_BLOCK // max(batch * scene.pair.Q.shape[1], 1))
    for first in range(0, n, rows):
        chosen = slice(first, first + rows)
        cut = {name: getattr(scene.pair, name) for name in ("P", "P_normals", "P_features", "P_weights", "P_mask")}
        fields = {**scene.pair._asdict(), **{name: None if x is None else x[:, chosen] for name, x in cut.items()}}
        pair = CloudPair(**fields)
        yield _block(terms, pair, scene, limit), chosen


def _block(terms: SoftTerms, pair: CloudPair, scene: Scene, limit: Tensor | None) -> Block:
    rounding = scene.rounding.to(pair.P.dtype)[:, None, None]
    offsets = [q[:, None] - p[:, :, None] for p, q in zip(pair.P.unbind(-1), pair.Q.unbind(-1), strict=True)]
    normals, residual = None, None
    signs: Tensor | float = 1.0
    if terms.planes:
        P_normals, Q_normals = pair.both_normals()
        signs = normal_signs(P_normals, Q_normals) if terms.align_signs else 1.0
        columns = zip(P_normals.unbind(-1), Q_normals.unbind(-1), strict=True)
        normals = [q[:, None] + signs * p[:, :, None] for p, q in columns]
        residual = sum((o * x for o, x in zip(offsets, normals, strict=True)), torch.zeros_like(offsets[0]))
        squared = residual.square()
    else:
        squared = sum((o.square() for o in offsets), torch.zeros_like(offsets[0]))
    distances, free = smooth_root(squared, rounding), None
    if limit is not None:
        free = distances < limit
        distances = torch.minimum(distances, limit)
    matched = distances if terms.match == "points" else _matched_distances(terms, pair, squared, rounding)
    logits = -matched / scene.temperature.to(pair.P.dtype)[:, None, None]
    mask = pair.pair_mask()
    if mask is not None:
        logits = torch.where(mask, logits, MASKED_LOGIT)
    return Block(pair, offsets, normals, signs, residual, distances, matched, free, logits)


def _matched_distances(terms: SoftTerms, pair: CloudPair, squared: Tensor, rounding: Tensor) -> Tensor:
    P, Q = pair.both_features()
    # By explicit differences, all channels at once: features do not move, so that nothing is differentiated here.
    apart = torch.cdist(P.detach(), Q.detach(), compute_mode="donot_use_mm_for_euclid_dist").square()
    total = apart * terms.feature_weight**2
    return smooth_root(total + squared if terms.match == "both" else total, rounding)


def clipping_distance(terms: SoftTerms, scene: Scene) -> Tensor | None:
    """Where distances are clipped, ``(batch, 1, 1)``; it is held fixed in every derivative."""
    if terms.clip is None:
        return None
    count, total, squares = (torch.zeros_like(scene.rounding) for _ in range(3))
    for block, _ in blocks(terms, scene, None):
        mask = block.pair.pair_mask()
        squared = block.distances.double().square()
        real = torch.ones_like(squared) if mask is None else mask.expand_as(squared).double()
        count, total = count + real.sum((-1, -2)), total + (squared * real).sum((-1, -2))
        squares = squares + (squared.square() * real).sum((-1, -2))
    mean = total / count.clamp(min=1.0)
    spread = (squares / count.clamp(min=1.0) - mean.square()).clamp(min=0.0).sqrt()
    return (mean + terms.clip * spread).sqrt().to(scene.pair.P.dtype)[:, None, None]
