"""How far apart two motions put a scan, from its mean and covariance: as point by point."""

import numpy as np
import pytest
import torch

from bbr_layer import RigidMotion
from train.prepared import prepare
from train.scans import ScanSet
from train.scene import apart, build_scene


@pytest.mark.parametrize("d", [2, 3])
def test_motions_are_as_far_apart_as_the_points_they_carry(d):
    random, k = np.random.default_rng(0), d * (d - 1) // 2
    clouds = [random.normal(size=(50 + scan, d)) + 3.0 for scan in range(4)]
    scans = ScanSet(clouds, [str(i) for i in range(4)], np.arange(4.0))
    scene = build_scene(scans, prepare(scans, 100))
    source = torch.tensor([0, 3, 3, 1, 2])
    one, other = (
        RigidMotion.from_rotvec(
            torch.from_numpy(random.normal(size=(5, k))), torch.from_numpy(random.normal(size=(5, d)))
        )
        for _ in range(2)
    )
    one.rotation[4], one.translation[4] = other.rotation[4], other.translation[4]
    found = apart(scene, source, one, other)
    for edge, scan in enumerate(source.tolist()):
        points = torch.from_numpy(scene.surfaces[scan].points)
        moves = one.item(edge)(points) - other.item(edge)(points)
        torch.testing.assert_close(found[edge], moves.square().sum(-1).mean().sqrt())
    assert found[4] == 0
    assert apart(scene, source[:0], one.item(slice(0, 0)), other.item(slice(0, 0))).shape == (0,)
