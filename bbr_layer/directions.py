"""Directions of motion that the pairs of an answer do not hold: found, told apart as slides and turns, and named."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

# A direction that both surfaces together hold with less than this share of the mean is free. Chosen: those that are
# free on the shapes of tests/test_trust.py have less; a corridor eight times as long as wide turns about itself with
# 0.02.
FREE_SHARE = 0.02
# An eigenvalue below this share of the largest is 0 but for rounding.
ROUNDING_SHARE = 1e-12


@dataclass(frozen=True)
class Direction:
    """A motion about the centroid of the moved source, and how well the pairs hold it.

    Parameters
    ----------
    turning: a rotation (True) or a translation.
    axis: ``(d,)`` unit vector on the target's axes; of a rotation in 2D ``(0, 0, 1)``.
    deviation: how far the answer may be off along it: one standard deviation, radians or the data's unit, if the
        residuals were independent; infinite where it is free.
    share: what resists it, as a share of the mean over all directions, 0 and more.
    free: whether nothing that both surfaces agree on resists it.
    """

    turning: bool
    axis: Float[np.ndarray, "d"]
    deviation: float
    share: float
    free: bool

    @property
    def words(self) -> str:
        """Such as ``sliding along (0.01, 1.00, 0.02), uncertain by about 0.003``."""
        axis = ", ".join(f"{number + 0.0:.2f}" for number in self.axis.round(2))
        motion = f"turning about ({axis})" if self.turning else f"sliding along ({axis})"
        if math.isinf(self.deviation):
            return f"{motion}, held by nothing"
        deviation = f"{math.degrees(self.deviation):.2g} deg" if self.turning else f"{self.deviation:.2g}"
        return f"{motion}, uncertain by about {deviation}"


def spectrum(
    resistance: Float[Tensor, "*batch k k"], radius: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch k"], Float[Tensor, "*batch k k"], Bool[Tensor, "*batch k"]]:
    """Eigenvalues, eigenvectors (columns) and which are free, weakest first; a turn counts by how it moves the rim."""
    k = resistance.shape[-1]
    turns = 1 if k == 3 else 3
    unit = torch.ones_like(resistance[..., 0])
    unit[..., :turns] = 1 / radius[..., None]
    comparable = torch.nan_to_num(resistance * unit[..., :, None] * unit[..., None, :])
    values, vectors = torch.linalg.eigh(comparable)
    return values, vectors, values <= FREE_SHARE * values.mean(-1, keepdim=True)


def named(resistance: Float[Tensor, "k k"], radius: float, residual: float) -> list[Direction]:
    """All k directions of one answer, the weakest first; ``residual`` is the RMS of the pairs', in the data's unit."""
    values, vectors, free = (
        x.numpy() for x in spectrum(resistance.cpu(), torch.tensor(radius, dtype=resistance.dtype))
    )
    count = int(free.sum())
    basis = np.concatenate((_apart(vectors[:, :count]), vectors[:, count:]), axis=1)
    return [
        _direction(basis[:, i], values, (i, i < count), (radius, residual if math.isfinite(residual) else math.inf))
        for i in range(len(values))
    ]


def _apart(vectors: np.ndarray) -> np.ndarray:
    """Another basis of the same motions, in which slides do not turn: the turns first, the purest slides last.

    Free directions all have the same strength, none, so that any mixture of them may come.
    """
    turns = 1 if len(vectors) == 3 else 3
    return vectors @ np.linalg.svd(vectors[:turns])[2].T if vectors.shape[1] else vectors


def _direction(
    vector: np.ndarray, values: np.ndarray, place: tuple[int, bool], lengths: tuple[float, float]
) -> Direction:
    (number, free), (radius, residual) = place, lengths
    turns = 1 if len(vector) == 3 else 3
    rotation, translation = vector[:turns], vector[turns:]
    turning = bool(np.linalg.norm(rotation) > np.linalg.norm(translation))
    axis = rotation if turning else translation
    if turning and turns == 1:
        axis = np.array([0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])  # an axis has no sense: its largest part is made positive
    held = not free and values[number] > ROUNDING_SHARE * values[-1]
    deviation = residual / math.sqrt(values[number]) if held else math.inf
    share = max(float(values[number]), 0.0) / float(values.mean()) if values.mean() > 0 else 0.0
    return Direction(turning, axis, deviation / (radius if turning else 1.0), share, free)
