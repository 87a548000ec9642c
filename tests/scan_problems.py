"""Small groups of scans with known poses, for the tests of the mapper."""

import math

import torch

from bbr_layer import RigidMotion
from models import ScanBatch

EDGES = [(0, 1), (1, 2), (0, 2)]
HALF_ROOM = (4.0, 3.0)  # metres
METRES_PER_RADIAN = 4.0


def random_batch(d: int, g: int = 3, n: int = 12, dtype: torch.dtype = torch.float64) -> ScanBatch:
    """Scans that overlap roughly, with holes in the mask; every optional field but spacing is None."""
    world = torch.randn(n, d, dtype=dtype)
    rotvec = 0.2 * torch.randn(g, d * (d - 1) // 2, dtype=torch.float64)
    start = RigidMotion.from_rotvec(rotvec, 0.3 * torch.randn(g, d, dtype=torch.float64))
    noise = 0.05 * torch.randn(g, n, d, dtype=dtype)
    points = start.inverse()(world.expand(g, n, d)) + noise
    mask = torch.ones(g, n, dtype=torch.bool)
    mask[0, -2:], mask[2, -4:] = False, False
    return ScanBatch(
        points=points,
        mask=mask,
        index=torch.arange(g),
        start=start,
        edges=torch.tensor(EDGES),
        edge_weight=torch.tensor([1.0, 0.5, 2.0], dtype=dtype),
        spacing=torch.full((g,), 0.4, dtype=torch.float64),
    )


def in_the_world(batch: ScanBatch) -> torch.Tensor:
    """The scans at their starting poses, 0 where padded."""
    return torch.where(batch.mask[..., None], batch.start(batch.points), 0.0)


def with_padding(batch: ScanBatch, extra: int, filling: float) -> ScanBatch:
    """The same scans with ``extra`` more padded points; all padding, old and new, holds ``filling``."""
    g, n, d = batch.points.shape
    real = torch.cat((batch.mask, torch.zeros(g, extra, dtype=torch.bool)), 1)

    def padded(values: torch.Tensor | None) -> torch.Tensor | None:
        if values is None:
            return None
        longer = torch.cat((values, values.new_zeros(g, extra, d)), 1)
        return torch.where(real[..., None], longer, filling)

    return batch._replace(points=padded(batch.points), normals=padded(batch.normals), mask=real)


def room_scans(g: int, n: int, noise: float = 0.0) -> tuple[ScanBatch, RigidMotion]:
    """2D scans of a rectangular room from along a curve: a batch that starts off the truth, and the truth.

    Rays are n equal angles in order; starting poses are off by normal noise of ``noise`` metres, and of a
    quarter as many radians; the measured edges are the true relative poses.
    """
    along = torch.linspace(0.0, 1.0, g, dtype=torch.float64)
    heading = 1.5 * along[:, None]
    places = torch.stack((3 * along - 1.5, 1 - 2 * along.square()), -1)
    room_from_scan = RigidMotion.from_rotvec(heading, places)
    angles = heading + (torch.arange(n, dtype=torch.float64) + 0.5) * (2 * math.pi / n)
    directions = torch.stack((angles.cos(), angles.sin()), -1)
    reach = (directions.sign() * torch.tensor(HALF_ROOM) - places[:, None]) / directions
    hits = places[:, None] + reach.amin(-1, keepdim=True) * directions
    truth = room_from_scan.item(torch.zeros(g, dtype=torch.int64)).inverse() @ room_from_scan
    offsets = noise * torch.randn(g, 3, dtype=torch.float64)
    offsets[0] = 0
    turn = RigidMotion.from_rotvec(offsets[:, :1] / METRES_PER_RADIAN, torch.zeros(g, 2, dtype=torch.float64))
    edges = torch.tensor([(i, i + k) for i in range(g) for k in (1, 2) if i + k < g])
    target, source = edges.unbind(1)
    batch = ScanBatch(
        points=room_from_scan.inverse()(hits).float(),
        mask=torch.ones(g, n, dtype=torch.bool),
        index=torch.arange(g),
        start=RigidMotion(turn.rotation @ truth.rotation, truth.translation + offsets[:, 1:]),
        edges=edges,
        edge_weight=torch.ones(len(edges)),
        edge_measurement=truth.item(target).inverse() @ truth.item(source),
    )
    return batch._replace(spacing=batch.known_spacing()), truth
