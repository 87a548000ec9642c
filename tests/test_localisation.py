"""L-Net: shapes, the start at zero, and what must not change its answer."""

import pytest
import torch
from torch import nn

from models import LNet

ENCODERS = ["ordered", "unordered"]


def awake(net: LNet) -> LNet:
    """The net with a last layer that is not zero, in float64."""
    nn.init.normal_(net.head[-1].weight)
    nn.init.normal_(net.head[-1].bias)
    return net.double()


def scans(d: int, g: int = 3, n: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    mask = torch.ones(g, n, dtype=torch.bool)
    mask[0, -3:] = False
    return torch.randn(g, n, d, dtype=torch.float64), mask


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("encoder", ENCODERS)
def test_the_first_correction_is_zero_and_can_leave_it(encoder, d):
    net = LNet(d, encoder)
    points, mask = scans(d)
    correction = net(points.float(), mask)
    assert correction.shape == (3, d * (d + 1) // 2)
    assert torch.equal(correction, torch.zeros_like(correction))
    correction.sum().backward()
    assert net.head[-1].weight.grad.abs().sum() > 0


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("encoder", ENCODERS)
def test_padding_is_removal_whatever_it_holds(encoder, d):
    net = awake(LNet(d, encoder))
    points, mask = scans(d)
    points[0, -3:] = torch.nan
    points.requires_grad_()
    padded = net(points, mask)
    torch.testing.assert_close(padded[0], net(points[:1, :-3], mask[:1, :-3])[0])
    padded.sum().backward()
    assert torch.equal(points.grad[0, -3:], torch.zeros(3, d, dtype=torch.float64))
    assert points.grad.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in net.parameters())


def test_a_set_has_no_order_and_a_scan_has_one():
    points, mask = scans(2)
    shuffled = torch.randperm(20)
    unordered, ordered = awake(LNet(2, "unordered")), awake(LNet(2, "ordered"))
    torch.testing.assert_close(unordered(points, mask), unordered(points[:, shuffled], mask[:, shuffled]))
    assert not torch.allclose(ordered(points, mask), ordered(points[:, shuffled], mask[:, shuffled]))


def test_a_missing_ray_of_an_ordered_scan_keeps_its_place():
    net = awake(LNet(2, "ordered"))
    points, mask = scans(2)
    mask[1, 7] = False
    apart = torch.cat((points[1:2, :7], points[1:2, 8:]), 1)
    assert not torch.allclose(net(points, mask)[1], net(apart, mask[1:2, 1:])[0])


def test_the_ordered_encoder_is_convolution_rectifier_maximum():
    net = awake(LNet(2, "ordered", widths=(3, 4), head=()))
    points, mask = scans(2, g=1, n=11)
    mask[:] = True
    features = points[0]
    for number, layer in enumerate(net.layers):
        answer = torch.zeros(11, layer.out_channels, dtype=torch.float64)
        for i in range(11):
            answer[i] = layer.bias
            for tap in range(3):
                j = i + 3 * (tap - 1)
                if 0 <= j < 11:
                    answer[i] += layer.weight[:, :, tap] @ features[j]
        features = answer.clamp(min=0) if number == 0 else answer
    expected = net.head[0].weight @ features.max(0).values + net.head[0].bias
    torch.testing.assert_close(net(points, mask)[0], expected)


def test_an_empty_scan_has_a_finite_correction_and_gradient():
    net = awake(LNet(3))
    points, mask = scans(3)
    mask[1] = False
    correction = net(points, mask)
    correction.sum().backward()
    assert correction.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in net.parameters())


def test_the_scale_divides_the_points():
    points, mask = scans(3)
    small, large = awake(LNet(3)), LNet(3, scale=50.0).double()
    large.load_state_dict(small.state_dict() | {"scale": large.scale})
    torch.testing.assert_close(large(50 * points, mask), small(points, mask))


@pytest.mark.parametrize(("d", "kernel"), [(2, 3), (3, 1)])
def test_the_papers_widths(d, kernel):
    net = LNet.paper(d)
    assert [layer.out_channels for layer in net.layers] == [64, 128, 1024]
    assert {layer.kernel_size for layer in net.layers} == {(kernel,)}
    linear = [layer for layer in net.head if isinstance(layer, nn.Linear)]
    assert [layer.out_features for layer in linear] == [512, 256, d * (d + 1) // 2]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"dimension": 4}, "dimension is 4"),
        ({"encoder": "sorted"}, "must be 'ordered' or 'unordered'"),
        ({"widths": ()}, "must be positive"),
        ({"head": (0,)}, "must be positive"),
        ({"scale": 0.0}, "scale is 0.0"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings, words):
    with pytest.raises(ValueError, match=words):
        LNet(**({"dimension": 2} | settings))
