"""The figures of a run, and plain values written as JSON and YAML."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float

from bbr_layer import atomic_write
from train.evaluate import evaluate_trajectory
from train.map_entropy import mean_map_entropy
from train.pose_graph import Edges
from train.poses import embed_poses
from train.scans import ScanSet

# Radius of the map entropy as a share of the median range: it depends on the scans alone, so that maps of the same
# scans can be compared; about 0.7 m for a street and 0.1 m for an office.
ENTROPY_RADIUS = 0.05
EDGE_KINDS = {"odometry": 0, "window": 1, "loop": 2}


def map_metrics(
    scans: ScanSet,
    world_from_scan: Float[np.ndarray, "k d1 d1"],
    world_points: Float[np.ndarray, "n d"],
    edges: Edges | None = None,
) -> dict[str, object]:
    """What can be said in numbers about a map: sizes, edges, entropy and, where the truth is known, its errors.

    Parameters
    ----------
    scans: k scans; with their truth there is ``trajectory``, with starting poses too ``trajectory_at_start``.
    world_from_scan: the poses that were found, ``(k, d + 1, d + 1)``.
    world_points: the scans' points carried by these poses, ``(n, d)``.
    edges: the registered pairs, or None.
    """
    ranges = np.linalg.norm(np.concatenate(scans.points), axis=1)
    radius = ENTROPY_RADIUS * float(np.median(ranges))
    steps = np.diff(embed_poses(world_from_scan)[:, :3, 3], axis=0)
    metrics: dict[str, object] = {
        "scans": len(scans),
        "points": len(world_points),
        "dimension": scans.dimension,
        "path_length": float(np.linalg.norm(steps, axis=1).sum()),
        "map_entropy": mean_map_entropy(world_points, radius) if radius > 0 else math.nan,
        "map_entropy_radius": radius,
    }
    if edges is not None:
        kinds = np.asarray(edges.kind)
        metrics["edges"] = {name: int((kinds == kind).sum()) for name, kind in EDGE_KINDS.items()}
    if scans.truth is not None:
        metrics["trajectory"] = evaluate_trajectory(world_from_scan, scans.truth, scans.points)
        if scans.start is not None:
            metrics["trajectory_at_start"] = evaluate_trajectory(scans.start, scans.truth, scans.points)
    return metrics


def write_json(path: str | Path, values: Mapping[str, object]) -> None:
    """Write values as JSON; numbers that are not finite, which JSON does not know, become null."""
    text = json.dumps(_plain(values, finite=True), indent=2, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_yaml(path: str | Path, values: Mapping[str, object]) -> None:
    """Write values as YAML that ``yaml.safe_load`` reads back, in the order given."""
    text = yaml.safe_dump(_plain(values, finite=False), sort_keys=False, allow_unicode=True)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: object, *, finite: bool) -> object:
    """The value made of dict, list, str, numbers, bool and None only.

    Raises
    ------
    ValueError: a value of another type.
    """
    if isinstance(value, Mapping):
        return {str(key): _plain(below, finite=finite) for key, below in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), finite=finite)
    if isinstance(value, list | tuple):
        return [_plain(below, finite=finite) for below in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and finite and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise ValueError(f"a value of type {type(value).__name__} cannot be written; give plain numbers, text and lists")
