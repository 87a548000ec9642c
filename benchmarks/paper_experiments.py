"""The paper's experiments as a table: what is registered, from how far off, how often, and what counts as failed."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from bbr_layer import RigidMotion, read_cloud
from benchmarks.data import data_folder, model, scan
from benchmarks.paper_trials import (
    LIDAR_NEIGHBOURS,
    Distractor,
    Make,
    Surface,
    distracted_trial,
    lidar_trial,
    model_trial,
    scans_trial,
)

MODELS = {"bunny": "bun_zipper", "horse": "horse", "dragon": "dragon_vrip_res3"}
TURNS_DEG = (5.0, 10.0, 30.0, 60.0, 90.0)  # Fig. 2
ACCURACY_DEG = {"bunny": 8.0, "horse": 10.0, "dragon": 5.0}  # Fig. 3
COUNTS = (200, 500, 1000)  # Figs. 3 and 4; the paper goes from 200 to 1000 in hundreds, and to 2000 for the dragon
SHIFT = 0.005  # metres, Figs. 3 to 5
# Fig. 5; the paper names neither the small horse's size nor its motion: half the size, beside the large one, 20 degrees
# and 2 cm here.
DISTRACTORS, DISTRACTOR = (200, 500, 900), Distractor(0.5, 1.0, 20.0, 0.02)
LIDAR_PAIRS = ("pair_kitti00_95_94", "pair_libpointmatcher_car401_400", "formats")
LIDAR_POINTS = 30_000  # of each scan, as in the paper (4.5)
KINECT_FRAMES = (0, 4)  # of the sequence: the two farthest apart
KINECT_NOTE = (
    "The paper's own pair (freiburg1_xyz) is not at hand: these are two frames of freiburg1_desk. All methods stop at "
    "much the same distance from the motion capture's answer: it, not they, seems to be the limit here."
)


class Cell(NamedTuple):
    """One column of a table."""

    panel: str
    x: float  # along the figure's axis
    make: Make

    @property
    def name(self) -> str:
        """What it is called in the results."""
        return f"{self.panel} {self.x:g}"


class Experiment(NamedTuple):
    """One figure or table of the paper, under one sampling."""

    name: str
    title: str
    axis: str
    cells: Callable[[str], list[Cell]]  # from the sampling
    repeats: float = 1.0  # times the repeats asked for
    failed_deg: float = 5.0  # paper, 4.2
    failed_shift: float = float("inf")
    note: str = ""  # what a reader of the results has to know


def surface(name: str) -> Surface:
    """A full model by its short name."""
    return Surface.of(model(MODELS[name]))


def _fig2(sampling: str) -> list[Cell]:
    made = {name: surface(name) for name in MODELS}
    return [Cell(n, x, model_trial(made[n], 500, x, 0.0, sampling)) for n in MODELS for x in TURNS_DEG]


def _fig3(sampling: str) -> list[Cell]:
    made = {name: surface(name) for name in MODELS}
    return [Cell(n, k, model_trial(made[n], k, ACCURACY_DEG[n], SHIFT, sampling)) for n in MODELS for k in COUNTS]


def _fig4(sampling: str) -> list[Cell]:
    scans = Surface.of(scan("bun000")), Surface.of(scan("bun090"))
    return [Cell("bun000/090", k, scans_trial(scans, k, (5.0, 5.0), SHIFT, sampling)) for k in COUNTS]


def _fig5(sampling: str) -> list[Cell]:
    horse = surface("horse")
    return [Cell("horse", k, distracted_trial(horse, (1000, k), DISTRACTOR, sampling)) for k in DISTRACTORS]


def _fig6(sampling: str) -> list[Cell]:
    arrays = np.load(data_folder() / "seq_tum_fr1_desk_5.npz")
    scans = []
    for number in KINECT_FRAMES:
        points = arrays["points"][arrays["offsets"][number] : arrays["offsets"][number + 1]]
        world_from_scan = RigidMotion.from_matrix(torch.from_numpy(arrays["poses"][number]).double())
        scans.append(Surface.of(world_from_scan(torch.from_numpy(points).double())))
    return [Cell("fr1/desk", 1000, scans_trial((scans[0], scans[1]), 1000, (0.0, 5.0), 0.0, sampling))]


def _fig7(sampling: str) -> list[Cell]:
    scans = Surface.of(scan("bun180")), Surface.of(scan("bun270"))
    return [Cell("bun180/270", 1000, scans_trial(scans, 1000, (30.0, 50.0), 0.05, sampling))]


def lidar_pair(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target, source and the known motion of one pair of scans."""
    if name == "formats":
        target, source = (read_cloud(data_folder() / name / f"lidar_{x}.ply").points for x in ("target", "source"))
        return target, source, np.loadtxt(data_folder() / name / "T_target_source.txt")
    arrays = np.load(data_folder() / f"{name}.npz")
    return arrays["tgt"].astype(float), arrays["src"].astype(float), arrays["T"]


def _lidar(sampling: str) -> list[Cell]:
    cells = []
    for name in LIDAR_PAIRS:
        target, source, known = lidar_pair(name)
        neighbours = LIDAR_NEIGHBOURS if sampling == "shared" else 3  # nobody sees those of the disjoint sampling
        scans = Surface.of(torch.from_numpy(target), neighbours), Surface.of(torch.from_numpy(source), neighbours)
        truth = RigidMotion.from_matrix(torch.from_numpy(known))
        cells.append(Cell(name, 1, lidar_trial(scans, truth, LIDAR_POINTS, 1.0, sampling)))
    return cells


# In the order in which they are run and printed.
EXPERIMENTS = (
    Experiment("fig2", "Fig. 2: the initial rotation, M = 500", "initial rotation (deg)", _fig2),
    Experiment("fig3", "Fig. 3: accuracy on whole models", "points M", _fig3),
    Experiment("fig4", "Fig. 4: partial overlap, bun000 and bun090, 5 deg", "points M", _fig4),
    Experiment("fig5", "Fig. 5: a distractor beside 1000 points", "points of the distractor", _fig5),
    Experiment(
        "fig6", "Fig. 6: two Kinect frames, M = 1000, up to 5 deg", "points M", _fig6, repeats=2.0, note=KINECT_NOTE
    ),
    Experiment("fig7", "Fig. 7: bun180 and bun270, M = 1000, 30 to 50 deg", "points M", _fig7, repeats=2.0),
    Experiment("lidar", "Tables 1 and 2: lidar, up to 1 m and 1 deg off", "m, deg", _lidar, 0.5, 1.0, 0.2),
)
