"""Registrations, easy and hopeless ones, whose right answer is known: what the confidence is fitted to and judged by.

Every trial is two samples of one shape, or of two overlapping scans, the source turned by a random axis and moved by
up to a tenth of its radius. The groups share no data, so that a group can be left out of the fit.
"""

import math
from collections.abc import Iterator
from functools import cache
from itertools import product
from typing import NamedTuple
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from bbr_layer import RigidMotion, estimate_normals
from benchmarks.data import data_folder, model

MODELS = {"bunny": "bun_zipper", "horse": "horse", "dragon": "dragon_vrip_res3"}
# Own: samples without a common point, normals of each; shared: both with the whole cloud's normals, as the paper has
# it; distractor: a third of each cloud lies somewhere else; part: each lacks a third, on opposite sides.
SAMPLINGS = ("own", "shared", "distractor", "part")
ANGLES_DEG = (5.0, 10.0, 30.0, 60.0, 90.0, 120.0)
PAPER_NEIGHBOURS = 13
# Sequences of scans: group, file, (target, source) numbers, points of each.
SEQUENCES = (
    ("range", "seq_stanford_bunny", ((0, 1), (0, 2), (1, 2), (3, 4)), (200, 500, 1000)),
    ("range", "seq_stanford_dragon", ((0, 1), (0, 2), (3, 4), (5, 7)), (200, 500, 1000)),
    ("lidar", "seq_kitti00_0-15", ((0, 1), (2, 6), (5, 13)), (500, 1000)),
    ("lidar", "seq_balm_realworld_30-108", ((0, 1), (10, 12), (20, 24)), (500, 1000)),
    ("indoor", "seq_3dmatch_kitchen_0_1_4_5", ((0, 1), (2, 3)), (500, 1000)),
    ("indoor", "seq_iclnuim_livingroom_0-120", ((0, 1), (2, 5), (4, 8)), (500, 1000)),
    ("indoor", "seq_tum_fr1_desk_5", ((0, 1), (1, 2), (0, 3)), (500, 1000)),
    ("2D", "seq_deepmapping2d_v1_pose0", ((0, 1), (20, 24), (60, 68), (100, 116), (150, 151), (200, 206)), (100, 256)),
)
PAIRS = (
    ("lidar", "pair_kitti00_95_94"),
    ("lidar", "pair_libpointmatcher_car401_400"),
    ("indoor", "pair_3dmatch_hotel3_15_8"),
    ("indoor", "pair_3dmatch_geotransformer_demo"),
)
# Points of the clouds of which only some are judged: three times as many as those.
LARGE = 6000


class Trial(NamedTuple):
    """One pair of clouds, by what it is drawn from."""

    group: str
    source: str
    sampling: str
    points: int
    degrees: float
    seed: int

    @property
    def name(self) -> str:
        """Unlike any other trial's."""
        return f"{self.source} {self.sampling} {self.points} {self.degrees:g} {self.seed}"


class Clouds(NamedTuple):
    """Target, source and the motion that is sought; normals where they are given."""

    P: Tensor
    Q: Tensor
    truth: RigidMotion
    P_normals: Tensor | None
    Q_normals: Tensor | None


def trials(seeds: int) -> Iterator[Trial]:
    """All of them, ``seeds`` draws of each kind."""
    for name, sampling, degrees, seed in product(MODELS, SAMPLINGS, ANGLES_DEG, range(seeds)):
        yield Trial(name, name, sampling, (500, 200, 500, 1000)[seed % 4], degrees, seed)
    for group, name, numbers, counts in SEQUENCES:
        for (first, second), degrees, seed in product(numbers, ANGLES_DEG[::2] + ANGLES_DEG[-1:], range(seeds)):
            sampling = ("own", "shared")[seed % 2]
            yield Trial(group, f"{name} {first} {second}", sampling, counts[seed % len(counts)], degrees, seed)
    for (group, name), degrees, seed in product(PAIRS, ANGLES_DEG, range(seeds)):
        yield Trial(group, name, ("own", "shared")[seed % 2], (500, 1000)[seed % 2], degrees, seed)
    for name, sampling, degrees in product(MODELS, SAMPLINGS[::2], ANGLES_DEG):
        yield Trial(name, name, sampling, LARGE, degrees, 0)
    for (group, name), degrees in product(PAIRS, ANGLES_DEG):
        yield Trial(group, name, "own", LARGE, degrees, 0)


