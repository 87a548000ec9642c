"""The registration residual: what it measures, and what the layer's answer does to it."""

import pytest
import torch
from scan_problems import in_the_world, random_batch, room_scans

from bbr_layer import Adam, BBRLayer, RigidMotion
from models import ScanBatch
from models.residual_term import RegistrationResidual, pose_residual, registered_edges


def value(batch: ScanBatch, world_from_scan: RigidMotion | None = None, rounding: float = 1e-6) -> torch.Tensor:
    pose = batch.start if world_from_scan is None else world_from_scan
    return RegistrationResidual(BBRLayer(), rounding)(in_the_world(batch), None, batch.mask, pose, batch)


def one_edge(d: int, offset: torch.Tensor) -> ScanBatch:
    """One edge, measured as it starts but moved by ``offset`` (rotation vector, translation)."""
    batch = random_batch(d, g=3)
    relative = batch.start.item(0).inverse() @ batch.start.item(1)
    motion = RigidMotion.from_rotvec(offset[:-d], offset[-d:]) @ relative
    return batch._replace(
        edges=batch.edges[:1],
        edge_weight=batch.edge_weight[:1],
        edge_measurement=RigidMotion(motion.rotation[None], motion.translation[None]),
    )


@pytest.mark.parametrize("d", [2, 3])
def test_the_residual_carries_the_answer_to_the_pose(d):
    batch = random_batch(d)
    relative, answer = batch.start, batch.start.item(torch.tensor([1, 2, 0]))
    about = torch.randn(3, d, dtype=torch.float64)
    residual = pose_residual(relative, answer, about)
    points = torch.randn(3, 5, d, dtype=torch.float64)
    turned = RigidMotion.from_rotvec(residual[:, :-d], residual[:, -d:])(answer(points) - about[:, None])
    torch.testing.assert_close(turned + about[:, None], relative(points))


@pytest.mark.parametrize("d", [2, 3])
def test_at_its_answer_it_is_zero_with_a_gradient_of_zero(d):
    batch = one_edge(d, torch.zeros(d * (d + 1) // 2, dtype=torch.float64))
    translation = batch.start.translation.clone().requires_grad_()
    answer = value(batch, batch.start._replace(translation=translation), rounding=0.1)
    answer.backward()
    assert answer.abs().item() < 1e-12
    assert translation.grad.abs().max().item() < 1e-8


@pytest.mark.parametrize("d", [2, 3])
def test_without_information_it_is_how_far_the_points_move(d):
    offset = 1e-3 * torch.randn(d * (d + 1) // 2, dtype=torch.float64)
    batch = one_edge(d, offset)
    points = batch.points[1][batch.mask[1]]
    relative = batch.start.item(0).inverse() @ batch.start.item(1)
    moved = relative(points) - batch.edge_measurement.item(0)(points)
    expected = moved.square().sum(-1).mean().sqrt()
    torch.testing.assert_close(value(batch), expected, rtol=1e-3, atol=1e-6)


def test_directions_the_registration_cannot_see_do_not_pull():
    batch = one_edge(2, torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64))
    along_y = torch.diag(torch.tensor([4.0, 0.0, 9.0], dtype=torch.float64))
    blind = value(batch._replace(edge_information=along_y[None]))
    seeing = value(batch._replace(edge_information=along_y[[0, 2, 1]][:, [0, 2, 1]][None]))
    assert blind.item() < 1e-5
    assert seeing.item() == pytest.approx(0.3 * 2**0.5, rel=1e-3)  # the mean translation weight is one half


@pytest.mark.parametrize("empty", [0.0, torch.nan])
def test_an_edge_without_information_counts_nothing(empty):
    batch = one_edge(3, torch.full((6,), 0.1, dtype=torch.float64))
    nothing = torch.full((1, 6, 6), empty, dtype=torch.float64)
    assert value(batch._replace(edge_information=nothing)).item() == 0


def test_far_from_its_answer_it_grows_like_a_length():
    near, far = (one_edge(2, torch.tensor([0.0, x, 0.0], dtype=torch.float64)) for x in (1.0, 2.0))
    assert value(far, rounding=0.1).item() / value(near, rounding=0.1).item() == pytest.approx(2, rel=0.05)


def test_without_a_measurement_the_layer_registers_and_is_not_trained():
    batch, truth = room_scans(3, 40, noise=0.05)
    points = batch.points.clone().requires_grad_()
    unmeasured = batch._replace(edge_measurement=None, points=points)
    layer = BBRLayer("F", inner=Adam(steps=60))
    target, source = batch.edges.unbind(1)
    relative = batch.start.item(target).inverse() @ batch.start.item(source)
    answer = registered_edges(layer, relative, batch.mask, unmeasured)
    assert not answer.target_from_source.translation.requires_grad
    true = truth.item(target).inverse() @ truth.item(source)
    before = (relative.translation - true.translation).norm(dim=-1).mean()
    after = (answer.target_from_source.translation - true.translation).norm(dim=-1).mean()
    assert after < 0.5 * before
    assert ((answer.trust > 0.3) & (answer.trust <= 1)).all()

    translation = batch.start.translation.clone().requires_grad_()
    term = RegistrationResidual(layer)
    pose = batch.start._replace(translation=translation)
    term(in_the_world(batch), None, batch.mask, pose, unmeasured).backward()
    assert translation.grad.abs().sum() > 0
    assert points.grad is None


def test_scans_without_buddies_are_not_trusted():
    batch = random_batch(2)
    mask = batch.mask.clone()
    mask[2] = False
    target, source = batch.edges.unbind(1)
    relative = batch.start.item(target).inverse() @ batch.start.item(source)
    answer = registered_edges(BBRLayer("F", inner=Adam(steps=3)), relative, mask, batch)
    assert answer.trust[1:].tolist() == [0.0, 0.0]
    assert answer.target_from_source.matrix.isfinite().all()


def test_a_wrong_rounding_is_refused_in_words():
    with pytest.raises(ValueError, match="rounding is 0"):
        RegistrationResidual(BBRLayer(), 0.0)
