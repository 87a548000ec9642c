"""Free poses: zero at first, each scan its own correction, rotations in their own unit."""

import pytest
import torch
from scan_problems import random_batch

from models import DeepMapping, FreePoses, MNet, registration_term


@pytest.mark.parametrize("d", [2, 3])
def test_each_scan_has_its_own_row_wherever_it_stands_in_the_batch(d):
    free = FreePoses(9, d, turn=0.5)
    with torch.no_grad():
        free.table += torch.arange(9.0)[:, None]
    found = free.corrections(random_batch(d)._replace(index=torch.tensor([4, 0, 7])))
    rotations = d * (d - 1) // 2
    assert found.shape == (3, d * (d + 1) // 2)
    assert found[:, :rotations].eq(torch.tensor([2.0, 0.0, 3.5])[:, None]).all()
    assert found[:, rotations:].eq(torch.tensor([4.0, 0.0, 7.0])[:, None]).all()


@pytest.mark.parametrize("d", [2, 3])
def test_a_mapper_begins_at_its_starting_poses_and_only_its_scans_learn(d):
    batch = random_batch(d)._replace(index=torch.tensor([4, 0, 7]))
    free = FreePoses(9, d)
    model = DeepMapping(free, MNet(d), registration_term("chamfer")).double()
    output = model(batch)
    assert torch.equal(output.world_from_scan.matrix, batch.start.matrix)
    output.losses["total"].backward()
    assert free.table.grad.abs().sum(1).nonzero()[:, 0].tolist() == [4, 7]  # 0 is the anchor


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"count": 0}, "count is 0"), ({"dimension": 4}, "dimension is 4"), ({"turn": 0.0}, "turn is 0.0")],
)
def test_wrong_settings_are_refused_in_words(settings, words):
    with pytest.raises(ValueError, match=words):
        FreePoses(**({"count": 3, "dimension": 2} | settings))
