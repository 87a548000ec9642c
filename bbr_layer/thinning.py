"""Fewer points, spread evenly in space: what a coarse stage sees of a large cloud."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer.pair import CloudPair
from bbr_layer.spacing import with_spacing

# Grids tried at most. A surface has as many occupied cells as the square of their inverse size, so that guesses are
# near; where nearly every point has a cell to itself, cells at least grow by a part.
GUESSES, LEAST_GROWTH = 12, 1.15
# Share of the points allowed that is aimed for, and from which on no further grid is tried.
AIM, GOOD_ENOUGH = 0.95, 0.85
# Cells of a grid that int64 can number.
LARGEST_NUMBER = 2.0**62


def evenly_thinned(points: Float[np.ndarray, "n d"], most: int) -> Int[np.ndarray, "k"]:
    """Numbers, in order, of at most ``most`` points: the first in every cell of the finest grid that leaves so few.

    Parameters
    ----------
    points: ``(n, d)``, finite.
    most: at least 1.

    Raises
    ------
    ValueError: ``most`` is less.
    """
    if most < 1:
        raise ValueError(f"most is {most}; at least one point must be left: try 1000")
    if len(points) <= most:
        return np.arange(len(points))
    kept = np.zeros(1, dtype=np.int64)  # all in one cell, should every grid that is tried leave too many
    cell = float(np.ptp(points, axis=0).max()) / most**0.5
    largest_crowded = 0.0
    for _ in range(GUESSES if cell > 0 else 0):
        first = _first_of_cells(points, cell)
        if len(kept) < len(first) <= most:
            kept = first
        if GOOD_ENOUGH * most <= len(first) <= most:
            break
        guess = cell * (len(first) / (AIM * most)) ** 0.5
        if len(first) > most:
            largest_crowded = max(largest_crowded, cell)
            guess = max(guess, LEAST_GROWTH * cell)
        elif guess <= largest_crowded:
            guess = (cell * largest_crowded) ** 0.5
        cell = guess
    return np.sort(kept)


def thinned_pair(pair: CloudPair, most: int | None) -> CloudPair:
    """The pair with at most ``most`` real points of each cloud (None: all), and the spacing that these have.

    Which points are kept has no derivative; what they hold keeps its own.
    """
    P, Q = _kept_rows(pair.P, pair.P_mask, most), _kept_rows(pair.Q, pair.Q_mask, most)
    if P is None and Q is None:
        return pair
    fields: dict[str, Tensor | None] = {}
    for side, rows in (("P", P), ("Q", Q)):
        if rows is None:
            continue
        index, real = rows
        fields |= {name: _taken(getattr(pair, name), index) for name in (side, *_companions(side))}
        fields[f"{side}_mask"] = None if bool(real.all()) else real
    return with_spacing(CloudPair(**{**pair._asdict(), **fields}))


def _companions(side: str) -> list[str]:
    return [f"{side}_{name}" for name in ("normals", "features", "weights")]


def _kept_rows(points: Tensor, mask: Tensor | None, most: int | None) -> tuple[Tensor, Tensor] | None:
    """Rows ``(batch, k)`` that are kept and which of them are real; None where all are."""
    if most is None or points.shape[1] <= most:
        return None
    rows = []
    for number, item in enumerate(points.detach().cpu().double().numpy()):
        real = np.arange(len(item)) if mask is None else mask[number].cpu().numpy().nonzero()[0]
        rows.append(torch.from_numpy(real[evenly_thinned(item[real], most)]))
    index = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True).to(points.device)
    sizes = torch.tensor([len(kept) for kept in rows], device=points.device)
    return index, torch.arange(index.shape[1], device=points.device) < sizes[:, None]


def _taken(values: Tensor | None, index: Tensor) -> Tensor | None:
    if values is None:
        return None
    where = index if values.ndim == 2 else index[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, where)


def _first_of_cells(points: np.ndarray, cell: float) -> np.ndarray:
    """The first point in each cell of a grid, by one number per cell."""
    corner = points.min(axis=0)
    cells = np.floor((points - corner) / cell).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    if np.prod(sizes.astype(float)) < LARGEST_NUMBER:
        return np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sizes)), return_index=True)[1]
    return np.unique(cells, axis=0, return_index=True)[1]
