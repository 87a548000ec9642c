"""M-Net: shapes, its features literally, its frame, and that it learns a wall in seconds."""

import math

import pytest
import torch
import torch.nn.functional as F
from differences import gradcheck
from torch import nn

from models import MNet


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_one_logit_per_place(d, batch):
    places = torch.randn(*batch, 5, d)
    net = MNet(d)
    logits = net(places)
    assert logits.shape == (*batch, 5)
    assert logits.dtype == torch.float32
    alone = torch.stack([net(place[None])[0] for place in places.reshape(-1, d)])
    torch.testing.assert_close(logits.reshape(-1), alone)


@pytest.mark.parametrize("d", [2, 3])
def test_features_are_waves_of_octave_lengths(d):
    net = MNet(d, levels=3, directions=2).double()
    places = torch.randn(4, d, dtype=torch.float64)
    features = torch.zeros(4, d + 12, dtype=torch.float64)
    for i in range(4):
        features[i, :d] = places[i]
        for wave in range(6):
            frequency = net.frequencies[:, wave]
            # A wave of level l has length 2 / 2^l.
            assert frequency.norm().item() == pytest.approx(2 * math.pi / (2 / 2 ** (wave // 2)), rel=1e-6)
            angle = sum(places[i, k] * frequency[k] for k in range(d))
            features[i, d + wave], features[i, d + 6 + wave] = angle.sin(), angle.cos()
    torch.testing.assert_close(net(places), net.layers(features)[..., 0])


def test_the_gradient_in_the_places():
    net = MNet(2, widths=(8,), levels=2, directions=2).double()
    places = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    assert gradcheck(net, (places,))


def test_bounds_are_the_box_of_the_real_points():
    net = MNet(2)
    points = torch.tensor([[[0.0, 0.0], [4.0, 2.0]], [[2.0, -2.0], [torch.nan, 99.0]]])
    net.fit_bounds(points, torch.tensor([[True, True], [True, False]]))
    assert net.centre.tolist() == [2.0, 0.0]
    assert net.scale.item() == 2.0
    net.fit_bounds(torch.ones(1, 3, 2))
    assert net.scale.item() == 1.0  # a map of one place has no extent to divide by
    with pytest.raises(ValueError, match="holds no real point"):
        net.fit_bounds(points, torch.zeros(2, 2, dtype=torch.bool))


def test_unit_and_origin_of_the_map_do_not_matter():
    points = torch.rand(50, 3, dtype=torch.float64)
    net = MNet(3)
    net.fit_bounds(points)
    here = net(points)
    net.fit_bounds(1000 * points + 1e6)
    torch.testing.assert_close(net(1000 * points + 1e6), here, rtol=0, atol=1e-4)


def test_the_map_survives_saving():
    net, other = MNet(2), MNet(2)
    net.fit_bounds(7 * torch.rand(9, 2) + 3)
    other.load_state_dict(net.state_dict())
    places = torch.rand(5, 2)
    assert torch.equal(net(places), other(places))


def test_a_circle_is_learned_in_a_hundred_steps():
    angle = torch.rand(500) * 2 * math.pi
    wall = torch.stack((angle.cos(), angle.sin()), -1)
    free = wall * torch.rand(500, 1) * 0.9
    net = MNet(2)
    net.fit_bounds(wall)
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(100):
        optimiser.zero_grad()
        (F.softplus(-net(wall)).mean() + F.softplus(net(free)).mean()).backward()
        optimiser.step()
    assert (net(wall) > 0).float().mean() > 0.95
    assert (net(free) < 0).float().mean() > 0.95


def test_the_papers_perceptron():
    linear = [layer for layer in MNet.paper(2).layers if isinstance(layer, nn.Linear)]
    assert [layer.in_features for layer in linear] == [2, 64, 512, 512, 256, 128]
    assert linear[-1].out_features == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"dimension": 1}, "dimension is 1"),
        ({"levels": -1}, "levels not negative"),
        ({"directions": 0}, "must be positive"),
        ({"widths": ()}, "must be positive"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings, words):
    with pytest.raises(ValueError, match=words):
        MNet(**({"dimension": 2} | settings))
