"""First poses from registered edges: along the tree of the best ones."""

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from bbr_layer import RigidMotion
from train.pose_graph import Edges


def spanning_poses(edges: Edges, scans: int) -> RigidMotion:
    """``world_from_scan`` along the tree of the best edges, the first scan at the origin, ``(scans, ...)``.

    Raises
    ------
    ValueError: the edges do not join all scans.
    """
    d = edges.centre.shape[-1]
    numbers = (edges.target.numpy(), edges.source.numpy())
    # Costs are positive, as a sparse 0 would be no edge; of two edges of one pair the best is left.
    costs = 2.0 - edges.score.clamp(0, 1).numpy()
    best = {(int(numbers[0][edge]), int(numbers[1][edge])): edge for edge in np.argsort(-costs).tolist()}
    kept = np.array(list(best.values()))
    graph = csr_array((costs[kept], (numbers[0][kept], numbers[1][kept])), shape=(scans, scans))
    order, before = breadth_first_order(minimum_spanning_tree(graph), 0, directed=False)
    if len(order) != scans:
        raise ValueError(f"{len(kept)} edges join {len(order)} scans to the first; there are {scans} to be joined")
    poses = {0: RigidMotion.identity(d)}
    for scan in order[1:].tolist():
        last = int(before[scan])
        forth = best.get((last, scan))
        motion = edges.target_from_source
        poses[scan] = poses[last] @ (
            motion.item(forth) if forth is not None else motion.item(best[scan, last]).inverse()
        )
    return RigidMotion(*(torch.stack(field) for field in zip(*(poses[scan] for scan in range(scans)), strict=True)))
