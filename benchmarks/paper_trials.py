"""The trials of the paper's experiments: two clouds, their normals where they are given, and the motion between them.

Two ways to sample. ``shared``: both clouds are drawn from the same points and come with normals of the full cloud, as
in the paper. ``disjoint``: the two clouds share no point and come without normals. Two scans never share a point; there
``shared`` gives the normals of the full scans. Everything is float64, and made from a seed alone.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer import RigidMotion, angular_error, estimate_normals

SAMPLINGS = ("shared", "disjoint")
PAPER_NEIGHBOURS = 13  # of a normal in a full model or scan (paper, 4.1)
LIDAR_NEIGHBOURS = 94  # the same for lidar (paper, 4.5)
# Metres that stand for the spacing of a lidar scan, whose own is a centimetre near the sensor and a metre far from it:
# one of the three pairs has a median of 1 cm, and a peer that looks 20 of those far does not see a start 1 m off.
LIDAR_UNIT = 0.1


class Surface(NamedTuple):
    """A full cloud ``(n, 3)`` and its normals."""

    points: Tensor
    normals: Tensor

    @staticmethod
    def of(points: Tensor, neighbours: int = PAPER_NEIGHBOURS) -> "Surface":
        """With normals estimated from all points."""
        return Surface(points, estimate_normals(points, neighbours))

    def at(self, index: Tensor) -> "Surface":
        """Some of the points."""
        return Surface(self.points[index], self.normals[index])

    def moved_by(self, motion: RigidMotion) -> "Surface":
        """Carried by a motion."""
        return Surface(motion(self.points), motion.rotate(self.normals))

    def with_another(self, other: "Surface") -> "Surface":
        """Both as one cloud."""
        return Surface(torch.cat((self.points, other.points)), torch.cat((self.normals, other.normals)))


class Trial(NamedTuple):
    """Target, source and the motion sought.

    Parameters
    ----------
    P_normals, Q_normals: None where each method has to find its own.
    unit: what the peers' distances are multiples of; None is the point spacing.
    """

    P: Tensor
    Q: Tensor
    truth: RigidMotion
    P_normals: Tensor | None
    Q_normals: Tensor | None
    unit: float | None = None

    def first(self, count: int) -> "Trial":
        """The first points of each cloud, which are as random as all."""
        P, Q, P_normals, Q_normals = (None if x is None else x[:count] for x in (self.P, self.Q, *self[3:5]))
        assert P is not None and Q is not None
        return Trial(P, Q, self.truth, P_normals, Q_normals, self.unit)

    def errors(self, found: RigidMotion) -> tuple[float, float]:
        """Degrees between the rotations, and how far from its place the source's centroid ends, in data units."""
        degrees = math.degrees(angular_error(found.rotation.double(), self.truth.rotation).item())
        centre = self.Q.mean(0, keepdim=True)
        apart = (self.truth(centre) - found(centre)).norm().item()
        return degrees, apart


Make = Callable[[int], Trial]


def random_direction(generator: torch.Generator) -> Tensor:
    """A unit vector ``(3,)``, all directions alike."""
    vector = torch.randn(3, generator=generator, dtype=torch.float64)
    return vector / vector.norm()


def random_motion(generator: torch.Generator, degrees: tuple[float, float], shift: float, about: Tensor) -> RigidMotion:
    """A turn about a random axis through ``about`` by an evenly drawn angle, then a shift of a random direction."""
    share = torch.rand(1, generator=generator, dtype=torch.float64)
    angle = torch.deg2rad(degrees[0] + (degrees[1] - degrees[0]) * share)
    turn = RigidMotion.from_rotvec(random_direction(generator) * angle, torch.zeros(3, dtype=torch.float64))
    carried = about - turn.rotation @ about + shift * random_direction(generator)
    return RigidMotion(turn.rotation, carried)


