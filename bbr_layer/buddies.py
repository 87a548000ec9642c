"""Best buddies: mutual nearest neighbours, hard (Eq. 2) and soft (Eq. 4)."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# The epsilon of Eq. 4: how much of each soft minimum belongs to nobody. With distances beyond about
# -ln(1e-10) = 23 temperatures from every candidate, a point has no soft buddy at all. Value of the authors' code.
OUTLIER_CONSTANT = 1e-10
# Stands for minus infinity in a masked logit: finite, so that derivatives are 0 instead of NaN.
MASKED_LOGIT = -1e30


def hard_buddies(
    distances: Float[Tensor, "*batch n m"], mask: Bool[Tensor, "*batch n m"] | None = None
) -> Bool[Tensor, "*batch n m"]:
    """Eq. 2: True where i is the nearest of j and j the nearest of i, ``(*batch, n, m)``.

    Parameters
    ----------
    distances: ``(*batch, n, m)``, from ``P[i]`` to ``Q[j]``. Of equal distances the first counts.
    mask: True where both points are real.

    Raises
    ------
    ValueError: a mask that is not boolean.

    >>> hard_buddies(torch.tensor([[0.1, 0.5], [0.2, 0.9]]))
    tensor([[ True, False],
            [False, False]])
    """
    if mask is not None:
        _check_mask(mask)
        distances = torch.where(mask, distances, torch.inf)
    n, m = distances.shape[-2:]
    rows = torch.arange(n, device=distances.device)[:, None]
    columns = torch.arange(m, device=distances.device)
    nearest_to_column = distances.argmin(-2, keepdim=True) == rows
    nearest_to_row = distances.argmin(-1, keepdim=True) == columns
    buddies = nearest_to_column & nearest_to_row
    return buddies if mask is None else buddies & mask


def soft_buddies(
    distances: Float[Tensor, "*batch n m"],
    temperature: Float[Tensor, "*batch"] | float,
    outlier: float = OUTLIER_CONSTANT,
    mask: Bool[Tensor, "*batch n m"] | None = None,
) -> Float[Tensor, "*batch n m"]:
    """Eq. 4: the soft minimum over the row times the soft minimum over the column, ``(*batch, n, m)`` in [0, 1].

    Computed in the log domain, with the outlier constant entering by log-add-exp: nothing under- or overflows at
    any temperature, and the value is that of the printed equation.

    Parameters
    ----------
    distances: ``(*batch, n, m)``, not negative.
    temperature: ``(*batch,)`` alpha, in the unit of the distances, positive.
    outlier: the epsilon of Eq. 4; 0 gives plain soft minima.
    mask: True where both points are real; elsewhere the answer is 0.

    Raises
    ------
    ValueError: a mask that is not boolean.
    """
    alpha = torch.as_tensor(temperature, dtype=distances.dtype, device=distances.device)
    logits = -distances / alpha[..., None, None]
    if mask is not None:
        _check_mask(mask)
        logits = torch.where(mask, logits, MASKED_LOGIT)
    rows = log_normaliser(logits, -1, outlier)
    columns = log_normaliser(logits, -2, outlier)
    buddies = torch.exp(2 * logits - rows - columns)
    return buddies if mask is None else torch.where(mask, buddies, 0.0)


def _check_mask(mask: Tensor) -> None:
    if mask.dtype != torch.bool:
        raise ValueError(
            f"mask has dtype {mask.dtype}; it is boolean, one per pair, and comes after the distances: "
            "try hard_buddies(torch.cdist(P, Q))"
        )


def log_normaliser(logits: Tensor, dim: int, outlier: float) -> Tensor:
    """Logarithm of a denominator of Eq. 4, ``log(outlier + sum exp(logits))`` over ``dim``, which is kept."""
    total = torch.logsumexp(logits, dim, keepdim=True)
    if outlier == 0:
        return total
    return torch.logaddexp(total, torch.full_like(total, math.log(outlier)))
