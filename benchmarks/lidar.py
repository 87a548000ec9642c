"""A forward-only registration of two full lidar scans by BBR-F, nothing thinned: where the seconds go.

    python -m benchmarks.lidar --repeats 3 --out benchmarks/lidar.md

Normals are estimated before the registration, and timed apart. The search alone is driven with the motions that the
registration took, with margins and without.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import small_gicp
import torch
from torch import Tensor

from bbr_layer import Adam, BBRLayer, Detached, RigidMotion, angular_error, estimate_normals
from bbr_layer.margins import Pose
from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.spacing import point_spacing
from benchmarks.data import data_folder
from benchmarks.memory import forget_peak, peak

PAIR = "pair_kitti00_95_94"
STEPS = 100
GICP_NEIGHBOURS = 20  # of its covariances, its own default
RATES = (0.005, 0.02)  # F's default, and one at which the source leaps from step to step


class Scans(NamedTuple):
    """Two scans with their normals, batch of one, float32."""

    P: Tensor
    Q: Tensor
    P_normals: Tensor
    Q_normals: Tensor

    def every(self, stride: int) -> "Scans":
        """The same, thinned."""
        return Scans(*(x[:, ::stride] for x in self))


def best(work: Callable[[], object], repeats: int) -> float:
    """Least seconds of processor time of several runs."""
    seconds = []
    for _ in range(repeats):
        before = time.process_time()
        work()
        seconds.append(time.process_time() - before)
    return min(seconds)


def peak_memory(work: Callable[[], object]) -> float:
    """MiB of resident memory at the peak above those at the beginning."""
    held = forget_peak()
    work()
    return peak() - held


def register(scans: Scans, rate: float) -> None:
    """The registration that is measured."""
    layer = BBRLayer("F", inner=Adam(STEPS, rate), backward=Detached())
    layer(scans.P, scans.Q, P_normals=scans.P_normals, Q_normals=scans.Q_normals)


def recorded(scans: Scans, rate: float) -> tuple[Tensor, Tensor, list[RigidMotion]]:
    """Target, source and motions of the search that the registration's steps asked."""
    searches: dict[MutualNeighbours, list[RigidMotion]] = {}
    begin, answer = MutualNeighbours.__init__, MutualNeighbours.of_item
    clouds: dict[MutualNeighbours, tuple[Tensor, Tensor]] = {}

    def spied_begin(self: MutualNeighbours, P: Tensor, Q: Tensor, *rest: Tensor | None) -> None:
        clouds[self] = P, Q
        begin(self, P, Q, *rest)

    def spied_answer(self: MutualNeighbours, number: int, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        searches.setdefault(self, []).append(RigidMotion(*(torch.tensor(x[None]) for x in pose)))
        return answer(self, number, pose)

    with (
        patch.object(MutualNeighbours, "__init__", spied_begin),
        patch.object(MutualNeighbours, "of_item", spied_answer),
    ):
        register(scans, rate)
    longest = max(searches, key=lambda search: len(searches[search]))
    return *clouds[longest], searches[longest]


def search_row(scans: Scans, rate: float, repeats: int) -> str:
    """One table row: the registration, and its search with and without margins."""
    P, Q, motions = recorded(scans, rate)
    built = best(lambda: MutualNeighbours(P, Q), repeats)
    seconds, searches = {}, {}
    for margins in (True, False):

        def drive(margins: bool = margins) -> None:
            searches[margins] = MutualNeighbours(P, Q, margins=margins)
            for motion in motions:
                searches[margins](motion)

        seconds[margins] = best(drive, repeats)
    whole = best(lambda: register(scans, rate), repeats)
    kept = searches[True]
    cells = (
        f"{rate:g}",
        f"{whole:.1f}",
        f"{built:.2f}",
        f"{seconds[True]:.1f}",
        f"{seconds[False]:.1f}",
        f"{kept.asked / 1e6:.1f} M",
        f"{1 - kept.searched / kept.asked:.0%}",
        f"{1 - kept.looked_up / kept.asked:.0%}",
    )
    return "| " + " | ".join(cells) + " |"


def gicp(P: np.ndarray, Q: np.ndarray, start: np.ndarray) -> np.ndarray:
    """small_gicp's GICP on all points, its settings but for one thread."""
    clouds = []
    for points in (P, Q):
        cloud = small_gicp.PointCloud(points.astype(np.float64))
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_covariances(cloud, tree, GICP_NEIGHBOURS)
        clouds.append((cloud, tree))
    (target, tree), (source, _) = clouds
    return small_gicp.align(target, source, tree, start, registration_type="GICP", num_threads=1).T_target_source


def whole_rows(repeats: int) -> list[str]:
    """Seconds and error from points to pose, normals included, from 1 m and 1 degree off: GICP, and two layers."""
    arrays = np.load(data_folder() / f"{PAIR}.npz")
    P, Q = arrays["tgt"], arrays["src"]
    truth = RigidMotion.from_matrix(torch.from_numpy(arrays["T"]).double())
    off = RigidMotion.from_rotvec(
        torch.tensor([0.0, 0.0, np.pi / 180]).double(), torch.tensor([0.6, 0.8, 0.0]).double()
    )
    start, clouds = off @ truth, (torch.from_numpy(P), torch.from_numpy(Q))
    fast, default = BBRLayer.fast(Detached()), BBRLayer(backward=Detached())
    runs: dict[str, Callable[[], Tensor]] = {
        "small_gicp, GICP": lambda: torch.from_numpy(gicp(P, Q, start.matrix.numpy())),
        "`BBRLayer.fast()`": lambda: fast(*clouds, start=start).target_from_source.matrix,
        "`BBRLayer()`": lambda: default(*clouds, start=start).target_from_source.matrix,
    }
    rows = []
    for name, run in runs.items():
        found, seconds = RigidMotion.from_matrix(run()), best(run, repeats)
        angle = angular_error(found.rotation, truth.rotation).rad2deg().item()
        length = (found.translation - truth.translation).norm()
        rows.append(f"| {name} | {seconds:.2f} | {angle:.3f} | {length:.3f} |")
    return ["| from points to pose | s | error, deg | error, m |", "|---|---|---|---|", *rows]


def processor() -> str:
    """The machine's processor by name."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def main() -> None:
    """Write the tables to the file named."""
    parser = argparse.ArgumentParser(description="full lidar scans")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/lidar.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    arrays = np.load(data_folder() / f"{PAIR}.npz")
    P, Q = (torch.from_numpy(arrays[name])[None] for name in ("tgt", "src"))
    normals = best(lambda: (estimate_normals(P), estimate_normals(Q)), options.repeats)
    spacing = best(lambda: (point_spacing(P), point_spacing(Q)), options.repeats)
    scans = Scans(P, Q, estimate_normals(P), estimate_normals(Q))
    lines = [
        f"Made by `python -m benchmarks.lidar --repeats {options.repeats}` on one thread of {processor()}: {PAIR}, "
        f"{P.shape[1]} and {Q.shape[1]} points, nothing thinned, BBR-F, {STEPS} Adam steps, forward only. Seconds are "
        "the least processor time of the repeats. Normals are given.",
        "",
        "| rate | registration, s | building both trees, s | search with margins, s | without, s | neighbours wanted |"
        " kept by margins | look-ups saved, walks included |",
        "|---|---|---|---|---|---|---|---|",
    ]
    register(scans.every(100), RATES[0])  # what is loaded once does not count
    memory = peak_memory(lambda: register(scans, RATES[0]))
    lines += [search_row(scans, rate, options.repeats) for rate in RATES]
    lines += [
        "",
        f"Search times include building. Before the registration: normals of both scans {normals:.2f} s. Within it: "
        f"spacing of both {spacing:.2f} s. Peak memory of the registration: {memory:.0f} MiB above what was held.",
    ]
    lines += ["", *whole_rows(options.repeats)]
    print("\n".join(lines))
    options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
