"""The stages that people ask for by name: the measured default, one loss alone, the paper's."""

from collections.abc import Callable
from typing import TypedDict, Unpack

from bbr_layer.inner.adam import Adam
from bbr_layer.inner.charts import EulerAngles
from bbr_layer.inner.gauss_newton import GaussNewton
from bbr_layer.inner.schedules import Constant, StepDown
from bbr_layer.loss_base import Loss
from bbr_layer.losses import BuddyFilter, SoftBBS, SoftBD, SoftBDNormals
from bbr_layer.stage import SOFT_SMOOTHING, Inner, Stage
from bbr_layer.temperature import Annealed, Learned, Temperature, Unrounded

# Points of each cloud that soft buddies are sought among, whose cost grows with the square. More are about as good:
# benchmarks/soft_points.md. Chosen over 400, with which twice as many turns of 60 degrees are lost in the trials of
# benchmarks/solvers.md. The fast ones trade basin for time, seen there.
SOFT_POINTS, FAST_SOFT_POINTS = 500, 300
# Points of each cloud that F begins on: its basin is as wide as the points are sparse. Chosen on the distractor of
# docs/experiments.md, Fig. 5.
FIRST_POINTS = 1000
# Steps, rate and rounding in point spacings with which F begins, of infinite reach: some answers are many spacings off
# by then. Chosen: without them a pair of bun180 and bun270 and scans of the plane are lost; larger steps or less
# rounding show in the gradient on exact copies (tests/test_sensitivity.py).
FIRST_STEPS, FIRST_RATE, FIRST_ROUNDING = 40, 0.01, 0.3
# Points of each cloud that all of Adam's steps see in the plane, where they lie on curves: 64 lie there as far apart as
# 1000 on a surface, and steps of many spacings neither find the way nor have a gradient of use. Then the iterations and
# the rounding in point spacings with which Gauss-Newton ends on all points: benchmarks/planar.md.
PLANAR_POINTS, PLANAR_ITERATIONS, PLANAR_ROUNDING = 64, 20, (0.3, 0.03)
# Temperatures beyond which a pair hardly pulls in F: at the end 1.5 point spacings of Eq. 7, which adds two normals.
# Measured, benchmarks/reach.md: a seventh to a third less error beside a distractor, a tenth to a fifth more in partial
# overlap, either on whole models.
REACH = 50.0
# Steps of that, and their rate: in space Gauss-Newton ends it, which is where the derivative converges. Chosen.
REACH_STEPS, REACH_RATE = 100, 0.01
# Points of each cloud that most of F's steps see; the last few see all. Chosen: a twelfth of a full lidar scan.
FINE_POINTS = 10_000
# How many, and their rounding in point spacings. Chosen on lidar pairs: 30 steps of Adam at a small rate take longer
# and end farther off, three iterations a little.
LAST_ITERATIONS, LAST_ROUNDING = 5, (0.1, 0.03)
# Iterations of Gauss-Newton, and their rounding in point spacings, in which pairs count as much as their points are
# alike: two fifths less error beside a distractor, on models up to two fifths, benchmarks/likeness.md. Chosen: not on
# larger clouds, as lidar scans are, of which few pairs lie within a spacing that is a centimetre near the sensor.
ALIKE_ITERATIONS, ALIKE_ROUNDING = 10, 0.03


def default_stages(soft_points: int = SOFT_POINTS) -> list[Stage]:
    """Soft buddies for the basin, then hard ones on planes for the accuracy; scale-free, measured.

    F begins with the paper's, which pulls from any distance; then its reach is finite. In space, of more than 1000
    points it sees as many at first. Of up to 10 000 Gauss-Newton ends on all, pairs of points that are alike counting
    most; of more it ends there too, after Adam has seen 10 000 of them, and all pairs count. In the plane all that sees
    64 points, and Gauss-Newton ends on all.
    """
    flat, begin = Clouds(points=min(soft_points, PLANAR_POINTS), dimension=2), Adam(FIRST_STEPS, FIRST_RATE)
    goes_on = Adam(REACH_STEPS, REACH_RATE)
    rounding = Annealed(FIRST_ROUNDING, FIRST_ROUNDING)
    planar = [named_stage("softBBS", **flat), named_stage("F", begin, rounding, **flat), _filter_stage(**flat)]
    spatial = [
        named_stage("softBBS", points=soft_points, dimension=3),
        named_stage("F", begin, rounding, points=FIRST_POINTS, dimension=3),
        _filter_stage(goes_on, points=FIRST_POINTS, above=FIRST_POINTS, dimension=3),
        _filter_stage(goes_on, points=FINE_POINTS, dimension=3),
        _alike_stage(GaussNewton(ALIKE_ITERATIONS), Annealed(ALIKE_ROUNDING, ALIKE_ROUNDING)),
    ]
    return [*planar, _planar_last_stage(above=min(soft_points, PLANAR_POINTS)), *spatial, _spatial_last_stage()]


