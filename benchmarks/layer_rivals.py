"""What a user would write without the layer: the same registration by hand, checkpointed, and by TorchOpt."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from bbr_layer import CloudPair, RigidMotion, SoftBBS, SoftBD, SoftBDNormals, estimate_normals, point_spacing

LOSSES = {"softBD": SoftBD, "softBBS": SoftBBS, "N": SoftBDNormals}
BETAS, EPS, SMOOTHING = (0.9, 0.999), 1e-8, 0.2


def _problem(name: str, P: Tensor, Q: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """The loss as a function of a rotation vector and a translation, both ``(1, 3)``; alpha at 1.4 point spacings."""
    loss = LOSSES[name](smoothing=SMOOTHING)
    spacing = ((point_spacing(P) + point_spacing(Q)) / 2)[None]
    normals = (estimate_normals(P)[None], estimate_normals(Q)[None]) if name == "N" else (None, None)
    pair = CloudPair(P[None], Q[None], *normals, spacing=spacing)
    return lambda turn, shift: loss(pair.moved_by(RigidMotion.from_rotvec(turn, shift)), 1.4 * spacing).sum()


def checkpointed(name: str, steps: int, rate: float) -> Callable[[Tensor, Tensor], Tensor]:
    """A hand-written unroll of Adam whose steps are recomputed in the backward pass."""

    def register(P: Tensor, Q: Tensor) -> Tensor:
        evaluate = _problem(name, P, Q)

        def step(number: int, *state: Tensor) -> tuple[Tensor, ...]:
            pose, first, second = state[:2], state[2:4], state[4:]
            with torch.enable_grad():
                leaves = [x if x.requires_grad else x.requires_grad_() for x in pose]
                gradients = torch.autograd.grad(evaluate(*leaves), leaves, create_graph=True)
            first = tuple(BETAS[0] * m + (1 - BETAS[0]) * g for m, g in zip(first, gradients, strict=True))
            second = tuple(BETAS[1] * v + (1 - BETAS[1]) * g * g for v, g in zip(second, gradients, strict=True))
            unbias = [1 - beta**number for beta in BETAS]
            moves = [m / unbias[0] / ((v / unbias[1]).sqrt() + EPS) for m, v in zip(first, second, strict=True)]
            return *(x - rate * move for x, move in zip(pose, moves, strict=True)), *first, *second

        state = tuple(torch.zeros(1, 3, dtype=torch.float64) for _ in range(6))
        for number in range(1, steps + 1):
            state = checkpoint(step, number, *state, use_reentrant=False, preserve_rng_state=False)
        return RigidMotion.from_rotvec(*state[:2]).matrix[0]

    return register


def torchopt_unroll(name: str, steps: int, rate: float) -> Callable[[Tensor, Tensor], Tensor]:
    """The same by TorchOpt's differentiable Adam over a module that holds the pose."""
    import torchopt

    def register(P: Tensor, Q: Tensor) -> Tensor:
        evaluate = _problem(name, P, Q)
        pose = nn.ParameterList([nn.Parameter(torch.full((1, 3), 1e-6, dtype=torch.float64)) for _ in range(2)])
        optimiser = torchopt.MetaAdam(pose, lr=rate)
        for _ in range(steps):
            optimiser.step(evaluate(*pose))
        return RigidMotion.from_rotvec(*pose).matrix[0]

    return register
