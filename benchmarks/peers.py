"""Other people's registrations, as they are installed by pip, on a trial whose unit is made the point spacing.

Each peer has two settings that a careful user would try; the benchmark takes the better one for each experiment, found
on seeds of its own. All begin where our layer begins: in place, or centroid on centroid, whichever lies better.
"""

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import small_gicp
import torch
from scipy.spatial import KDTree

from bbr_layer import RigidMotion, estimate_normals, point_spacing
from benchmarks.paper_trials import Trial
from benchmarks.symmetric_icp import symmetric_icp

MISSING = "the peers need Open3D, which is not installed: pip install '.[peers]', or leave out --peers"
STEPS = 100  # at most, of every iterative peer; the libraries' defaults (20 to 30) stop some of them early
MATCH_SPACINGS = 4.0  # beyond a few of these many spacings a distance counts as no match, when two starts are compared
FPFH_NEIGHBOURS, RANSAC_TRIES = 100, 100_000
TIGHT = 1e-6  # radians, spacings, and shares: when a peer's step counts as none


class Clouds(NamedTuple):
    """A trial in point spacings about the target's centroid; normals estimated where none are given."""

    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    start: np.ndarray


def in_spacings(trial: Trial) -> tuple[Clouds, np.ndarray, float]:
    """The clouds, and the centre and the unit to go back by."""
    unit = trial.unit or float((point_spacing(trial.P) + point_spacing(trial.Q)) / 2)
    normals = [
        (estimate_normals(x) if given is None else given).numpy()
        for x, given in ((trial.P, trial.P_normals), (trial.Q, trial.Q_normals))
    ]
    centre = trial.P.mean(0).numpy()
    P, Q = (np.ascontiguousarray((x.numpy() - centre) / unit) for x in (trial.P, trial.Q))
    return Clouds(P, Q, *normals, better_start(P, Q)), centre, unit


