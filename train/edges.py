"""Scans to poses: neighbours, window and loops registered by the layer, a pose graph, a refinement of all poses."""

import torch
from torch import Tensor

from bbr_layer import RigidMotion
from train.agreement import agreed_poses
from train.chain import POOR, all_pairs, consecutive
from train.config import EdgeConfig
from train.free_space_evidence import point_evidence
from train.given_motion import clear, with_given, without_given
from train.loops import DOUBTED, again, apart_in_time, loops, point_weights
from train.pair_registration import register_pairs
from train.pose_graph import Edges, disagreement, solve_pose_graph
from train.prepared import Prepared, prepare, thinned
from train.recognition import recognised
from train.refinement import refine
from train.scan_checks import check_depth
from train.scans import Progress, ScanSet, silent
from train.scene import Scene, build_scene
from train.spanning_tree import spanning_poses
from train.surfaces import Surface, surfaces
from train.usual_speed import at_usual_speed

# Of up to so many scans in space all pairs are sought by features when their chain is broken: they came in any order.
FEW_SCANS = 20
# While a scan still moves by more than a point spacing, loops are sought in up to so many times the rounds asked for.
LONGEST = 4

# Width, in point spacings, of the kernel by which an edge near the poses counts in the refinement, whatever the graph
# made of it: in full where they agree, no more at a width's distance, where the kernel is a quarter, under DOUBTED.
# Chosen: 1 is as good in the narrow view of v1_pose0 but worse on kitti07, 0.3 less good in the narrow view.
NEAR = 0.5

# Edges, the poses they led to, and how far each edge was believed.
Graph = tuple[Edges, RigidMotion, Tensor]


def register_edges(scans: ScanSet, config: EdgeConfig, progress: Progress = silent) -> tuple[Edges, RigidMotion]:
    """Register neighbouring scans with the layer, close loops, solve for the poses and refine them together.

    Parameters
    ----------
    scans: k scans; given starting poses are used, otherwise every scan is first compared in place with the last.
    config: window, loops and points.
    progress: told ``(stage, done, total)``.

    Returns
    -------
    The registered edges, their score the lower the less they were believed, and ``world_from_scan (k, ...)``; the
    first pose is the given one, or the identity.

    Raises
    ------
    ValueError: scans in space that are all flat.
    """
    if scans.dimension == 3:
        check_depth(scans.points)
    full = prepare(scans, max(config.points, config.refined_points))
    scene = build_scene(scans, thinned(full, config.points))
    edges, poses, belief = _closed(scene, _window(scene, scans, config, progress), config, progress)
    edges, belief = without_given(edges, belief)
    edges = edges._replace(score=edges.score * belief)
    return edges, refined(full, scene, (edges, belief), poses, progress)


def _window(scene: Scene, scans: ScanSet, config: EdgeConfig, progress: Progress) -> Graph:
    """Each scan with those up to ``window`` later, and loops that need no poses where the chain is poor."""
    chain = consecutive(scene, scans, progress)
    replaced = torch.zeros(len(chain.target), dtype=torch.bool)
    if scans.dimension == 2 and scans.start is None:
        chain, replaced = at_usual_speed(scene, chain, progress)
    edges = chain
    broken = bool((chain.score < POOR * chain.score.median()).any())
    if scans.start is not None:
        edges = with_given(chain, scans, scene.spacing)
    if scene.features and broken and len(scans) <= FEW_SCANS:
        edges = edges.joined(all_pairs(scene, chain, progress))
    poses, belief = solve_pose_graph(edges, _anchored(spanning_poses(edges, len(scans)), scans))
    pairs = [(i, i + step) for step in range(2, config.window + 1) for i in range(len(scans) - step)]
    if pairs:
        found = _registered(scene, pairs, poses, replaced, progress)
        edges = edges.joined(found if scans.start is None else clear(found, chain))
        poses, belief = solve_pose_graph(edges, poses)
    if scans.dimension == 2 and broken and scans.start is None and config.loops_per_scan:
        edges = edges.joined(recognised(scene, edges, poses, apart_in_time(config), progress))
        poses, belief = solve_pose_graph(edges, poses)
    return edges, poses, belief


