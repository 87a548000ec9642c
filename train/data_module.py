"""The scans as Lightning reads them: groups of padded scans with their edges, drawn anew in every epoch."""

from collections.abc import Iterator
from typing import NamedTuple

import lightning as L
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer import RigidMotion, estimate_normals, point_spacing
from models import ScanBatch
from train.config import TrainingConfig
from train.groups import Group, group_edges
from train.pose_graph import Edges
from train.scans import ScanSet

# Every how many-th point is never trained on: it judges the poses (``train.alignment``).
HELD_OUT = 8


class PreparedScan(NamedTuple):
    """One scan, ready to be drawn from.

    Parameters
    ----------
    points, normals: ``(n, d)`` float32, sensor frame, in the order of the file.
    trained, held_out: rows to train on and rows to judge by.
    spacing: median distance between neighbours in a draw, in the data's unit.
    """

    points: Float[Tensor, "n d"]
    normals: Float[Tensor, "n d"]
    trained: Int[np.ndarray, " a"]
    held_out: Int[np.ndarray, " b"]
    spacing: float


class MappingData(L.LightningDataModule):
    """Every edge once per epoch, in groups of scans; what is drawn depends on the seed and the epoch alone.

    Parameters
    ----------
    scans: all scans of the run.
    edges: between them.
    world_from_scan: starting poses ``(k, ...)``.
    config: group size and points per scan.
    seed: of the draws.
    """

    def __init__(
        self, scans: ScanSet, edges: Edges, world_from_scan: RigidMotion, *, config: TrainingConfig, seed: int
    ):
        super().__init__()
        self.edges, self.start, self.seed = edges, world_from_scan.to(torch.float64), seed
        self.most_points = config.points
        self.prepared = [prepare_scan(points, config.points) for points in scans.points]
        target, source = edges.target.numpy(), edges.source.numpy()
        self.groups = group_edges(target, source, len(scans), config.group)
        blocks = np.array_split(np.arange(len(scans)), -(-len(scans) // config.group))
        self.blocks = [Group(block, np.zeros(0, dtype=np.int64)) for block in blocks]

    def train_dataloader(self) -> "Epoch":
        """The groups of the trainer's present epoch; to be asked anew in each."""
        return Epoch(self, 0 if self.trainer is None else self.trainer.current_epoch)

    def every_scan(self) -> Iterator[ScanBatch]:
        """All scans in order, without edges, each thinned the same way every time: what poses are read from."""
        return (self.batch(block, None) for block in self.blocks)

    def batch(self, group: Group, rng: np.random.Generator | None) -> ScanBatch:
        """One group, padded; its points drawn by ``rng``, or evenly spread without one."""
        scans = [self.prepared[number] for number in group.scans]
        drawn = [scan.trained[draw(len(scan.trained), self.most_points, rng)] for scan in scans]
        counts = torch.tensor([len(rows) for rows in drawn])
        points = padded([scan.points[rows] for scan, rows in zip(scans, drawn, strict=True)])
        normals = padded([scan.normals[rows] for scan, rows in zip(scans, drawn, strict=True)])
        members, chosen = torch.from_numpy(group.scans), torch.from_numpy(group.edges)
        return ScanBatch(
            points=points,
            mask=torch.arange(points.shape[1]) < counts[:, None],
            index=members,
            start=self.start.item(members),
            edges=torch.searchsorted(members, torch.stack((self.edges.target[chosen], self.edges.source[chosen]), -1)),
            edge_weight=self.edges.score[chosen].double(),
            normals=normals,
            edge_measurement=self.edges.target_from_source.item(chosen),
            edge_information=self.edges.information[chosen].double(),
            spacing=torch.tensor([scan.spacing for scan in scans], dtype=torch.float64),
        )


class Epoch:
    """The steps of one epoch, in a seeded order."""

    def __init__(self, data: MappingData, number: int):
        self.data, self.number = data, number

    def __len__(self) -> int:
        return len(self.data.groups)

    def __iter__(self) -> Iterator[ScanBatch]:
        rng = np.random.default_rng((self.data.seed, self.number))
        for number in rng.permutation(len(self.data.groups)):
            yield self.data.batch(self.data.groups[number], rng)


def prepare_scan(points: Float[np.ndarray, "n d"], most_points: int) -> PreparedScan:
    """Estimate the normals, set the held-out rows apart, and measure the spacing of ``most_points`` of the others."""
    whole, rows = torch.from_numpy(points), np.arange(len(points))
    judged = rows % HELD_OUT == HELD_OUT // 2
    trained, held_out = rows[~judged], rows[judged]
    spacing = point_spacing(whole[trained[draw(len(trained), most_points, None)]])
    return PreparedScan(whole.float(), estimate_normals(whole).float(), trained, held_out, float(spacing))


def padded(clouds: list[Float[Tensor, "_ d"]]) -> Float[Tensor, "g n d"]:
    """Clouds of different lengths in one tensor, filled up with zeros."""
    return torch.nn.utils.rnn.pad_sequence(clouds, batch_first=True)


def draw(count: int, most: int, rng: np.random.Generator | None) -> Int[np.ndarray, " n"]:
    """At most ``most`` of ``count`` row numbers, rising; evenly spread when ``rng`` is None."""
    if count <= most:
        return np.arange(count)
    if rng is None:
        return np.linspace(0, count - 1, most).round().astype(np.int64)
    return np.sort(rng.choice(count, most, replace=False))