def fast_stages(soft_points: int = FAST_SOFT_POINTS) -> list[Stage]:
    """The same with soft buddies of fewer points and Gauss-Newton instead of most steps."""
    flat, soft, few = Clouds(points=min(soft_points, PLANAR_POINTS), dimension=2), Adam(40, 0.1), GaussNewton(8)
    planar = [named_stage("softBBS", soft, **flat), named_stage("F", few, **flat)]
    spatial = [
        named_stage("softBBS", soft, points=soft_points, dimension=3),
        named_stage("F", few, points=FIRST_POINTS, dimension=3),
        _filter_stage(few, points=FINE_POINTS, above=FINE_POINTS, dimension=3),
        _alike_stage(few),
    ]
    return [*planar, _planar_last_stage(), *spatial, _spatial_last_stage()]


def _planar_last_stage(above: int = 0) -> Stage:
    return _filter_stage(GaussNewton(PLANAR_ITERATIONS), Annealed(*PLANAR_ROUNDING), above=above, dimension=2)


def _alike_stage(inner: Inner, temperature: Temperature | None = None) -> Stage:
    plain = _filter_stage(inner, temperature)
    return Stage(BuddyFilter(reach=REACH, alike=True), inner, plain.temperature, upto=FINE_POINTS, dimension=3)


def _spatial_last_stage() -> Stage:
    return _filter_stage(GaussNewton(LAST_ITERATIONS), Annealed(*LAST_ROUNDING), above=FINE_POINTS, dimension=3)


class Clouds(TypedDict, total=False):
    """Which clouds a stage is for, and how much it sees of them: as ``Stage`` has it."""

    points: int | None
    above: int
    dimension: int | None


def _filter_stage(
    inner: Inner | None = None, temperature: Temperature | None = None, **clouds: Unpack[Clouds]
) -> Stage:
    """F by name, but of a finite reach."""
    plain = named_stage("F", inner, temperature)
    return Stage(BuddyFilter(reach=REACH), plain.inner, plain.temperature, **clouds)


def named_stage(
    name: str, inner: Inner | None = None, temperature: Temperature | None = None, **clouds: Unpack[Clouds]
) -> Stage:
    """One scale-free stage by the paper's name of its loss: ``"softBBS"``, ``"softBD"``, ``"N"`` or ``"F"``.

    What is not given is the measured setting; ``clouds`` and the rest as ``Stage`` has it.

    Raises
    ------
    ValueError: another name.
    """
    loss = named_loss(name)
    _, steps, rate, start, end = _NAMED[name]
    inner = Adam(steps, rate) if inner is None else inner
    temperature = Annealed(start, end) if temperature is None else temperature
    return Stage(loss, inner, temperature, **clouds)


def named_loss(name: str) -> Loss:
    """The loss of the paper's name, rounded off as in the layer.

    Raises
    ------
    ValueError: another name.
    """
    if name not in _NAMED:
        raise ValueError(
            f"there is no loss {name!r}; choose one of {', '.join(_NAMED)}, or BBRLayer.fast() or .robust()"
        )
    return _NAMED[name][0]()


# Loss, steps, rate, and temperature from and to in point spacings. softBBS and F: measured on the bunny, horse and
# dragon at 200 to 1000 points; softBD: measured on the bunny; N: chosen, not measured. F's rounding must end small for
# accuracy and stay positive for the gradient; its steps and rate are what the derivative needs, which converges later
# than the pose: tests/test_sensitivity.py holds it to the analytic sensitivity on exact copies; 60 steps at 0.02 miss
# it.
_NAMED: dict[str, tuple[Callable[[], Loss], int, float, float, float]] = {
    "softBBS": (lambda: SoftBBS(smoothing=SOFT_SMOOTHING), 60, 0.1, 2.0, 1.0),
    "softBD": (lambda: SoftBD(smoothing=SOFT_SMOOTHING), 200, 0.1, 2.0, 1.0),
    "N": (lambda: SoftBDNormals(smoothing=SOFT_SMOOTHING), 100, 0.05, 2.0, 1.0),
    "F": (BuddyFilter, 200, 0.005, 0.3, 0.03),
}


def paper_stage(name: str) -> Stage:
    """One stage as the authors' code runs it: Euler angles about the data's origin, rates in metres of a 15 cm object.

    Raises
    ------
    ValueError: another name than the paper's four.
    """
    if name not in _PAPER:
        raise ValueError(f"the paper has no loss {name!r}; choose one of {', '.join(_PAPER)}")
    loss, steps, rates, schedule, temperature = _PAPER[name]
    angle, translation, alpha = rates
    inner = Adam(
        steps,
        angle,
        translation_rate=translation,
        temperature_rate=alpha,
        schedule=schedule,
        shared=False,
        keep="best",
    )
    return Stage(loss(), inner, temperature(), EulerAngles())


# Loss, steps, (angle, translation, temperature) rates in radians and data units, schedule, temperature.
_PAPER: dict[str, tuple] = {
    "softBBS": (SoftBBS, 750, (5e-3, 1e-5, 5e-6), Constant(), Learned),
    "softBD": (SoftBD, 750, (5e-3, 1e-5, 5e-6), Constant(), Learned),
    "N": (
        lambda: SoftBDNormals(align_signs=False, clip=3.0),
        1000,
        (8e-3, 9e-5, 3e-6),
        StepDown(500, 0.1),
        Learned,
    ),
    "F": (BuddyFilter, 750, (5e-3, 1e-5, 1e-5), Constant(), Unrounded),
}
