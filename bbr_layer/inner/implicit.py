"""The gradient of a registration from the optimality of its result alone."""

from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.charts import State
from bbr_layer.inner.unroll import Problem, loss_gradient
from bbr_layer.pair import CloudPair, centre_and_radius
from bbr_layer.rotations import rotation_dimensions

# The Hessian counts as positive definite when its smallest eigenvalue is above this share of the largest: below it the
# answer of a linear solve in float64 has no digits left.
SINGULAR_SHARE = 1e-10
# The result counts as optimal when a Newton step would move the cloud's rim by less than this share of a point spacing:
# the neighbourhoods that the soft buddies see are then the same. Chosen, not measured.
SMALL_NEWTON_STEP = 1e-2


class Attached(NamedTuple):
    """The motion with its implicit derivative, and per item ``(batch,)`` why it may not be trusted."""

    motion: RigidMotion
    indefinite: Tensor
    far: Tensor


def attach(problem: Problem, pair: CloudPair, motion: RigidMotion, temperature: Tensor, damping: float) -> Attached:
    """``motion`` (between the user's frames) as a function of the clouds, by the implicit function theorem.

    At an optimum the gradient g is 0 whatever the clouds, so that the pose moves by ``-H^-1 dg``. The temperature is
    held: softBD always gains by lowering it.

    Parameters
    ----------
    problem: of the last stage, attached to the graph.
    pair: the centred clouds.
    damping: share of the Hessian's mean diagonal that is added to it.
    """
    state = problem.chart.begin(motion.detach(), problem.frame)
    gradient = _slope(problem, state, temperature.detach())
    hessian = _hessian(problem, motion.detach(), temperature.detach())
    mean = hessian.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    damped = hessian + damping * mean * eye
    eigenvalues = torch.linalg.eigvalsh((damped + damped.mT) / 2)
    indefinite = ~(eigenvalues[:, 0] > SINGULAR_SHARE * eigenvalues[:, -1].abs())
    safe = torch.where(indefinite[:, None, None], eye, damped)
    newton = torch.linalg.solve(safe, gradient.detach())
    step = -torch.linalg.solve(safe, gradient - gradient.detach())
    moved = problem.frame.leave(problem.chart.motion(problem.chart.moved(state, step), problem.frame))
    return Attached(moved, indefinite, ~(_rim_moves(newton, pair) < SMALL_NEWTON_STEP * pair.known_spacing()))


def doubt(attached: Attached) -> str:
    """Why the derivative may be wrong, in words; "" if nothing speaks against it."""
    reasons = []
    if attached.indefinite.any():
        reasons.append(f"the Hessian is not positive definite for {int(attached.indefinite.sum())} of the pairs")
    if attached.far.any():
        reasons.append(f"{int(attached.far.sum())} of the pairs have not converged")
    return " and ".join(reasons)


def _slope(problem: Problem, state: State, temperature: Tensor) -> Tensor:
    """What is 0 at the end, ``(batch, k)``: of Gauss-Newton the slope of its equations, whose weights may vary."""
    if problem.squares is None:
        return loss_gradient(problem, state, temperature, differentiable=True)[1]
    motion, squares = problem.chart.motion(state, problem.frame), problem.squares
    with torch.enable_grad():
        return squares.squares.equations(squares.pair, motion, temperature, squares.squares.hold(motion.detach())).slope


def _hessian(problem: Problem, motion: RigidMotion, temperature: Tensor) -> Tensor:
    """How the gradient changes as the pose is moved, ``(batch, k, k)``, without a graph."""
    with torch.enable_grad():
        batch, d = motion.translation.shape
        tangent = motion.translation.new_zeros(batch, rotation_dimensions(d) + d).requires_grad_()
        state = problem.chart.moved(problem.chart.begin(motion, problem.frame), tangent)
        gradient = _slope(problem, state, temperature)
        rows = [torch.autograd.grad(one.sum(), tangent, retain_graph=True)[0] for one in gradient.unbind(-1)]
    return torch.stack(rows, -2).detach()


@torch.no_grad()
def _rim_moves(step: Tensor, pair: CloudPair) -> Tensor:
    """How far a tangent vector would move the source's rim, ``(batch,)``."""
    turns = rotation_dimensions(pair.Q.shape[-1])
    _, radius = centre_and_radius(pair.Q, pair.Q_mask)
    return step[:, :turns].norm(dim=-1) * radius + step[:, turns:].norm(dim=-1)
