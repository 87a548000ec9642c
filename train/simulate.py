"""Scanning a simulated world: rays cast against walls, furniture and whatever moves, in 2D and 3D."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from train.floor_plans import draw_floor_plan
from train.movers import FARTHEST_COMPANION, Mover, draw_movers
from train.routes import SCAN_PERIOD_S, draw_route, drive
from train.world_settings import DEFAULTS as DEFAULTS
from train.world_settings import WorldSettings as WorldSettings
from train.worlds import build_world

# The plane of a 2D safety scanner above the floor, metres: below desks, above thresholds.
SENSOR_HEIGHT_2D = 0.3
# Lowest and highest ring of a Velodyne VLP-16 (user manual 63-9243), degrees.
RING_ELEVATIONS_DEG = (-15.0, 15.0)


@dataclass(frozen=True)
class SimulatedScans:
    """Scans of a simulated world and the truth about them; lengths in metres.

    ``points``: k arrays ``(n_i, d)``, each in its own sensor frame (x ahead, y left, z up, sensor at 0).
    ``world_from_scan``: true poses ``(k, 4, 4)``; in 2D z = 0 is the scanned plane, in 3D the floor.
    ``timestamps``: seconds ``(k,)``. ``world``: mesh of all that stands still, in the frame of the poses.
    ``mover_labels``: k arrays ``(n_i,)``, true for points on a mover.
    """

    settings: WorldSettings
    points: list[Float[np.ndarray, "_ d"]]
    world_from_scan: Float[np.ndarray, "k 4 4"]
    timestamps: Float[np.ndarray, "k"]
    world: trimesh.Trimesh
    mover_labels: list[Bool[np.ndarray, "_"]]


def simulate(settings: WorldSettings) -> SimulatedScans:
    """Draw the world that ``settings`` describe, drive a robot through it and scan it.

    The same settings give the same scans. Rays are cast by trimesh, with Embree where ``embreex`` is
    installed and with an R-tree where it is not.

    Raises
    ------
    ValueError: a scan without a single return.
    """
    plan, random = draw_floor_plan(settings), settings.random("route")
    route = draw_route(plan, random)
    world_from_scan, times = drive(route, settings, random)
    world = build_world(plan, route.line(FARTHEST_COMPANION), settings)
    movers = draw_movers(world.open_floor, route, times, settings)
    if settings.dimension == 2:
        for mesh in (world.mesh, *(mover.solid for mover in movers)):
            mesh.apply_translation([0, 0, -SENSOR_HEIGHT_2D])

    directions, noise = ray_directions(settings), settings.random("noise")
    points, labels = [], []
    for scan, pose in enumerate(world_from_scan):
        ranges, on_mover = _cast_at(scan, pose, directions, world.mesh, movers)
        measured = ranges + noise.normal(0, settings.noise_m, size=len(ranges))
        returned = ranges <= settings.range_max_m
        if not returned.any():
            raise ValueError(
                f"no ray of scan {scan} returns: range_max_m is {settings.range_max_m:g}, beams is "
                f"{settings.beams} and field_of_view_deg is {settings.field_of_view_deg:g}; raise one of them"
            )
        points.append((directions * measured[:, None])[returned, : settings.dimension])
        labels.append(on_mover[returned])
    timestamps = SCAN_PERIOD_S * np.arange(settings.scans)
    return SimulatedScans(settings, points, world_from_scan, timestamps, world.mesh, labels)


def ray_directions(settings: WorldSettings) -> Float[np.ndarray, "n 3"]:
    """Unit vectors of all rays in the sensor frame, ring by ring from below, each ring from right to left."""
    view = np.deg2rad(settings.field_of_view_deg)
    azimuths = view * ((np.arange(settings.beams) + 0.5) / settings.beams - 0.5)
    elevations = np.zeros(1)
    if settings.dimension == 3 and settings.rings > 1:
        elevations = np.deg2rad(np.linspace(*RING_ELEVATIONS_DEG, settings.rings))
    elevation, azimuth = (grid.ravel() for grid in np.meshgrid(elevations, azimuths, indexing="ij"))
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _cast_at(
    scan: int,
    world_from_scan: Float[np.ndarray, "4 4"],
    directions: Float[np.ndarray, "n 3"],
    world: trimesh.Trimesh,
    movers: list[Mover],
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Range of every ray, infinite where it meets nothing, and whether what it meets is a mover."""
    rays = directions @ world_from_scan[:3, :3].T
    origins = np.broadcast_to(world_from_scan[:3, 3], rays.shape)
    still = _ranges(world, origins, rays)
    nearest = still
    for mover in movers:
        nearest = np.minimum(nearest, _ranges(mover.solid, *mover.into_own_frame(scan, origins, rays)))
    return nearest, nearest < still


def _ranges(
    mesh: trimesh.Trimesh, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Distance along every ray to the first surface of ``mesh``, infinite where there is none."""
    hits, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    ranges = np.full(len(origins), np.inf)
    ranges[rays] = np.linalg.norm(hits - origins[rays], axis=1)
    return ranges
