"""Two partial scans brought together by gradient descent, with a Chamfer distance and with best buddies.

Each scan sees what the other does not. A Chamfer distance pulls that too, and ends aside; best buddies leave it alone.

python examples/instead_of_chamfer.py
"""

import torch

from bbr_layer import BestBuddiesLoss, RigidMotion, angular_error

torch.manual_seed(0)
x, y = torch.rand(2, 1200) * 4 - 2
hills = torch.stack((x, y, 0.5 * torch.sin(1.7 * x) * torch.cos(1.3 * y) + 0.15 * x), dim=1)
P, Q = hills[:600], hills[600:]
P, Q = P[P[:, 0] < 0.8], Q[Q[:, 0] > -0.8]  # two fifths of the width are common, and no point
truth = RigidMotion.from_rotvec(torch.tensor([0.05, -0.04, 0.1]), torch.tensor([0.1, -0.1, 0.05]))
Q = truth.inverse()(Q)


def chamfer(P: torch.Tensor, Q: torch.Tensor) -> torch.Tensor:
    distances = torch.cdist(P, Q)
    return distances.min(0).values.mean() + distances.min(1).values.mean()


for name, loss in (("Chamfer distance", chamfer), ("BestBuddiesLoss('F')", BestBuddiesLoss("F"))):
    turn, shift = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
    optimiser = torch.optim.Adam((turn, shift), lr=0.01)
    for _ in range(200):
        optimiser.zero_grad()
        loss(P, RigidMotion.from_rotvec(turn, shift)(Q)).backward()
        optimiser.step()
    found = RigidMotion.from_rotvec(turn.detach(), shift.detach())
    aside = (found(Q) - truth(Q)).norm(dim=1).mean()
    print(f"{name}: {torch.rad2deg(angular_error(found.rotation, truth.rotation)):.2f} degrees, {aside:.3f} aside")
