"""One stage of the layer: a loss, the optimiser that lowers it, and its temperature; and the stages by name."""

import math
from collections.abc import Callable

import torch
from torch import nn

from bbr_layer.alike import moved_little
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.adam import Adam
from bbr_layer.inner.charts import Chart, RotationVector
from bbr_layer.inner.gauss_newton import GaussNewton
from bbr_layer.inner.implicit import attach, doubt
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.inner.run import run
from bbr_layer.inner.squares_step import BoundSquares
from bbr_layer.inner.unroll import Problem, cut_from_graph, value
from bbr_layer.loss_base import Loss, Objective, SoftLoss
from bbr_layer.losses import BuddyFilter, SoftBBS
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.registration import StageResult
from bbr_layer.temperature import Annealed, Temperature, Unrounded
from bbr_layer.thinning import thinned_pair

# Rounding of soft distances at zero, in point spacings: the measured value at which the unrolled gradient of an exact
# copy equals finite differences; 0.001 leaves it at 1e2 to 1e5.
SOFT_SMOOTHING = 0.2
# Rounding errors of the clouds' type that a gradient by the pose must exceed, of a sum's value over its temperature
# where the loss is a sum: those of a mean are of the size of 1. Chosen: a pose with such a gradient is off by far less
# than a spacing, and a quarter is too little for some exact copies.
ROUNDING = 4000
# What a stage must see at least: a plane has three, and one more shows its other side.
FEWEST_POINTS = 4


Inner = Adam | GaussNewton


class Stage(nn.Module):
    """A loss lowered from where the last stage ended.

    Parameters
    ----------
    loss: one of the four, e.g. ``SoftBBS()``.
    inner: ``Adam(...)`` (default ``Adam()``, 60 steps) or ``GaussNewton(...)``.
    temperature: ``Annealed(...)`` or ``Learned(...)``. Default ``Annealed()``, from 2 point spacings to 1.
    chart: ``RotationVector()`` (default; scale-free) or ``EulerAngles()`` (the paper's, in data units).
    points: most points of each cloud that the stage sees, spread evenly in space. Default None, all of them.
    above: the stage is left out where no cloud of a batch has more real points than this. Default 0, never.
    upto: the stage is left out where any cloud of a batch has more real points than this. Default None, never.
    dimension: 2 or 3, the stage is left out for other clouds. Default None, never.

    Raises
    ------
    ValueError: ``GaussNewton`` with a learned temperature or with Euler angles; hardly any ``points``, or ``upto`` not
        over ``above``; a soft loss with ``Unrounded()``; ``BuddyFilter(alike=True)`` without ``GaussNewton``; another
        ``loss``, ``inner``, ``temperature`` or ``dimension``.
    """

    def __init__(
        self,
        loss: Loss,
        inner: Inner | None = None,
        temperature: Temperature | None = None,
        chart: Chart | None = None,
        *,
        points: int | None = None,
        above: int = 0,
        upto: int | None = None,
        dimension: int | None = None,
    ):
        super().__init__()
        _check(loss, inner, temperature)
        _check_clouds(points, (above, upto), dimension)
        self.loss = loss
        self.inner = Adam() if inner is None else inner
        self.temperature = Annealed() if temperature is None else temperature
        self.chart = RotationVector() if chart is None else chart
        self.points, self.above, self.upto, self.dimension = points, above, upto, dimension
        if isinstance(self.inner, GaussNewton) and (self.temperature.learned or not self.chart.scaled):
            found = self.temperature if self.temperature.learned else self.chart
            raise ValueError(f"{found!r} goes with Adam() alone: give GaussNewton() Annealed() and RotationVector()")

    def forward(
        self,
        pair: CloudPair,
        frame: Frame,
        start: RigidMotion,
        attached: Callable[[int], bool],
        *,
        closed_form: bool,
        last: bool,
    ) -> StageResult:
        """Lower the loss of the centred ``pair`` from ``start``.

        ``attached(step)`` says which steps keep a graph; ``closed_form`` takes gradients from the kernels instead of
        differentiating the loss; of a stage that is not the ``last`` nobody asks the loss (NaN) and whether it settled.

        Raises
        ------
        ValueError: outer training has taken a temperature or a rate to 0 or below.
        """
        self.inner.check()
        self.temperature.check()
        pair = thinned_pair(pair, self.points)
        problem = self._problem(pair, frame, closed_form)
        cut = cut_from_graph(problem, lambda: self.loss.objective(pair.detach()))
        end, earlier = run(problem, start, attached, cut)
        reached = problem if attached(self.inner.steps - 1) else cut
        motion = self.chart.motion(end.state, reached.frame)
        final = end.temperature if self.temperature.learned else self.temperature.at(1.0, problem.unit)
        loss, settled = torch.full_like(final, torch.nan), torch.zeros_like(final, dtype=torch.bool)
        if last:
            loss = value(problem, motion, final)
            with torch.no_grad():
                settled = moved_little(self.chart.motion(earlier, frame), motion, pair)
        return StageResult(reached.frame.leave(motion), loss, final * frame.scale, end.gradient_norm, settled)

    def wanted(self, pair: CloudPair) -> bool:
        """Whether the clouds are of the dimension, and the larger one of the size, that the stage is for.

        Of a batch the largest counts; padding does not.
        """
        d, larger = pair.P.shape[-1], int(torch.maximum(*pair.real_counts()).max())
        return self.dimension in (None, d) and self.above < larger <= (larger if self.upto is None else self.upto)

    def attach(self, pair: CloudPair, frame: Frame, ended: StageResult, damping: float) -> tuple[StageResult, str]:
        """The result with the derivative of an optimum, and in words why it may not be one; "" if it is."""
        pair = thinned_pair(pair, self.points)
        problem = self._problem(pair, frame, closed_form=True)
        temperature = (ended.temperature / frame.scale).detach()
        attached = attach(problem, pair, ended.motion, temperature, damping)
        loss = value(problem, frame.enter(attached.motion), temperature)
        return ended._replace(motion=attached.motion, loss=loss), doubt(attached)

    def _problem(self, pair: CloudPair, frame: Frame, closed_form: bool) -> Problem:
        unit = self.loss.temperature_unit(pair).double()
        if closed_form:
            rounding = self.loss.smoothing * pair.known_spacing().double()
            loss: Objective | PairKernel = PairKernel(self.loss.kernel(pair), pair, rounding)
        else:
            loss = self.loss.objective(pair)
        squares = None
        if isinstance(self.inner, GaussNewton):
            squares = BoundSquares(self.loss.squares(pair), pair, stored=not closed_form)
        # The paper's chart is in data units, and left as it was.
        noise = ROUNDING * torch.finfo(pair.P.dtype).eps if self.chart.scaled else 0.0
        summed = isinstance(self.loss, SoftBBS)
        return Problem(loss, self.chart, frame, self.temperature, unit, self.inner, squares, noise, summed)

    def __repr__(self) -> str:
        sizes = "" if self.points is None else f", points={self.points}"
        sizes += "" if not self.above else f", above={self.above}"
        sizes += "" if self.upto is None else f", upto={self.upto}"
        sizes += "" if self.dimension is None else f", dimension={self.dimension}"
        return f"Stage({self.loss!r}, {self.inner!r}, {self.temperature!r}, {self.chart!r}{sizes})"