def _registered(
    scene: Scene, pairs: list[tuple[int, int]], poses: RigidMotion, replaced: Tensor, progress: Progress
) -> Edges:
    """The pairs of the window, registered from the poses; with a finite reach across a step that was ``replaced``."""
    target, source = torch.tensor(pairs).unbind(1)
    doubtful = torch.tensor([bool(replaced[i:j].any()) for i, j in pairs])
    found = []
    for rows, far in ((torch.nonzero(~doubtful)[:, 0], True), (torch.nonzero(doubtful)[:, 0], False)):
        if len(rows):
            ends = target[rows], source[rows]
            found.append(register_pairs(scene, ends, poses.between(*ends), 1, progress, far=far))
    return found[0] if len(found) == 1 else found[0].joined(found[1])


def _closed(scene: Scene, graph: Graph, config: EdgeConfig, progress: Progress) -> Graph:
    """The graph with loops between scans that the poses put close together, as often as that moves the poses."""
    edges, poses, belief = graph
    for turn in range(LONGEST * config.rounds if config.loops_per_scan else 0):
        before, weights = poses, point_weights(scene, edges, poses)
        edges = again(scene, edges, belief, poses, weights)
        edges = edges.kept((edges.kind != 2) | (belief >= DOUBTED))
        edges = edges.joined(loops(scene, poses, edges, config, progress, weights=weights))
        starts = (poses, graph[1]) if turn else (poses,)  # the same ones in the first round
        poses, belief = agreed_poses(scene, edges, starts)
        moved = torch.linalg.vector_norm(poses.translation - before.translation, dim=-1).max()
        if turn + 1 >= config.rounds and moved < scene.spacing:
            break
    return edges, poses, belief


def refined(
    full: Prepared, scene: Scene, graph: tuple[Edges, Tensor], poses: RigidMotion, progress: Progress
) -> RigidMotion:
    """Poses at which all scans' points agree; ``graph``: the edges, and how far each was believed."""
    edges, belief = graph
    clouds = surfaces(full)
    pairs = torch.stack((edges.target, edges.source), 1).numpy()
    found = poses.matrix.numpy()
    evidence = point_evidence([scan.points for scan in clouds], (scene.surfaces, scene.views), pairs, found)
    belief = torch.maximum(belief, _nearness(edges, poses, clouds, scene.spacing))
    trust = torch.where(belief > DOUBTED, belief, 0.0).numpy()
    placed = refine(clouds, pairs, found, (trust, [one.weight for one in evidence]), progress)
    return RigidMotion.from_matrix(torch.from_numpy(placed))


def _nearness(edges: Edges, poses: RigidMotion, clouds: list[Surface], spacing: float) -> Tensor:
    """How near the poses have the scans of each edge to where it has them, ``(e,)`` in [0, 1], by Geman-McClure.

    What the graph doubts for the sake of sharper edges may still be near enough for its pairs, which are found anew.
    """
    apart = disagreement(poses.between(edges.target, edges.source), edges)
    radii = torch.tensor([cloud.radius for cloud in clouds])
    shift, turn = apart[:, -poses.dimension :].norm(dim=-1), apart[:, : -poses.dimension].norm(dim=-1)
    return (1 + (shift.square() + (turn * radii[edges.source]).square()) / (NEAR * spacing) ** 2).pow(-2)


def _anchored(poses: RigidMotion, scans: ScanSet) -> RigidMotion:
    """The poses laid onto the first given one, if poses were given."""
    if scans.start is None:
        return poses
    first = RigidMotion.from_matrix(torch.from_numpy(scans.start[0]))
    return first @ poses.item(0).inverse() @ poses
