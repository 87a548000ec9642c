"""The mapper under Lightning: where it starts, what a step depends on, which network learns when."""

import lightning as L
import numpy as np
import pytest
import torch
from small_worlds import SCANS, displaced, small_config, small_world, true_edges, true_poses

from train.config import TERMS
from train.data_module import Epoch, MappingData
from train.mapping_module import build_module


def problem(dimension=2, metres=0.0, seed=0, **training):
    scans, config = small_world(dimension), small_config(**training).training
    start = displaced(true_poses(scans), metres)
    data = MappingData(scans, true_edges(scans), start, config=config, seed=seed)
    return data, build_module(data, config, seed=seed)


def trainer(**settings):
    return L.Trainer(
        accelerator="cpu",
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        reload_dataloaders_every_n_epochs=1,
        **settings,
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", ["small", "paper"])
def test_the_first_poses_are_the_starting_poses(dimension, size):
    data, module = problem(dimension, metres=0.3, size=size)
    poses = module.poses(data.every_scan())
    assert poses.translation.shape == (SCANS, dimension)
    assert torch.equal(poses.matrix, data.start.matrix)


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_every_term_trains_and_leaves_the_anchor(dimension, term):
    data, module = problem(dimension, metres=0.05, term=term, warm_up=0, settle=0, occupancy_weight=1.0)
    trainer(fast_dev_run=True).fit(module, data)
    poses = module.poses(data.every_scan())
    assert poses.matrix.isfinite().all()
    assert torch.equal(poses.matrix[0], data.start.matrix[0])
    assert not torch.equal(poses.matrix[1:], data.start.matrix[1:])


def test_the_registration_term_brings_poses_closer():
    data, module = problem(metres=0.1, term="residual", epochs=40, warm_up=0, settle=0)
    before = data.start.translation - true_poses(small_world()).translation
    trainer(max_epochs=40).fit(module, data)
    after = module.poses(data.every_scan()).translation - true_poses(small_world()).translation
    assert after.norm() < 0.7 * before.norm()


def test_a_step_depends_on_seed_epoch_and_number_alone():
    data, module = problem()
    batch = next(iter(Epoch(data, 0)))
    module.log = lambda *_, **__: None
    first, other_step = module.training_step(batch, 0), module.training_step(batch, 1)
    torch.manual_seed(99)
    assert torch.equal(module.training_step(batch, 0), first)
    assert not torch.equal(other_step, first)


def test_the_first_weights_come_from_the_seed_and_leave_torch_alone():
    data, module = problem(seed=1)
    state = torch.get_rng_state()
    build_module(data, small_config().training, seed=1)
    assert torch.equal(torch.get_rng_state(), state)
    weights = [m.model.occupancy.layers[0].weight for m in (module, problem(seed=1)[1], problem(seed=2)[1])]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


def test_warm_up_moves_no_pose_and_teaches_the_map():
    data, module = problem(metres=0.1, warm_up=1.0, settle=0)
    weight = module.model.occupancy.layers[0].weight.detach().clone()
    trainer(max_epochs=2).fit(module, data)
    assert torch.equal(module.poses(data.every_scan()).matrix, data.start.matrix)
    assert not torch.equal(module.model.occupancy.layers[0].weight, weight)


def test_the_map_is_occupied_where_scans_ended_and_free_before():
    data, module = problem(epochs=60, warm_up=1.0, settle=0)
    trainer(max_epochs=60).fit(module, data)
    scan, pose = small_world().points[3], small_world().truth[3]
    hits, free = (share * scan @ pose[:2, :2].T + pose[:2, 2] for share in (1.0, 0.5))
    assert np.mean(module.occupied(hits) > 0.5) > 0.9
    assert np.mean(module.occupied(free) > 0.5) < 0.1
    assert module.occupied(np.zeros((0, 2))).shape == (0,)
