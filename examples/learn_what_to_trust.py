"""A network that learns which points to trust, from nothing but how far off the registration is.

Half of each cloud belongs to something that moved otherwise. Every point carries a noisy brightness, which tells the
two apart to those who know what it means. The network makes a weight of it, the layer registers with the weights, and
the gradient of the error reaches the network through all steps of the registration.

python examples/learn_what_to_trust.py [STEPS]
"""

import sys

import torch
from torch import Tensor, nn

from bbr_layer import BBRLayer, RigidMotion

BATCH, POINTS = 8, 60
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 40


def shape(points: int) -> Tensor:
    """A bumpy surface about the origin, another one at every call."""
    directions = nn.functional.normalize(torch.randn(BATCH, points, 3), dim=-1)
    bumps = 1 + 0.3 * torch.sin(3 * directions @ torch.randn(BATCH, 3, 1))
    return directions * bumps * torch.tensor([1.0, 0.7, 0.5])


def motion(size: float) -> RigidMotion:
    """A small motion of each item."""
    return RigidMotion.from_rotvec(size * torch.randn(BATCH, 3), size * torch.randn(BATCH, 3))


def pairs() -> tuple[Tensor, Tensor, Tensor, RigidMotion]:
    """Targets, sources, the brightness of their points (the clouds match point by point), and the true motions."""
    still, mover = shape(POINTS), shape(POINTS) + torch.tensor([1.5, 0.0, 0.0])
    truth = motion(0.05)
    P = torch.cat((still, motion(0.2)(mover)), dim=1)
    Q = truth.inverse()(torch.cat((still, mover), dim=1)) + 0.01 * torch.randn(BATCH, 2 * POINTS, 3)
    bright = torch.arange(2 * POINTS).expand(BATCH, -1) >= POINTS
    return P, Q, 0.3 + 0.4 * bright + 0.1 * torch.randn(bright.shape), truth


def error(trust: nn.Module) -> Tensor:
    """How far aside the registered sources lie, on average."""
    P, Q, brightness, truth = pairs()
    weights = trust(brightness[..., None]).squeeze(-1)
    found = layer(P, Q, P_weights=weights, Q_weights=weights).target_from_source
    return (found(Q) - truth(Q)).norm(dim=-1).mean()


torch.manual_seed(0)
layer = BBRLayer("softBD")
trust = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 1), nn.Sigmoid())
optimiser = torch.optim.Adam(trust.parameters(), lr=0.03)
for step in range(steps):
    optimiser.zero_grad()
    loss = error(trust)
    loss.backward()
    optimiser.step()
    if step % 5 == 0 or step == steps - 1:
        still, moved = trust(torch.tensor([[0.3], [0.7]])).flatten().tolist()
        print(
            f"step {step}: {loss.item():.4f} aside; a point that moved counts {moved / still:.2f} of one that did not"
        )