def two_samples(surface: Surface, counts: int, sampling: str, generator: torch.Generator) -> tuple[Surface, Surface]:
    """Two random subsets of ``counts`` points each; disjoint ones share none."""
    if sampling == "disjoint":
        first, second = torch.randperm(len(surface.points), generator=generator)[: 2 * counts].split(counts)
    else:
        first, second = (torch.randperm(len(surface.points), generator=generator)[:counts] for _ in range(2))
    return surface.at(first), surface.at(second)


def trial(target: Surface, source: Surface, truth: RigidMotion, sampling: str) -> Trial:
    """With the full clouds' normals where the sampling is shared."""
    given = (target.normals, source.normals) if sampling == "shared" else (None, None)
    return Trial(target.points, source.points, truth, *given)


def model_trial(surface: Surface, count: int, degrees: float, shift: float, sampling: str) -> Make:
    """Figs. 2 and 3: two samples of one model, the target turned about a random axis and shifted."""

    def make(seed: int) -> Trial:
        generator = torch.Generator().manual_seed(seed)
        target, source = two_samples(surface, count, sampling, generator)
        truth = random_motion(generator, (degrees, degrees), shift, torch.zeros(3, dtype=torch.float64))
        return trial(target.moved_by(truth), source, truth, sampling)

    return make


def scans_trial(
    scans: tuple[Surface, Surface], count: int, degrees: tuple[float, float], shift: float, sampling: str
) -> Make:
    """Figs. 4, 6 and 7: samples of two scans in one frame, the source turned about its centroid and shifted."""

    def make(seed: int) -> Trial:
        generator = torch.Generator().manual_seed(seed)
        target, source = (x.at(torch.randperm(len(x.points), generator=generator)[:count]) for x in scans)
        off = random_motion(generator, degrees, shift, source.points.mean(0))
        return trial(target, source.moved_by(off), off.inverse(), sampling)

    return make


class Distractor(NamedTuple):
    """The second, smaller object of Fig. 5."""

    size: float  # of the main object
    beside: float  # how far its centre is from the main object's, in the main object's longest sides
    degrees: float  # its own turn between the clouds, about its own centroid
    shift: float  # its own way, in data units


def distracted_trial(main: Surface, counts: tuple[int, int], other: Distractor, sampling: str) -> Make:
    """Fig. 5: a model of ``counts[0]`` points and beside it its small copy of ``counts[1]`` that moves otherwise."""
    centre = main.points.mean(0)
    length = (main.points.amax(0) - main.points.amin(0)).max()
    place = centre + other.beside * length * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    small = Surface((main.points - centre) * other.size + place, main.normals)

    def make(seed: int) -> Trial:
        generator = torch.Generator().manual_seed(seed)
        target, source = two_samples(main, counts[0], sampling, generator)
        small_target, small_source = two_samples(small, counts[1], sampling, generator)
        truth = random_motion(generator, (10.0, 10.0), 0.005, torch.zeros(3, dtype=torch.float64))
        own = random_motion(generator, (other.degrees, other.degrees), other.shift, place)
        both = target.moved_by(truth).with_another(small_target.moved_by(own))
        return trial(both, source.with_another(small_source), truth, sampling)

    return make


def lidar_trial(scans: tuple[Surface, Surface], truth: RigidMotion, count: int, off: float, sampling: str) -> Make:
    """Tables 1 and 2: two scans thinned to ``count``, begun up to ``off`` degrees and units off about every axis."""

    def make(seed: int) -> Trial:
        generator = torch.Generator().manual_seed(seed)
        target, source = (x.at(torch.randperm(len(x.points), generator=generator)[:count]) for x in scans)
        turn, way = (2 * torch.rand(2, 3, generator=generator, dtype=torch.float64) - 1) * off
        start = RigidMotion.from_rotvec(torch.deg2rad(turn), way) @ truth
        return trial(target, source.moved_by(start), truth @ start.inverse(), sampling)._replace(unit=LIDAR_UNIT)

    return make
