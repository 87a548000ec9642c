"""Which planar scans see the same place, from no poses at all: rasters laid onto each other by Fourier transform.

A chain of neighbours that is wrong somewhere never meets its own loops, for loops are sought where the poses put them.
Here each of a few key scans becomes two pictures, where it hit something and where something would agree with it, and
every pair of them is correlated at all shifts at once and at many turns.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer import RigidMotion
from train.scans import Progress, silent
from train.scene import Scene

# Cells along a picture's side, and half of that side in median ranges: the median over the scans of the range that
# nine tenths of their points lie within. Wide enough that shifts do not run out of the picture and in again.
SIDE, HALF_SIDE, FAR = 64, 1.5, 0.9
# Turns that are tried, evenly around.
TURNS = 72
# What a cell that rays went through counts against one that agrees: with more, people in the way, who hide what is
# free, speak against the right place.
SEEN_FREE = 1.0


class Pictures(NamedTuple):
    """Of k scans: ``hits``, cells with points, of norm 1; ``likely``, what a hit there is worth, ``(k, SIDE, SIDE)``.

    ``cell``: side of a cell in the data's unit. The scan's origin is in the middle.
    """

    hits: Float[Tensor, "k side side"]
    likely: Float[Tensor, "k side side"]
    cell: float


class Likeness(NamedTuple):
    """Pairs of scans by how alike they look: ``target``, ``source (e,)``, ``target_from_source``, ``score (e,)``."""

    target: Tensor
    source: Tensor
    target_from_source: RigidMotion
    score: Tensor


def alike(scene: Scene, keys: Sequence[int], apart: int, progress: Progress = silent) -> Likeness:
    """Every pair of key scans at least ``apart`` scans from each other at its best turn and shift, the best first.

    Parameters
    ----------
    scene: planar scans.
    keys: numbers of the scans to compare, rising; all pairs of them cost time.
    """
    pictures = draw(scene, keys)
    hits, likely = torch.fft.rfft2(pictures.hits), torch.fft.rfft2(pictures.likely)
    numbers = torch.tensor(keys)
    found = []
    for key, number in enumerate(keys):
        progress("places", key, len(keys))
        before = int((numbers <= number - apart).sum())
        if before:
            turned = [torch.fft.rfft2(_turned(picture[key])) for picture in pictures[:2]]
            best = [_best_overlap((likely[one], hits[one]), turned) for one in range(before)]
            score, place = (torch.stack(part) for part in zip(*best, strict=True))
            found.append((numbers[:before], torch.full((before,), number), place, score))
    progress("places", len(keys), len(keys))
    if not found:
        none = torch.zeros(0, dtype=torch.int64)
        return Likeness(none, none, RigidMotion.identity(2, (0,)), none.double())
    target, source, place, score = (torch.cat(part) for part in zip(*found, strict=True))
    order = score.argsort(descending=True)
    return Likeness(target[order], source[order], _motions(place[order], pictures.cell), score[order].double())


def _best_overlap(target: tuple[Tensor, Tensor], turned: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """The largest sum over all cells of ``target(cell + shift) * turned(cell)``, both ways round, and where it is."""
    expected, hit = target
    spectrum = expected * turned[0].conj() + hit * turned[1].conj()
    best = torch.fft.irfft2(spectrum, s=(SIDE, SIDE)).flatten().max(dim=0)
    return best.values, best.indices


def draw(scene: Scene, keys: Sequence[int]) -> Pictures:
    """The pictures of the key scans.

    A cell with points counts once however many it holds: near the sensor points are dense, and people walk there.
    """
    ranges = [np.quantile(np.linalg.norm(scene.surfaces[key].points, axis=1), FAR) for key in keys]
    half = HALF_SIDE * float(np.median(ranges))
    cell = 2 * half / SIDE
    axis = (np.arange(SIDE) + 0.5) * cell - half
    middles = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    hits, likely = np.zeros((len(keys), SIDE, SIDE)), np.empty((len(keys), SIDE * SIDE))
    for number, key in enumerate(keys):
        surface, view = scene.surfaces[key], scene.views[key]
        places = np.floor((surface.points + half) / cell).astype(int)
        inside = ((places >= 0) & (places < SIDE)).all(axis=1)
        hits[number][tuple(places[inside].T)] = 1.0
        away = surface.tree.query(middles)[0] / cell
        likely[number] = np.exp(-(away**2) / 2)
        if view is not None:
            likely[number] -= SEEN_FREE * (view.saw_through(middles) & (away > 1))
    hits /= np.maximum(np.sqrt(hits.sum(axis=(1, 2), keepdims=True)), 1)
    return Pictures(torch.from_numpy(hits).float(), torch.from_numpy(likely).float().reshape(-1, SIDE, SIDE), cell)


def _turned(picture: Float[Tensor, "side side"]) -> Float[Tensor, "turns side side"]:
    """The picture at every turn about its middle, its first axis towards its second."""
    angles = torch.arange(TURNS) * (2 * torch.pi / TURNS)
    cos, sin, none = angles.cos(), angles.sin(), torch.zeros(TURNS)
    # where each cell comes from; grid_sample takes the second axis first
    back = torch.stack((torch.stack((cos, -sin, none), -1), torch.stack((sin, cos, none), -1)), -2)
    places = torch.nn.functional.affine_grid(back, [TURNS, 1, SIDE, SIDE], align_corners=False)
    many = picture.expand(TURNS, 1, SIDE, SIDE)
    return torch.nn.functional.grid_sample(many, places, align_corners=False)[:, 0]


def _motions(place: Int[Tensor, " e"], cell: float) -> RigidMotion:
    """The turns and shifts at flat places of the correlation ``(TURNS, SIDE, SIDE)``; shifts beyond half are back."""
    turn, shift = place // SIDE**2, torch.stack((place // SIDE % SIDE, place % SIDE), -1)
    shift = (shift + SIDE // 2) % SIDE - SIDE // 2
    return RigidMotion.from_rotvec((turn * (2 * torch.pi / TURNS)).double()[:, None], shift.double() * cell)
