"""Who solves the graph to which wrong loops are added: our mapper, and a point-to-line ICP with a pose graph."""

from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from bbr_layer import RigidMotion
from benchmarks.map_rivals import point_to_line
from benchmarks.map_rivals.chain import along, chained, in_own_unit, reach
from benchmarks.mapping_rows import Row
from benchmarks.mapping_table import map_errors
from train.agreement import agreed_poses
from train.config import EdgeConfig
from train.edges import refined, register_edges
from train.loops import DOUBTED
from train.pose_graph import Edges, solve_pose_graph
from train.prepared import prepare, thinned
from train.scans import Progress, ScanSet, silent
from train.scene import build_scene
from train.spanning_tree import spanning_poses


class Solved(NamedTuple):
    """The error of a map in its row's unit, and how many of the wrong loops were believed."""

    error: float
    believed: int


class Solver(Protocol):
    """Registered edges, which are made once, and what answers with a map of them.

    Attributes
    ----------
    edges, poses: the registered edges, and poses that they agree on.
    reach: radius of a scan, in the unit of the poses.
    """

    edges: Edges
    poses: RigidMotion
    reach: float

    def __call__(self, edges: Edges, wrong: int) -> Solved:
        """The map of edges of which the last ``wrong`` are wrong."""


class Ours:
    """The mapper's own edges, pose graph and refinement."""

    def __init__(self, row: Row, scans: ScanSet, told: Progress) -> None:
        self.row, self.scans, config = row, scans, EdgeConfig()
        self.edges, self.poses = register_edges(scans, config, told)
        self.reach = float(np.median([np.median(np.linalg.norm(points, axis=1)) for points in scans.points]))
        self.full = prepare(scans, config.refined_points)
        self.scene = build_scene(scans, thinned(self.full, config.points))

    def __call__(self, edges: Edges, wrong: int) -> Solved:
        """From the poses of the chain and the window."""
        sure = edges.kept(edges.kind < 2)
        begin, _ = solve_pose_graph(sure, spanning_poses(edges.kept(edges.kind == 0), len(self.scans)))
        poses, belief = agreed_poses(self.scene, edges, (begin,))
        found = refined(self.full, self.scene, (edges, belief), poses, silent).matrix.numpy()
        return Solved(map_errors(found, self.scans, self.row)[self.row.error], _believed(belief, wrong))


class PointToLineGraph:
    """``benchmarks.map_rivals.point_to_line`` at one setting, its graph solved from its chain; in reaches."""

    def __init__(self, row: Row, scans: ScanSet, setting: tuple[float, bool], told: Progress) -> None:
        self.row, self.scans, self.unit, self.reach = row, scans, reach(scans), 1.0
        rival = point_to_line.PointToLine(scans, setting[0])
        self.edges, matrices = point_to_line.agreed_edges(rival, chained(rival, 3, setting[1], told), told)
        self.poses = point_to_line.motions_of(matrices)

    def __call__(self, edges: Edges, wrong: int) -> Solved:
        """From the poses of the chain."""
        chain = edges.kept(edges.kind == 0).target_from_source.matrix.numpy()
        poses, belief = solve_pose_graph(edges, point_to_line.motions_of(along(chain)))
        found = in_own_unit(poses.matrix.numpy(), self.unit)
        return Solved(map_errors(found, self.scans, self.row)[self.row.error], _believed(belief, wrong))


def _believed(belief: Tensor, wrong: int) -> int:
    return int((belief[len(belief) - wrong :] > DOUBTED).sum())
