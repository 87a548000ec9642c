"""Everything a run leaves behind: poses, map, pictures, occupancy, metrics and the settings that made them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from bbr_layer import atomic_write, write_cloud, write_poses_kitti, write_poses_tum
from train.browser_map import write_browser_map
from train.curves import losses_picture, trajectory_picture
from train.drawing import HEIGHT_COLOURS, HEIGHT_QUANTILES, TIME_COLOURS, save_picture
from train.moving_points import MovingPoints
from train.occupancy_grid import OccupancyGrid, occupancy_grid
from train.pictures import floor_plan, network_field, top_and_side_view
from train.pose_graph import Edges
from train.poses import embed_poses
from train.report import map_metrics, write_json, write_yaml
from train.ros_map import write_ros_map
from train.run_folder import MAP
from train.scans import Progress, ScanSet, silent

# Kind of edge that joins scans far apart in time.
LOOP = 2
# Written only where there is something to show; a run takes away those of an earlier one in the same folder.
OPTIONAL = ("poses_kitti.txt", "losses.png", "occupancy_network.png", "movers.ply")


@dataclass(frozen=True)
class MapResult:
    """What a run found, and how.

    Parameters
    ----------
    scans: the k scans, with their truth where it is known.
    world_from_scan: the poses that were found, ``(k, d + 1, d + 1)``.
    edges: the registered pairs, or None.
    occupancy: world points ``(n, d)`` to probabilities ``(n,)``, the occupancy network's; or None.
    losses: curves over the epochs, by name.
    settings: what was used, as plain values; ``config.yaml`` holds exactly this.
    timings: seconds, by stage.
    unit: name of the data's unit, for labels: "m", "px".
    """

    scans: ScanSet
    world_from_scan: Float[np.ndarray, "k d1 d1"]
    edges: Edges | None = None
    occupancy: Callable[[np.ndarray], np.ndarray] | None = None
    losses: dict[str, list[float]] = field(default_factory=dict)
    settings: dict[str, object] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)
    unit: str = "units"

    @property
    def positions(self) -> Float[np.ndarray, "k d"]:
        """Where the sensor was."""
        d = self.scans.dimension
        return self.world_from_scan[:, :d, d]

    def world_points(self) -> Float[np.ndarray, "n d"]:
        """Every point of every scan, in the world frame."""
        d = self.scans.dimension
        placed = zip(self.scans.points, self.world_from_scan, strict=True)
        return np.concatenate([scan @ pose[:d, :d].T + pose[:d, d] for scan, pose in placed])


def write_outputs(out: str | Path, result: MapResult, progress: Progress = silent) -> dict[str, object]:
    """Write the run's files into the folder ``out``, made if it is missing; each file whole or not at all.

    ``poses_tum.txt``, ``poses_kitti.txt`` (3D), ``poses.npz``; ``map.ply`` with, of each point, the number of its scan
    and the share of other scans that saw through it; ``movers.ply``, the points that more scans saw through than found
    and that therefore left the map; ``trajectory.png``, ``map.png``, ``losses.png``; ``occupancy.png`` with
    ``occupancy.yaml`` (map_server), ``occupancy_network.png``; ``map.html``; ``metrics.json``; ``config.yaml``. Last of
    all ``poses.npz``: where it is, the rest is too. Returns what ``metrics.json`` holds.

    Raises
    ------
    ValueError: poses that are not finite or do not fit the scans; nothing is written then.
    OSError: the folder or a file cannot be written.
    """
    _check(result)
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{out} is a file; name a folder for the outputs")
    folder.mkdir(parents=True, exist_ok=True)
    for name in OPTIONAL:
        (folder / name).unlink(missing_ok=True)
    everything = result.world_points()
    moving = MovingPoints(result.scans, result.edges, result.world_from_scan)
    points = everything[~moving.moved]
    _write_trajectories(folder, result)
    write_yaml(folder / "config.yaml", result.settings)
    metrics = map_metrics(result.scans, result.world_from_scan, points, result.edges)
    metrics |= {"unit": result.unit, "notes": result.scans.notes, "timings": result.timings, "losses": result.losses}
    metrics["moving_points"] = int(moving.moved.sum())
    write_json(folder / "metrics.json", metrics)
    _write_map(folder / "map.ply", result, everything, moving, ~moving.moved)
    if moving.moved.any():
        _write_map(folder / "movers.ply", result, everything, moving, moving.moved)
    grid = occupancy_grid(result.scans.points, result.world_from_scan, progress=progress)
    write_ros_map(folder / "occupancy.png", grid)
    pictures = _pictures(result, points, grid)
    for number, (name, draw) in enumerate(pictures.items()):
        save_picture(draw(), folder / name)
        progress("pictures", number + 1, len(pictures))
    write_browser_map(folder / "map.html", points, result.positions, result.unit, names=result.scans.names)
    _write_poses(folder / MAP, result)
    return metrics


def _check(result: MapResult) -> None:
    k, side = len(result.scans), result.scans.dimension + 1
    if result.world_from_scan.shape != (k, side, side):
        raise ValueError(f"world_from_scan has shape {result.world_from_scan.shape}; {k} scans need {(k, side, side)}")
    lost = ~np.isfinite(result.world_from_scan).all(axis=(1, 2))
    if lost.any():
        name = result.scans.names[int(np.argmax(lost))]
        raise ValueError(f"world_from_scan is not finite, first at scan {name}; the map diverged: lower its rates")


def _write_trajectories(folder: Path, result: MapResult) -> None:
    poses = embed_poses(result.world_from_scan)
    write_poses_tum(folder / "poses_tum.txt", poses, result.scans.timestamps)
    if result.scans.dimension == 3:
        write_poses_kitti(folder / "poses_kitti.txt", poses)


def _write_poses(path: Path, result: MapResult) -> None:
    scans = result.scans
    named = {"world_from_scan": result.world_from_scan, "start": scans.start, "truth": scans.truth}
    arrays: dict[str, Any] = {name: embed_poses(poses) for name, poses in named.items() if poses is not None}
    arrays |= {"timestamps": scans.timestamps, "names": np.array(scans.names)}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def _write_map(path: Path, result: MapResult, points: np.ndarray, moving: MovingPoints, kept: np.ndarray) -> None:
    """The ``kept`` points with the number of their scan, coloured by height (3D) or by scan (2D)."""
    scan = np.repeat(np.arange(len(result.scans), dtype=np.int32), [len(one) for one in result.scans.points])
    values = points[:, 2] if result.scans.dimension == 3 else scan
    low, high = np.quantile(values, HEIGHT_QUANTILES) if result.scans.dimension == 3 else (0, len(result.scans) - 1)
    shades = HEIGHT_COLOURS if result.scans.dimension == 3 else TIME_COLOURS
    colours = shades(np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0, 1), bytes=True)[:, :3]
    columns = {"scan": scan[kept], "seen_through": moving.share[kept].astype(np.float32)}
    write_cloud(path, points[kept], columns=columns, colours=colours[kept])


def _pictures(result: MapResult, points: np.ndarray, grid: OccupancyGrid) -> dict[str, Callable[[], Figure]]:
    """The pictures by file name, each drawn when called."""
    positions, unit, truth = result.positions, result.unit, result.scans.truth
    loops = [] if result.edges is None else _loops(result.edges)
    pictures: dict[str, Callable[[], Figure]] = {
        "trajectory.png": lambda: trajectory_picture(result.world_from_scan, truth, unit, loops=loops),
        "map.png": lambda: floor_plan(points, positions, grid, unit),
    }
    if result.scans.dimension == 3:
        pictures["map.png"] = lambda: top_and_side_view(points, positions, unit)
    if any(result.losses.values()):
        pictures["losses.png"] = lambda: losses_picture(result.losses)
    if (occupancy := result.occupancy) is not None:
        pictures["occupancy_network.png"] = lambda: network_field(occupancy, positions, grid, unit)
    return pictures


def _loops(edges: Edges) -> list[tuple[int, int]]:
    chosen = edges.kind == LOOP
    return list(zip(edges.target[chosen].tolist(), edges.source[chosen].tolist(), strict=True))
