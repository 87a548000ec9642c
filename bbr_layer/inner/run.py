"""All steps of one stage: in stretches that keep a graph or do not, compiled where that can be."""

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.adam import Adam, Moments
from bbr_layer.inner.charts import RotationVector, State
from bbr_layer.inner.gauss_newton import GaussNewton
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.inner.unroll import Problem, Progress, begin, detached, floor, share_done, step
from bbr_layer.kernels import scene as kernel_scene
from bbr_layer.kernels.choice import backend, sweeps_for, tell_slow
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.kernels.soft import SoftKernel
from bbr_layer.kernels.squares import MatchedSquares
from bbr_layer.pair import CloudPair
from bbr_layer.rotations import rotation_dimensions

if TYPE_CHECKING:
    from bbr_layer.inner.walk import Scene

# Share of the steps, at the end, over which a registration must have settled to count as converged.
SETTLED_TAIL = 0.1


def run(problem: Problem, start: RigidMotion, attached: Callable[[int], bool], cut: Problem) -> tuple[Progress, State]:
    """All steps of a stage, and the state a tenth of the steps before the end (to tell whether it settled).

    Parameters
    ----------
    problem, cut: the stage, and the same one with every input cut from the graph.
    start: between the user's frames.
    attached: says of each step whether it is kept differentiable.
    """
    at, steps = begin(problem, start), problem.inner.steps
    tail = math.floor((1 - SETTLED_TAIL) * steps)
    marks = sorted({0, steps, *(k for k in range(1, steps) if attached(k) != attached(k - 1))})
    earlier = detached(at.state)
    for first, last in zip(marks[:-1], marks[1:], strict=True):
        seen = tail if first <= tail < last else first
        if attached(first):
            if first and not attached(first - 1):
                at = at._replace(state=_fixed(at.state, problem, cut))
            at, state = _advance(problem, at, (last, seen), differentiable=True)
        else:
            with torch.no_grad():
                at, state = _advance(cut, at.detach(), (last, seen), differentiable=False)
        if seen == tail:
            earlier = state
    if problem.inner.keep == "best":
        at = at._replace(state=at.best_state, temperature=at.best_temperature)
    return at, earlier


def _advance(problem: Problem, at: Progress, until: tuple[int, int], differentiable: bool) -> tuple[Progress, State]:
    """Step up to the first number of ``until``; and the state before the step of the second, without a graph."""
    (last, seen), look = until, _look(problem)
    if look is not None:
        return _walked(problem, look, at, until)
    if _solves_in_numpy(problem):
        return _solved(problem, at, until)
    state = detached(at.state)
    for number in range(at.moments.step, last):
        if number == seen:
            state = detached(at.state)
        at = step(problem, at, differentiable)
    return at, state


def _look(problem: Problem) -> "Callable[[CloudPair, Tensor], Scene] | None":
    """What walks the steps without a tensor in between; None where nothing can."""
    loss, inner = problem.loss, problem.inner
    if not isinstance(inner, Adam) or not isinstance(loss, PairKernel) or loss.pair.P.device.type != "cpu":
        return None
    if uncompiled := _uncompiled(problem):
        if backend("cpu").name == "numba":
            tell_slow("numba", uncompiled)
        return None
    # What is compiled is imported where it is used: Numba takes long to load, and may be missing.
    if isinstance(loss.kernel, MatchedKernel) and backend("cpu").name == "numba":
        from bbr_layer.inner.matched_scene import MatchedScene

        return partial(MatchedScene, loss.kernel)
    if isinstance(loss.kernel, SoftKernel):
        terms = loss.kernel.terms
        if sweeps_for(terms, kernel_scene.Scene(loss.pair, problem.unit, loss.rounding)).name == "numba":
            from bbr_layer.inner.compiled_scene import CompiledScene

            return partial(CompiledScene, terms)
    return None


def _uncompiled(problem: Problem) -> str:
    """What keeps the steps of Adam from being compiled; "" if nothing does."""
    if problem.temperature.learned:
        return "a walk with a learned temperature"
    if problem.inner.keep != "last":
        return f"a walk with keep={problem.inner.keep!r}"
    return "" if isinstance(problem.chart, RotationVector) else f"a walk in {problem.chart!r}"


def _walked(
    problem: Problem, look: "Callable[[CloudPair, Tensor], Scene]", at: Progress, until: tuple[int, int]
) -> tuple[Progress, State]:
    from bbr_layer.inner.walk import Steps, walk

    loss, inner, done, d = problem.loss, problem.inner, at.moments.step, at.state.translation.shape[-1]
    assert isinstance(loss, PairKernel) and isinstance(inner, Adam)
    last, seen = until
    temperatures = _temperatures(problem, range(done, last))
    rates = inner.rates((rotation_dimensions(d), d), at.moments.first, range(done, last))
    begun = (*at.state, at.moments.first, at.moments.second)
    how = Steps(look, inner, done, seen, problem.noise, problem.summed)
    end = walk(how, (loss.pair, loss.rounding), begun, temperatures, rates)
    moments = Moments(end.first, end.second, last)
    state = State(end.rotation, end.translation)
    at = at._replace(state=state, temperature=temperatures[-1], moments=moments, gradient_norm=end.gradient_norm)
    return at, State(end.seen_rotation, end.seen_translation)


def _solves_in_numpy(problem: Problem) -> bool:
    """Whether Gauss-Newton needs no tensors between its steps."""
    squares = problem.squares
    if squares is None or squares.stored or not isinstance(squares.squares, MatchedSquares):
        return False
    return squares.pair.P.device.type == "cpu" and backend("cpu").name == "numba"


def _solved(problem: Problem, at: Progress, until: tuple[int, int]) -> tuple[Progress, State]:
    from bbr_layer.inner.squares_walk import Steps, walk

    inner, done, (last, seen) = problem.inner, at.moments.step, until
    assert isinstance(inner, GaussNewton) and problem.squares is not None
    temperatures = _temperatures(problem, range(done, last))
    end = walk(Steps(problem.squares, inner.damping, seen - done), at.state, temperatures)
    at = at._replace(
        state=State(end.rotation, end.translation),
        temperature=temperatures[-1],
        moments=at.moments._replace(step=last),
        gradient_norm=end.slope_norm,
    )
    return at, State(end.seen_rotation, end.seen_translation)


def _temperatures(problem: Problem, numbers: range) -> Tensor:
    """Of steps of these numbers, ``(steps, batch)``."""
    shares = problem.unit.new_tensor([share_done(number, problem.inner.steps) for number in numbers])[:, None]
    temperatures = torch.maximum(problem.temperature.at(shares, problem.unit), floor(problem))
    return temperatures.expand(len(numbers), -1)  # Unrounded is one row for all


def _fixed(state: State, problem: Problem, cut: Problem) -> State:
    """A pose found without a graph, as one that stays put in the user's frame while the clouds' centres vary."""
    motion = cut.frame.leave(problem.chart.motion(state, cut.frame))
    return problem.chart.begin(motion, problem.frame)
