"""Loops found from no poses: scans that look alike, registered, and believed where others nearby say the same."""

import torch
from torch import Tensor

from bbr_layer import RigidMotion
from train.chain import FOUND
from train.pair_registration import register_pairs
from train.places import alike
from train.pose_graph import Edges
from train.scans import Progress
from train.scene import Scene, apart

# Most key scans, spread evenly over the sequence, and how many of the likest pairs are registered, per key scan.
KEYS, PAIRS_PER_KEY = 48, 2
# Another loop is a witness when, between scans this many keys away at most, it leads to the same motion along the
# chain, within so many point spacings.
NEAR_KEYS, SAME = 3, 5.0
# Fewest witnesses of a loop that is believed, and fewest as a share of the most that a loop has. Rooms that look alike
# have witnesses too, but few, and low scores: hence the share, and ``FOUND``, without which some of the floor plans of
# benchmarks/mapping_rivals.md end metres off.
WITNESSES, SHARE = 3, 0.2


def recognised(scene: Scene, edges: Edges, poses: RigidMotion, later: int, progress: Progress) -> Edges:
    """Loops between planar scans at least ``later`` numbers from each other, whatever the poses say of them.

    Parameters
    ----------
    scene: planar scans.
    edges: those there are.
    poses: ``world_from_scan (k, ...)``, right from each scan to those near it in time, except here and there.
    """
    step = -(-len(scene.surfaces) // KEYS)
    keys = list(range(0, len(scene.surfaces), step))
    likeness = alike(scene, keys, later, progress)
    few = slice(PAIRS_PER_KEY * len(keys))
    pairs = likeness.target[few], likeness.source[few]
    if not len(pairs[0]):
        return edges.kept(edges.kind < 0)
    found = register_pairs(scene, pairs, likeness.target_from_source.item(few), 2, progress)
    seen = witnesses(scene, found, poses, NEAR_KEYS * step)
    good = found.score >= FOUND * edges.score[edges.kind == 0].median()
    return found.kept(good & (seen >= max(WITNESSES, SHARE * int(seen.max()))))


def witnesses(scene: Scene, loops: Edges, poses: RigidMotion, near: int) -> Tensor:
    """How many other loops say the same as each, ``(e,)``, of those at most ``near`` scans away at both ends.

    Another loop says the same when it and the motion along the poses, from its scans to these, lead to where this one
    puts the source's points.
    """
    counts = []
    for loop, (i, j) in enumerate(zip(loops.target.tolist(), loops.source.tolist(), strict=True)):
        close = ((loops.target - i).abs() <= near) & ((loops.source - j).abs() <= near)
        close[loop] = False
        others = loops.kept(close)
        forth = poses.between(torch.full_like(others.target, i), others.target)
        back = poses.between(others.source, torch.full_like(others.source, j))
        led = forth @ others.target_from_source @ back
        this = loops.target_from_source.item(torch.full_like(others.target, loop))
        away = apart(scene, torch.full_like(others.source, j), led, this)
        counts.append((away < SAME * scene.spacing).sum())
    return torch.stack(counts) if counts else torch.zeros(0, dtype=torch.int64)