def better_start(P: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """The identity or centroid on centroid ``(4, 4)``: as our layer chooses."""
    tree, centred = KDTree(P), np.eye(4)
    centred[:3, 3] = P.mean(0) - Q.mean(0)
    some = Q[:: max(1, len(Q) // 500)]

    def misfit(motion: np.ndarray) -> float:
        squared = tree.query(some + motion[:3, 3])[0] ** 2
        return float((squared / (squared + MATCH_SPACINGS**2)).mean())

    return min((np.eye(4), centred), key=misfit)


def found_by(solve: Callable[[Clouds], np.ndarray], trial: Trial) -> RigidMotion:
    """The peer's motion in the trial's own unit and place."""
    clouds, centre, unit = in_spacings(trial)
    motion = solve(clouds)
    rotation = motion[:3, :3]
    translation = motion[:3, 3] * unit + centre - rotation @ centre
    return RigidMotion(torch.from_numpy(rotation.copy()), torch.from_numpy(translation))


def open3d() -> ModuleType:
    """Open3D, or a sentence that says how to get it."""
    try:
        import open3d
    except ImportError as error:
        raise SystemExit(f"{MISSING} ({error})") from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    open3d.utility.random.seed(0)
    return open3d


def _point_clouds(clouds: Clouds) -> tuple[Any, Any]:
    made = []
    for points, normals in ((clouds.P, clouds.P_normals), (clouds.Q, clouds.Q_normals)):
        cloud = open3d().geometry.PointCloud(open3d().utility.Vector3dVector(points))
        cloud.normals = open3d().utility.Vector3dVector(normals)
        made.append(cloud)
    return made[0], made[1]


def tukey(kind: str, runs: tuple[tuple[float, float], ...], clouds: Clouds) -> np.ndarray:
    """Open3D's ICP with a Tukey kernel, run after run of (farthest match, kernel width), both in spacings."""
    r, (target, source), motion = open3d().pipelines.registration, _point_clouds(clouds), clouds.start
    run = r.registration_symmetric_icp if kind == "Symmetric" else r.registration_icp
    for reach, width in runs:
        estimation = getattr(r, f"TransformationEstimation{kind}")(r.TukeyLoss(k=width))
        motion = run(source, target, reach, motion, estimation, _criteria()).transformation
    return np.asarray(motion)


def open3d_gicp(reach: float, clouds: Clouds) -> np.ndarray:
    """Open3D's generalized ICP, which finds its own normals from the clouds."""
    r, (target, source) = open3d().pipelines.registration, _point_clouds(clouds)
    target.normals.clear(), source.normals.clear()
    estimation = r.TransformationEstimationForGeneralizedICP()
    answer = r.registration_generalized_icp(source, target, reach, clouds.start, estimation, _criteria())
    return np.asarray(answer.transformation)


def _criteria() -> Any:
    return open3d().pipelines.registration.ICPConvergenceCriteria(TIGHT, TIGHT, STEPS)


def fpfh(radius: float, reach: float, clouds: Clouds) -> np.ndarray:
    """FPFH features within ``radius``, RANSAC with inliers within ``reach``, then the narrow symmetric ICP."""
    o3d, (target, source) = open3d(), _point_clouds(clouds)
    r = o3d.pipelines.registration
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=FPFH_NEIGHBOURS)
    features = [r.compute_fpfh_feature(cloud, near) for cloud in (source, target)]
    checkers = [
        r.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        r.CorrespondenceCheckerBasedOnDistance(reach),
    ]
    estimation, limit = r.TransformationEstimationPointToPoint(), r.RANSACConvergenceCriteria(RANSAC_TRIES, 0.999)
    coarse = r.registration_ransac_based_on_feature_matching(
        source, target, *features, True, reach, estimation, 3, checkers, limit
    )
    return tukey("Symmetric", ((5.0, 2.0),), clouds._replace(start=np.asarray(coarse.transformation)))


def fast_gicp(reach: float, voxel: float | None, clouds: Clouds) -> np.ndarray:
    """small_gicp's GICP, or VGICP with the voxel given; both find their own covariances."""
    target, source = small_gicp.PointCloud(clouds.P), small_gicp.PointCloud(clouds.Q)
    for cloud in (target, source):
        small_gicp.estimate_covariances(cloud, num_neighbors=10)
    settings = dict(max_correspondence_distance=reach, max_iterations=STEPS)
    settings |= dict(rotation_epsilon=TIGHT, translation_epsilon=TIGHT)
    if voxel is None:
        found = small_gicp.align(target, source, small_gicp.KdTree(target), clouds.start, "GICP", **settings)
    else:
        voxels = small_gicp.GaussianVoxelMap(voxel)
        voxels.insert(target)
        found = small_gicp.align(voxels, source, clouds.start, **settings)
    return np.asarray(found.T_target_source)


def numpy_symmetric(reach: float, clouds: Clouds) -> np.ndarray:
    """Our own short symmetric ICP."""
    return symmetric_icp(clouds.P, clouds.Q, (clouds.P_normals, clouds.Q_normals), clouds.start, reach)


Solve = Callable[[Clouds], np.ndarray]
WIDE, NARROW = ((20.0, 10.0), (5.0, 2.0)), ((10.0, 5.0), (3.0, 1.0))
# By name: the two settings, each with its words. All lengths in point spacings.
PEERS: dict[str, dict[str, Solve]] = {
    "Open3D symmetric": {f"(match, kernel) {x[0]}, {x[1]}": partial(tukey, "Symmetric", x) for x in (WIDE, NARROW)},
    "Open3D point-to-plane": {
        f"(match, kernel) {x[0]}, {x[1]}": partial(tukey, "PointToPlane", x) for x in (WIDE, NARROW)
    },
    "Open3D GICP": {f"match {x:g}": partial(open3d_gicp, x) for x in (10.0, 2.0)},
    "small_gicp GICP": {f"match {x:g}": partial(fast_gicp, x, None) for x in (10.0, 2.0)},
    "small_gicp VGICP": {f"voxel {x:g}": partial(fast_gicp, 20.0, x) for x in (6.0, 3.0)},
    "FPFH + RANSAC": {f"radius {x:g}, inlier {y:g}": partial(fpfh, x, y) for x, y in ((10.0, 2.0), (5.0, 1.5))},
    "numpy symmetric ICP": {f"reach {x:g} deviations": partial(numpy_symmetric, x) for x in (1.0, 2.5)},
}
