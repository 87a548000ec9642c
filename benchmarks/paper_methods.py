"""The registrations compared, as a table: a new one is one more row."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from bbr_layer import BBRLayer, Detached, RigidMotion
from benchmarks.paper_experiments import LIDAR_POINTS
from benchmarks.paper_trials import Trial
from benchmarks.peers import PEERS, found_by

VARIANTS = ("softBBS", "softBD", "F", "N")
# The paper's variants take seconds a registration: they run only here, and at these sizes at most.
VARIANT_PLACES, VARIANT_POINTS = {("fig2", "bunny"), ("fig3", "bunny"), ("fig4", "bun000/090")}, 500
FEATURE_POINTS = 5000  # of a lidar scan for FPFH, whose features of 30 000 points take 25 s


class Method(NamedTuple):
    """One row of the tables.

    Parameters
    ----------
    name: as it is printed.
    kind: "variant", "ours" or "peer".
    settings: by their words; the better of several is chosen on seeds of its own.
    most_points: what a cloud is thinned to where it has more.
    """

    name: str
    kind: str
    settings: dict[str, Callable[[Trial], RigidMotion]]
    most_points: int


def by_layer(layer: BBRLayer, trial: Trial) -> RigidMotion:
    """The layer's answer in float32, with the trial's normals or none."""
    normals = [None if x is None else x.float() for x in (trial.P_normals, trial.Q_normals)]
    result = layer(trial.P.float(), trial.Q.float(), P_normals=normals[0], Q_normals=normals[1])
    return result.target_from_source


def _layer(name: str, kind: str, layer: BBRLayer, most_points: int) -> Method:
    return Method(name, kind, {"": partial(by_layer, layer)}, most_points)


METHODS = (
    *(_layer(f"paper {name}", "variant", BBRLayer.paper(name, Detached()), VARIANT_POINTS) for name in VARIANTS),
    _layer("BBRLayer()", "ours", BBRLayer(backward=Detached()), LIDAR_POINTS),
    _layer("BBRLayer.fast()", "ours", BBRLayer.fast(Detached()), LIDAR_POINTS),
    _layer("BBRLayer.robust()", "ours", BBRLayer.robust(Detached()), LIDAR_POINTS),
    _layer('BBRLayer("F")', "ours", BBRLayer("F", backward=Detached()), LIDAR_POINTS),
    *(
        Method(
            name,
            "peer",
            {words: partial(found_by, solve) for words, solve in settings.items()},
            FEATURE_POINTS if name == "FPFH + RANSAC" else LIDAR_POINTS,
        )
        for name, settings in PEERS.items()
    ),
)


def runs_in(method: Method, experiment: str, panel: str, trial_points: int, sampling: str) -> bool:
    """Whether a method takes part: variants in few places, F by itself only on lidar, as in the paper."""
    if method.kind == "variant":
        return sampling == "shared" and (experiment, panel) in VARIANT_PLACES and trial_points <= VARIANT_POINTS
    return method.name != 'BBRLayer("F")' or experiment == "lidar"
