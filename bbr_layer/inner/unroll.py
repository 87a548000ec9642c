"""One step of the inner registration."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.adam import Adam, Moments, adam_direction, without_rounding
from bbr_layer.inner.charts import Chart, State
from bbr_layer.inner.gauss_newton import GaussNewton, shortened
from bbr_layer.inner.pose_gradient import PairKernel, PoseSlope
from bbr_layer.inner.squares_step import BoundSquares
from bbr_layer.loss_base import Objective
from bbr_layer.pair import Frame
from bbr_layer.rotations import rotation_dimensions
from bbr_layer.temperature import Temperature


class Problem(NamedTuple):
    """What one stage minimises, and how: everything that stays the same from step to step."""

    loss: Objective | PairKernel  # a function to differentiate, or a closed form
    chart: Chart
    frame: Frame
    temperature: Temperature
    unit: Tensor  # (batch,) float64, the spacing that temperatures are multiples of
    inner: Adam | GaussNewton
    squares: BoundSquares | None = None  # the loss as GaussNewton sees it
    noise: float = 0.0  # a gradient by the pose that is no longer than this is rounding
    summed: bool = False  # whether the loss is a sum over points: the noise is then that times loss over temperature


class Progress(NamedTuple):
    """Where a stage stands: everything that changes from step to step."""

    state: State
    temperature: Tensor  # (batch,) float64, inner units
    moments: Moments
    gradient_norm: Tensor  # (batch,) of the last step taken
    best_loss: Tensor  # (batch,)
    best_state: State
    best_temperature: Tensor

    def detach(self) -> "Progress":
        """The same numbers, cut from the graph."""
        return Progress(
            detached(self.state),
            self.temperature.detach(),
            self.moments.detach(),
            self.gradient_norm,
            self.best_loss.detach(),
            detached(self.best_state),
            self.best_temperature.detach(),
        )


def begin(problem: Problem, start: RigidMotion) -> Progress:
    """Before the first step, at ``start`` (between the user's frames)."""
    state = problem.chart.begin(start, problem.frame)
    scale = problem.frame.scale
    temperature = problem.temperature.initial(problem.unit, scale).expand(scale.shape)
    batch, d = start.translation.shape
    size = rotation_dimensions(d) + d + int(problem.temperature.learned)
    moments = Moments.zero(torch.zeros(batch, size, dtype=torch.float64, device=scale.device))
    infinite = torch.full_like(scale.detach(), torch.inf)
    return Progress(state, temperature, moments, infinite, infinite, state, temperature)


def step(problem: Problem, at: Progress, differentiable: bool) -> Progress:
    """One step on pose and, if it is learned, temperature; ``differentiable`` keeps the graph."""
    inner, learned = problem.inner, problem.temperature.learned
    if isinstance(inner, GaussNewton):
        return _gauss_newton_step(problem, inner, at)
    temperature = at.temperature
    if not learned:
        temperature = problem.temperature.at(share_done(at.moments.step, inner.steps), problem.unit)
    loss, gradient = loss_gradient(problem, at.state, temperature, differentiable)
    d = problem.frame.target_centre.shape[-1]
    blocks = (rotation_dimensions(d), d) + ((1,) if learned else ())
    pose_size = blocks[0] + blocks[1]
    noise = problem.noise * (loss.detach().abs() / temperature.detach() if problem.summed else torch.ones_like(loss))
    gradient = without_rounding(gradient, noise, pose_size)
    direction, moments = adam_direction(
        gradient, at.moments, betas=inner.betas, eps=inner.eps, blocks=blocks if inner.shared else None
    )
    move = -inner.rates(blocks, direction, [at.moments.step]) * direction
    state = problem.chart.moved(at.state, move[:, :pose_size])
    later = torch.maximum(temperature + move[:, -1], floor(problem)) if learned else temperature
    better = (loss < at.best_loss).detach()
    return Progress(
        state,
        later,
        moments,
        gradient[:, :pose_size].detach().norm(dim=-1),
        torch.where(better, loss, at.best_loss),
        _chosen(better, at.state, at.best_state),
        torch.where(better, temperature, at.best_temperature),
    )


def _gauss_newton_step(problem: Problem, inner: GaussNewton, at: Progress) -> Progress:
    assert problem.squares is not None
    cooled = problem.temperature.at(share_done(at.moments.step, inner.steps), problem.unit)
    temperature = torch.maximum(cooled, floor(problem))
    motion = problem.chart.motion(at.state, problem.frame)
    step, slope = problem.squares.step(motion, temperature, inner.damping)
    return at._replace(
        state=problem.chart.moved(at.state, shortened(step, motion.dimension)),
        temperature=temperature,
        moments=at.moments._replace(step=at.moments.step + 1),
        gradient_norm=slope.detach().norm(dim=-1),
    )


def loss_gradient(problem: Problem, state: State, temperature: Tensor, differentiable: bool) -> tuple[Tensor, Tensor]:
    """Loss ``(batch,)`` and its gradient ``(batch, k)`` in the pose's tangent at 0 and, if learned, the temperature."""
    with torch.set_grad_enabled(differentiable):
        motion = problem.chart.motion(state, problem.frame)
        warm = torch.maximum(temperature, floor(problem))
        if isinstance(problem.loss, PairKernel):
            slope = problem.loss.slope(motion, warm)
        else:
            slope = _plain_slope(problem.loss, motion, warm, differentiable)
        gradient = problem.chart.slope(state, problem.frame, RigidMotion(slope.rotation, slope.translation))
        if problem.temperature.learned:
            gradient = torch.cat((gradient, slope.temperature[:, None]), -1)
    return slope.loss if differentiable else slope.loss.detach(), gradient


def _plain_slope(loss: Objective, motion: RigidMotion, temperature: Tensor, differentiable: bool) -> PoseSlope:
    """Of a function to differentiate.

    Asked by what the pose has become, through a node of its own, and not by a leaf, the engine does not walk through
    the graph of the steps before: that would make the time quadratic in the steps.
    """
    with torch.enable_grad():
        at = [x.view_as(x) if x.requires_grad else x.detach().requires_grad_() for x in (*motion, temperature)]
        found = loss(RigidMotion(at[0], at[1]), at[2])
        slopes = torch.autograd.grad(found.sum(), at, create_graph=differentiable, materialize_grads=True)
    return PoseSlope(found, *slopes)


def cut_from_graph(problem: Problem, plain: Callable[[], Objective]) -> Problem:
    """The same problem with every input cut from the graph; ``plain`` makes a function to differentiate anew."""
    loss = problem.loss.detach() if isinstance(problem.loss, PairKernel) else plain()
    frame = Frame(*(field.detach() for field in problem.frame))
    squares = None if problem.squares is None else problem.squares.detach()
    return problem._replace(loss=loss, frame=frame, unit=problem.unit.detach(), squares=squares)


def value(problem: Problem, motion: RigidMotion, temperature: Tensor) -> Tensor:
    """The loss alone, ``(batch,)``, differentiable where the problem is."""
    if isinstance(problem.loss, PairKernel):
        return problem.loss.slope(motion, temperature).loss
    return problem.loss(motion, temperature)


def floor(problem: Problem) -> Tensor:
    """Smallest temperature ever used, ``(batch,)`` in inner units."""
    return problem.temperature.floor(problem.frame.scale)


def share_done(step: int, steps: int) -> float:
    """Share of the steps done, so that the schedule's end is met at the last one."""
    return step / max(steps - 1, 1)


def _chosen(which: Tensor, first: State, second: State) -> State:
    fields = zip(first, second, strict=True)
    return State(*(torch.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in fields))


def detached(state: State) -> State:
    """The same numbers, cut from the graph."""
    return State(*(field.detach() for field in state))
