"""What a registration answers: the motion, and everything that tells whether to trust it."""

from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer.confidence import confidence, judged_clouds
from bbr_layer.directions import Direction, named, spectrum
from bbr_layer.geometry import RigidMotion
from bbr_layer.matches import matched, matched_information, pair_weights
from bbr_layer.pair import CloudPair, Frame, centre_and_radius
from bbr_layer.resistance import resistance


class Status(IntEnum):
    """How a registration ended."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    NO_BUDDIES = 2
    DEGENERATE = 3
    NON_FINITE = 4

    @property
    def words(self) -> str:
        """What happened and what to try next."""
        return _WORDS[self]


_WORDS = {
    Status.CONVERGED: "converged",
    Status.ITERATION_LIMIT: "the pose was still moving at the last step: give it more steps, or a better start",
    Status.NO_BUDDIES: "no two points are mutual nearest neighbours: check masks, weights, overlap and the start",
    Status.DEGENERATE: "at least one direction of motion is not held by the points: do not trust it along that one",
    Status.NON_FINITE: "the pose is not finite: check the scale of the inputs and of the learning rates",
}


class Registration(NamedTuple):
    """The answer of a registration; every field has the batch dimensions of the input.

    Parameters
    ----------
    target_from_source: the motion that carries Q onto P, float64.
    loss: ``(*batch,)`` last stage's loss at the final pose, in its frame's units; differentiable.
    temperature: ``(*batch,)`` final temperature in the data's unit.
    gradient_norm: ``(*batch,)`` of the last step taken.
    iterations: ``(*batch,)`` inner steps of the run that gave the answer.
    buddies: ``(*batch,)`` how many pairs are mutual nearest neighbours at the final pose.
    information: ``(*batch, k, k)`` with k = d (d + 1) / 2: sum of J^T J over those pairs, for residuals in data units
        (point to plane where there are normals, else point to point) and a tangent of rotation (radians) before
        translation, about the centroid of the moved source, on the target's axes.
    status: ``(*batch,)`` codes of ``Status``.
    resistance: ``(*batch, k, k)`` like ``information``, always point to plane, and only what both surfaces agree
        on; counted on at most 2000 points of each. ``directions`` reads it.
    residual: ``(*batch,)`` root mean square of the pairs' residuals, in the data's unit.
    radius: ``(*batch,)`` root-mean-square radius of the source, in the data's unit; 1 where that is 0.
    confidence: ``(*batch,)`` probability, 0 to 1, that the answer is right: rotation at most 5 degrees off, points at
        most 5 percent of the radius on average (docs/trust.md). 0 where there are no buddies, where a direction is free
        (``DEGENERATE``) and where the pose is not finite; at most k / 100 of k points under 100. Like all from
        ``iterations`` on it has no gradient.
    """

    target_from_source: RigidMotion
    loss: Float[Tensor, "*batch"]
    temperature: Float[Tensor, "*batch"]
    gradient_norm: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    buddies: Int[Tensor, "*batch"]
    information: Float[Tensor, "*batch k k"]
    status: Int[Tensor, "*batch"]
    resistance: Float[Tensor, "*batch k k"]
    residual: Float[Tensor, "*batch"]
    radius: Float[Tensor, "*batch"]
    confidence: Float[Tensor, "*batch"]

    @property
    def words(self) -> str | list[str]:
        """The status in words; a list, in order, for a batch."""
        words = [Status(code).words for code in self.status.reshape(-1).tolist()]
        return words[0] if self.status.ndim == 0 else words

    @property
    def directions(self) -> list[Direction] | list[list[Direction]]:
        """How well each of the k directions of motion is held, weakest first; a list of such, for a batch."""
        found = self._named()
        return found[0] if self.resistance.ndim == 2 else found

    @property
    def weak_directions(self) -> list[Direction] | list[list[Direction]]:
        """The directions that nothing holds, in words by ``Direction.words``: none unless the status is degenerate.

        A plane has two slides and a turn, a sphere three turns, a cylinder a turn and a slide, a corridor a slide.
        """
        found = [[direction for direction in item if direction.free] for item in self._named()]
        return found[0] if self.resistance.ndim == 2 else found

    def _named(self) -> list[list[Direction]]:
        held, radius, residual = (torch.as_tensor(x) for x in (self.resistance, self.radius, self.residual))
        k = held.shape[-1]
        items = zip(held.reshape(-1, k, k), radius.reshape(-1).tolist(), residual.reshape(-1).tolist(), strict=True)
        return [named(*item) for item in items]

    def reshape(self, batch: tuple[int, ...]) -> "Registration":
        """The same answer under other batch dimensions."""
        motion = RigidMotion(*(x.reshape((*batch, *x.shape[1:])) for x in self.target_from_source))
        return Registration(motion, *(x.reshape((*batch, *x.shape[1:])) for x in self[1:]))


class StageResult(NamedTuple):
    """Where a stage ended; temperatures in the data's unit."""

    motion: RigidMotion  # between the user's frames
    loss: Tensor
    temperature: Tensor
    gradient_norm: Tensor
    settled: Tensor


@torch.no_grad()
def judged(pair: CloudPair, frame: Frame, ended: StageResult, steps: int) -> Registration:
    """The answer of a registration whose last stage ``ended``, with what its pairs say about it.

    Parameters
    ----------
    pair, frame: the centred clouds.
    steps: of all stages.
    """
    motion = ended.motion
    entered = frame.enter(motion)
    found = matched(pair, entered)
    information, residual = matched_information(pair, entered, frame, found)
    seen = judged_clouds(pair)
    pairs = found if _same(seen, pair) else matched(seen, entered)
    buddies = found.mutual.sum(-1)
    share = buddies / pairs.mutual.sum(-1).clamp(min=1)
    held = resistance(seen, entered, pairs, frame.scale) * share[:, None, None]
    radius = centre_and_radius(pair.Q, pair.Q_mask)[1] * frame.scale
    radius = torch.where(radius > 0, radius, 1.0)
    free = spectrum(held, radius)[2].any(-1)
    status = torch.where(ended.settled, int(Status.CONVERGED), int(Status.ITERATION_LIMIT))
    status = torch.where(free, int(Status.DEGENERATE), status)
    pulling = (found.mutual & (pair_weights(pair, found) > 0)).any(-1)
    status = torch.where(pulling, status, int(Status.NO_BUDDIES))
    finite = torch.isfinite(motion.translation).all(-1) & torch.isfinite(motion.rotation).all(-1).all(-1)
    status = torch.where(finite, status, int(Status.NON_FINITE))
    believed = torch.where(status <= int(Status.ITERATION_LIMIT), confidence(seen, entered, pairs), 0.0)
    before = ended.loss, ended.temperature, ended.gradient_norm, torch.full_like(buddies, steps)
    return Registration(motion, *before, buddies, information, status, held, residual, radius, believed)


def _same(seen: CloudPair, pair: CloudPair) -> bool:
    """Whether a pair was neither thinned nor given normals, and has no points in one place."""
    names = "P", "Q", "P_normals", "Q_normals", "P_mask", "Q_mask"
    return all(getattr(seen, name) is getattr(pair, name) for name in names)
