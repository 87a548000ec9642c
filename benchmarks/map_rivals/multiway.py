"""Open3D's multiway registration, as its tutorial builds it: point-to-plane ICP, a pose graph, doubtful edges pruned.

Beyond the tutorial: pairs that are no neighbours begin at the chain's poses, and only those of a window and loop
candidates are registered, as all pairs of a long sequence have little in common.
"""

from typing import Any, NamedTuple

import numpy as np

from benchmarks.map_rivals.chain import (
    FEATURES,
    PLAIN,
    YAW,
    Overlap,
    Solutions,
    along,
    best_overlap,
    chained,
    from_turned_starts,
    in_own_unit,
    in_reaches,
    loop_pairs,
    reach,
    window_pairs,
)
from benchmarks.peers import open3d
from train.scans import Progress, ScanSet

# The tutorials' numbers: the last gate, radii of normals and features, and RANSAC's gate, all in voxels; the neighbours
# looked at, and the threshold of edges that are pruned.
LAST_GATE, NORMAL_RADIUS, FEATURE_RADIUS, RANSAC_GATE = 1.5, 2.0, 5.0, 1.5
NORMAL_NEIGHBOURS, FEATURE_NEIGHBOURS, PRUNED = 30, 100, 0.25
RANSAC_TRIES, SURE = 100_000, 0.999
# Least voxel of clouds that are described by features, reaches: RANSAC's time grows with their number.
FEATURE_VOXEL = 0.05
# The defaults of the library: at most so many steps a run, and a relative gain that counts as none.
STEPS, TIGHT = 30, 1e-6


class Setting(NamedTuple):
    """The voxel, and the farthest matches of all runs but the last, in reaches."""

    voxel: float
    gates: tuple[float, ...]


class Multiway:
    """Pairs of scans by point-to-plane ICP on their voxels."""

    def __init__(self, scans: ScanSet, setting: Setting) -> None:
        o3d, voxel = open3d(), setting.voxel
        near = o3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_RADIUS * voxel, max_nn=NORMAL_NEIGHBOURS)
        self.points, self.tolerance, self.clouds = in_reaches(scans), voxel, []
        self.gates = (*setting.gates, LAST_GATE * voxel)
        for points in self.points:
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
            cloud.estimate_normals(near)
            self.clouds.append(cloud)

    def register(self, target: int, source: int, start: np.ndarray) -> np.ndarray:
        """``target_from_source (4, 4)``."""
        r = open3d().pipelines.registration
        criteria = r.ICPConvergenceCriteria(TIGHT, TIGHT, STEPS)
        for gate in self.gates:
            estimation = r.TransformationEstimationPointToPlane()
            clouds = self.clouds[source], self.clouds[target]
            start = r.registration_icp(*clouds, gate, start, estimation, criteria).transformation
        return np.asarray(start)

    def edge(self, target: int, source: int, motion: np.ndarray, uncertain: bool) -> Any:
        """An edge of Open3D's graph, which names the scan that moves first."""
        r, gate = open3d().pipelines.registration, self.gates[-1]
        clouds = self.clouds[source], self.clouds[target]
        information = r.get_information_matrix_from_point_clouds(*clouds, gate, motion)
        return r.PoseGraphEdge(source, target, motion, information, uncertain=uncertain)


def from_features(rival: Multiway, motions: np.ndarray, told: Progress) -> np.ndarray:
    """The motions, or what RANSAC on FPFH features and ICP find where scans overlap more under it."""
    o3d, r = open3d(), open3d().pipelines.registration
    voxel = max(rival.tolerance, FEATURE_VOXEL)
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=FEATURE_RADIUS * voxel, max_nn=FEATURE_NEIGHBOURS)
    clouds = [cloud.voxel_down_sample(voxel) for cloud in rival.clouds]
    features = [r.compute_fpfh_feature(cloud, near) for cloud in clouds]
    gate, overlap, found = RANSAC_GATE * voxel, Overlap(rival.points, rival.tolerance), motions.copy()
    checkers = [r.CorrespondenceCheckerBasedOnEdgeLength(0.9), r.CorrespondenceCheckerBasedOnDistance(gate)]
    estimation, limit = r.TransformationEstimationPointToPoint(), r.RANSACConvergenceCriteria(RANSAC_TRIES, SURE)
    for pair in range(len(motions)):
        told("features", pair, len(motions))
        both = (clouds[pair + 1], clouds[pair], features[pair + 1], features[pair])
        coarse = r.registration_ransac_based_on_feature_matching(*both, True, gate, estimation, 3, checkers, limit)
        tried = rival.register(pair, pair + 1, coarse.transformation)
        found[pair] = best_overlap(overlap, pair, [motions[pair], tried])
    return found


def optimised(rival: Multiway, motions: np.ndarray, told: Progress) -> np.ndarray:
    """Poses ``(k, 4, 4)`` of the graph of the chain, a window and loops, in reaches."""
    r, poses = open3d().pipelines.registration, along(motions)
    graph = r.PoseGraph()
    for pose in poses:
        graph.nodes.append(r.PoseGraphNode(pose))
    for pair, motion in enumerate(motions):
        graph.edges.append(rival.edge(pair, pair + 1, motion, uncertain=False))
    others = window_pairs(len(poses)) + loop_pairs(poses)
    for done, (i, j) in enumerate(others):
        motion = rival.register(i, j, np.linalg.inv(poses[i]) @ poses[j])
        graph.edges.append(rival.edge(i, j, motion, uncertain=True))
        told("window and loops", done + 1, len(others))
    method, criteria = r.GlobalOptimizationLevenbergMarquardt(), r.GlobalOptimizationConvergenceCriteria()
    r.global_optimization(
        graph, method, criteria, r.GlobalOptimizationOption(rival.gates[-1], PRUNED, reference_node=0)
    )
    return np.stack([np.asarray(node.pose) for node in graph.nodes])


def solved(scans: ScanSet, setting: Setting, told: Progress) -> Solutions:
    """Poses ``(k, 4, 4)``, from each kind of start."""
    rival, unit = Multiway(scans, setting), reach(scans)
    motions = chained(rival, 4, False, told)
    plain = optimised(rival, motions, told)
    yield PLAIN, in_own_unit(plain, unit)
    for name, again in ((YAW, from_turned_starts), (FEATURES, from_features)):
        found = again(rival, motions, told)
        same = np.array_equal(found, motions)
        yield name, in_own_unit(plain if same else optimised(rival, found, told), unit)
