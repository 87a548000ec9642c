"""The mapper: poses that start where they should, losses that add up, and a small map that gets better."""

import copy
import math

import pytest
import torch
from differences import gradcheck
from scan_problems import random_batch, room_scans, with_padding
from torch import nn

from bbr_layer import RigidMotion, translation_error
from models import (
    REGISTRATION_TERMS,
    DeepMapping,
    LNet,
    MNet,
    RegistrationTerm,
    corrected_poses,
    registration_term,
    sample_free_space,
)
from models.deep_mapping import balanced_occupancy_loss


class HitsAndFree(nn.Module):
    """An occupancy network that keeps what it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[torch.Tensor] = []

    def forward(self, world_points: torch.Tensor) -> torch.Tensor:
        self.asked.append(world_points)
        return world_points.sum(-1)


class Constant(RegistrationTerm):
    """A term of 6 length units."""

    def forward(self, world_points, world_normals, mask, world_from_scan, batch):
        return torch.tensor(6.0, dtype=torch.float64)


def mapper(d: int, term: str = "chamfer", awake: bool = False, **settings) -> DeepMapping:
    localisation = LNet(d)
    if awake:
        nn.init.normal_(localisation.head[-1].weight, std=0.1)
        nn.init.normal_(localisation.head[-1].bias)
    return DeepMapping(localisation, MNet(d), registration_term(term), **settings).double()


def with_measurements(batch):
    target, source = batch.edges.unbind(1)
    measured = batch.start.item(target).inverse() @ batch.start.item(source)
    return batch._replace(edge_measurement=measured)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("term", REGISTRATION_TERMS)
def test_the_first_poses_are_the_starting_poses_to_the_last_bit(term, d):
    batch = with_measurements(random_batch(d))
    output = mapper(d, term)(batch)
    assert torch.equal(output.world_from_scan.rotation, batch.start.rotation)
    assert torch.equal(output.world_from_scan.translation, batch.start.translation)
    expected = torch.where(batch.mask[..., None], batch.start(batch.points), 0.0)
    assert torch.equal(output.world_points, expected)
    assert set(output.losses) == {"occupancy", "registration", "total"}
    assert all(loss.shape == () and loss.isfinite() for loss in output.losses.values())


@pytest.mark.parametrize("d", [2, 3])
def test_the_first_scan_of_all_is_the_anchor_wherever_it_stands(d):
    batch = random_batch(d)._replace(index=torch.tensor([4, 0, 7]))
    poses = mapper(d, awake=True)(batch).world_from_scan
    assert torch.equal(poses.matrix[1], batch.start.matrix[1])
    assert not torch.allclose(poses.matrix[0], batch.start.matrix[0])
    assert not torch.allclose(poses.matrix[2], batch.start.matrix[2])


@pytest.mark.parametrize("d", [2, 3])
def test_a_correction_turns_first_and_shifts_apart_from_it(d):
    batch = random_batch(d)
    k = d * (d + 1) // 2
    correction = 0.3 * torch.randn(3, k, dtype=torch.float64)
    poses = corrected_poses(batch, correction, 2.0)
    for scan in (1, 2):
        generator = torch.zeros(d, d, dtype=torch.float64)
        if d == 2:
            generator[1, 0] = correction[scan, 0]
        else:
            x, y, z = correction[scan, :3]
            generator[1, 0], generator[2, 1], generator[0, 2] = z, x, y
        turn = torch.linalg.matrix_exp(generator - generator.mT)
        torch.testing.assert_close(poses.rotation[scan], turn @ batch.start.rotation[scan])
        shifted = batch.start.translation[scan] + 2.0 * correction[scan, -d:]
        torch.testing.assert_close(poses.translation[scan], shifted)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_the_gradient_of_the_poses_in_the_correction(size, d):
    batch = random_batch(d)
    correction = (size * torch.randn(3, d * (d + 1) // 2, dtype=torch.float64)).requires_grad_()
    assert gradcheck(lambda x: corrected_poses(batch, x, 0.7).matrix, (correction,))


def test_rays_begin_at_the_corrected_sensor():
    batch = random_batch(2)
    asked = HitsAndFree()
    model = mapper(2, awake=True, free_samples=4)
    model.occupancy = asked
    output = model(batch, torch.Generator().manual_seed(3))
    clean = batch.without_padding()
    free = sample_free_space(clean.points, batch.mask, 4, torch.Generator().manual_seed(3))
    torch.testing.assert_close(asked.asked[0], output.world_points)
    torch.testing.assert_close(asked.asked[1], output.world_from_scan(free))


def test_hits_and_free_space_weigh_the_same():
    mask = torch.tensor([[True, True, False], [True, False, False]])
    hits, free = torch.randn(2, 3).double(), torch.randn(2, 6).double()
    hit_losses, free_losses = [], []
    for scan in range(2):
        for ray in range(3):
            if mask[scan, ray]:
                hit_losses.append(-math.log(torch.sigmoid(hits[scan, ray])))
                for sample in range(2):
                    free_losses.append(-math.log(1 - torch.sigmoid(free[scan, 2 * ray + sample])))
    expected = (sum(hit_losses) / len(hit_losses) + sum(free_losses) / len(free_losses)) / 2
    assert balanced_occupancy_loss(hits, free, mask).item() == pytest.approx(expected)
    assert balanced_occupancy_loss(hits, free, torch.zeros_like(mask)).item() == 0


def test_the_total_is_the_weighted_sum_with_lengths_in_translation_scales():
    model = mapper(2, occupancy_weight=0.25, registration_weight=2.0, translation_scale=3.0)
    model.registration_term = Constant()
    losses = model(random_batch(2)).losses
    assert losses["registration"].item() == 2.0
    assert losses["total"].item() == pytest.approx(0.25 * losses["occupancy"].item() + 4.0)


@pytest.mark.parametrize("term", REGISTRATION_TERMS)
def test_what_padding_holds_never_matters(term):
    batch = with_measurements(random_batch(2, n=20))
    batch = batch._replace(normals=nn.functional.normalize(torch.randn_like(batch.points), dim=-1))
    model = mapper(2, term, awake=True)

    def run(filling: float) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
        model.zero_grad()
        losses = model(with_padding(batch, 2, filling), torch.Generator().manual_seed(0)).losses
        losses["total"].backward()
        return losses, [p.grad.clone() for p in model.parameters()]

    zeros, holes = run(0.0), run(torch.nan)
    torch.testing.assert_close(holes, zeros, rtol=0, atol=0)


def test_a_generator_repeats_the_losses():
    model, batch = mapper(3), random_batch(3)
    first, second = (model(batch, torch.Generator().manual_seed(1)).losses["total"] for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, model(batch, torch.Generator().manual_seed(2)).losses["total"])


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_mapper_works_without_a_graph_and_as_a_copy(mode):
    model, batch = copy.deepcopy(mapper(2, "buddy")), random_batch(2)
    with mode():
        output = model(batch)
    assert not output.losses["total"].requires_grad
    assert output.losses["total"].isfinite()


def test_progress_reaches_the_term():
    model = mapper(2, "buddy")
    model.set_progress(0.75)
    assert model.registration_term.progress == 0.75


@pytest.mark.parametrize("term", ["residual", "buddy"])
def test_a_hundred_steps_bring_the_scans_home(term):
    batch, truth = room_scans(6, 60, noise=0.1)
    occupancy = MNet(2)
    occupancy.fit_bounds(batch.start(batch.points), batch.mask)
    localisation = LNet(2, "ordered", scale=4.0)
    model = DeepMapping(localisation, occupancy, registration_term(term), translation_scale=0.3)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)

    def error(world_from_scan: RigidMotion) -> torch.Tensor:
        return translation_error(world_from_scan.translation, truth.translation).mean()

    for step in range(100):
        model.set_progress(step / 100)
        optimiser.zero_grad()
        model(batch).losses["total"].backward()
        optimiser.step()
    after = model(batch)
    assert error(after.world_from_scan) < 0.25 * error(batch.start)
    assert after.losses["occupancy"] < 0.1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"free_samples": 0}, "free_samples is 0"),
        ({"occupancy_weight": -0.1}, "occupancy_weight is -0.1"),
        ({"registration_weight": math.nan}, "registration_weight is nan"),
        ({"translation_scale": 0.0}, "translation_scale is 0.0"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings, words):
    with pytest.raises(ValueError, match=words):
        mapper(2, **settings)