def _check(loss: Loss, inner: object, temperature: object) -> None:
    """Refuse settings of a stage that cannot work."""
    if not isinstance(loss, Loss):
        raise ValueError(f"loss is {loss!r}; it must be one of the four losses: try SoftBBS(), or BBRLayer('softBBS')")
    if temperature is not None and not isinstance(temperature, Temperature):
        raise ValueError(f"temperature is {temperature!r}; it must be Annealed(...) or Learned(...): try Annealed()")
    if inner is not None and not isinstance(inner, Adam | GaussNewton):
        raise ValueError(f"inner is {inner!r}; it must be Adam(...) or GaussNewton(...)")
    if isinstance(loss, BuddyFilter) and loss.alike and not isinstance(inner, GaussNewton):
        raise ValueError(f"{loss!r} weighs pairs in the equations of GaussNewton alone: give inner=GaussNewton()")
    if isinstance(temperature, Unrounded) and isinstance(loss, SoftLoss):
        raise ValueError(f"temperature is Unrounded(), and {loss!r} divides by it: try Annealed()")
    if isinstance(temperature, Unrounded) and isinstance(loss, BuddyFilter) and math.isfinite(loss.reach):
        raise ValueError(f"temperature is Unrounded(), and the reach of {loss!r} a multiple of it: try Annealed()")


def _check_clouds(points: object, sizes: tuple[object, object], dimension: object) -> None:
    """Refuse clouds that there are not."""
    if points is not None and not (isinstance(points, int) and points >= FEWEST_POINTS):
        raise ValueError(f"points is {points}; a stage needs at least {FEWEST_POINTS} of each cloud: try 1000")
    above, upto = sizes
    if not isinstance(above, int) or above < 0:
        raise ValueError(f"above is {above}; it must be a whole number of points, not negative: try 10000")
    if upto is not None and not (isinstance(upto, int) and upto > above):
        raise ValueError(f"upto is {upto}; it must be a whole number of points over above={above}, or None: try 10000")
    if dimension not in (None, 2, 3):
        raise ValueError(f"dimension is {dimension!r}; a stage is for clouds in 2 or 3 dimensions, or None: for both")
