"""A network that learns to tell points apart, so that clouds turned by any angle find each other.

The network sees where a point lies, which is of no use as the clouds are turned, and how far its neighbours and the
middle of all points are, which is. The layer finds buddies by the network's features alone and brings them together;
the gradient of how far aside they end reaches the network through all steps of the registration. It is never told
which point belongs to which.

python examples/learn_features.py [STEPS]
"""

import sys

import torch
from torch import Tensor, nn

from bbr_layer import Adam, Annealed, BBRLayer, RigidMotion, SoftBD, Stage

BATCH, POINTS, NEIGHBOURS, CHANNELS = 8, 80, 12, 16
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 40


def pairs(count: int) -> tuple[Tensor, Tensor, RigidMotion]:
    """Lumpy surfaces, noisy copies of them turned by up to half a turn, and the motions back."""
    directions = nn.functional.normalize(torch.randn(count, POINTS, 3), dim=-1)
    lumps = 1 + 0.3 * torch.sin(2 * directions @ torch.randn(count, 3, 1)) + 0.2 * directions[..., :1] ** 3
    P = directions * lumps * torch.tensor([1.0, 0.7, 0.5])
    axes = nn.functional.normalize(torch.randn(count, 3), dim=-1)
    truth = RigidMotion.from_rotvec(axes * torch.rand(count, 1) * torch.pi, 0.1 * torch.randn(count, 3))
    return P, truth.inverse()(P + 0.01 * torch.randn_like(P)), truth


def seen(points: Tensor) -> Tensor:
    """Where the points lie, and their distances to the nearest ones and to the middle of all."""
    nearest = torch.cdist(points, points).topk(NEIGHBOURS + 1, largest=False).values[..., 1:]
    return torch.cat((points, nearest, (points - points.mean(-2, keepdim=True)).norm(dim=-1, keepdim=True)), dim=-1)


def asides(P: Tensor, Q: Tensor, truth: RigidMotion) -> Tensor:
    """How far aside each registered source lies, on average."""
    found = layer(P, Q, P_features=network(seen(P)), Q_features=network(seen(Q))).target_from_source
    return (found(Q) - truth(Q)).norm(dim=-1).mean(dim=-1)


torch.manual_seed(0)
layer = BBRLayer(Stage(SoftBD(match="features"), Adam(60, 0.1), Annealed(2.0, 1.0)))
network = nn.Sequential(nn.Linear(NEIGHBOURS + 4, 64), nn.Tanh(), nn.Linear(64, CHANNELS))
optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
unseen = pairs(40)
for step in range(steps + 1):
    if step % 10 == 0 or step == steps:
        with torch.no_grad():
            aside = asides(*unseen)
        print(f"step {step}: {aside.median():.3f} aside, {int((aside < 0.1).sum())} of {len(aside)} within 0.1")
    optimiser.zero_grad()
    asides(*pairs(BATCH)).mean().backward()
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)  # a pair between two answers has a gradient of any size
    optimiser.step()