def clouds(trial: Trial) -> Clouds:
    """The two samples, the source turned; float64."""
    generator = torch.Generator().manual_seed(crc32(trial.name.encode()))  # unlike any other trial's draw
    target, source, aligned = _whole(trial.source)
    P, Q, P_rows, Q_rows = _samples(trial, target, source, generator)
    placed = aligned(Q)
    turn = turned(trial.degrees, placed, generator)
    truth = turn.inverse()
    normals = None, None
    if trial.sampling == "shared":
        cloud_normals = _normals(trial.source)
        normals = cloud_normals[0][P_rows], truth.inverse().rotate(aligned.rotate(cloud_normals[1][Q_rows]))
    return Clouds(P, truth.inverse()(placed), truth, *normals)


@cache
def _whole(source: str) -> tuple[Tensor, Tensor, RigidMotion]:
    """Target, source, and the motion that lays one on the other."""
    if source in MODELS:
        cloud = model(MODELS[source])
        return cloud, cloud, RigidMotion.identity(3)
    file, *numbers = source.split()
    arrays = np.load(data_folder() / f"{file}.npz")
    if not numbers:
        return _tensor(arrays["tgt"]), _tensor(arrays["src"]), RigidMotion.from_matrix(_tensor(arrays["T"]))
    offsets, d = arrays["offsets"], 2 if "2d" in file else 3
    scans = [_tensor(arrays["points"][offsets[i] : offsets[i + 1], :d]) for i in map(int, numbers)]
    kept = [*range(d), 3]
    poses = [RigidMotion.from_matrix(_tensor(arrays["poses"][int(i)][np.ix_(kept, kept)])) for i in numbers]
    return scans[0], scans[1], poses[0].inverse() @ poses[1]


@cache
def _normals(source: str) -> tuple[Tensor, Tensor]:
    target, moved, _ = _whole(source)
    return estimate_normals(target, PAPER_NEIGHBOURS), estimate_normals(moved, PAPER_NEIGHBOURS)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).double()


def _samples(
    trial: Trial, target: Tensor, source: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Both samples and the rows they come from."""
    n = trial.points
    P_rows = torch.randperm(len(target), generator=generator)
    Q_rows = torch.randperm(len(source), generator=generator)
    if trial.group in MODELS and trial.sampling != "shared":
        Q_rows = P_rows.flip(0)
    if trial.sampling == "part":
        axis = torch.randn(3, generator=generator, dtype=torch.float64)
        height = target @ axis
        low, high = height.quantile(1 / 3), height.quantile(2 / 3)
        P_rows, Q_rows = P_rows[height[P_rows] > low], Q_rows[height[Q_rows] < high]
    P_rows, Q_rows = P_rows[:n], Q_rows[:n]
    P, Q = target[P_rows], source[Q_rows]
    if trial.sampling == "distractor":
        P, Q = (_with_distractor(points, generator) for points in (P, Q))
    return P, Q, P_rows, Q_rows


def _with_distractor(points: Tensor, generator: torch.Generator) -> Tensor:
    """A third of the points is a smaller, turned copy of the shape beside it."""
    count = len(points) // 3
    copy = turned(90.0, points, generator)(points)[:count]
    radius = (points - points.mean(0)).norm(dim=1).square().mean().sqrt()
    aside = torch.randn(3, generator=generator, dtype=torch.float64)
    copy = (copy - copy.mean(0)) / 2 + points.mean(0) + 1.5 * radius * aside / aside.norm()
    return torch.cat((points[count:], copy))


def turned(degrees: float, points: Tensor, generator: torch.Generator) -> RigidMotion:
    """A turn about the centroid and a shift by up to a tenth of the radius."""
    d, centre = points.shape[1], points.mean(0)
    axis = torch.randn(1 if d == 2 else 3, generator=generator, dtype=torch.float64)
    rotation = RigidMotion.from_rotvec(axis / axis.norm() * math.radians(degrees), torch.zeros(d).double()).rotation
    radius = (points - centre).square().sum(1).mean().sqrt()
    shift = (2 * torch.rand(d, generator=generator, dtype=torch.float64) - 1) / 10 * radius / math.sqrt(d)
    return RigidMotion(rotation, centre + shift - rotation @ centre)
