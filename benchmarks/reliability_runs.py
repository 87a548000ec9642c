"""Registers every trial with one start and with several and keeps what its pairs show: a table, resumable.

    python -m benchmarks.reliability_runs --seeds 4 --out benchmarks/reliability.csv

Half an hour on one core. What the table already holds is not run again.
"""

import argparse
import csv
import math
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from bbr_layer import BBRLayer, CloudPair, Detached, RigidMotion, angular_error, atomic_write
from bbr_layer.confidence import judged_clouds, statistics
from bbr_layer.matches import matched
from bbr_layer.preparation import prepared
from benchmarks.reliability_trials import Clouds, Trial, clouds, trials

COLUMNS = ("group", "trial", "layer", "rotation_deg", "displacement", "buddies", "on_plane", "near", "close")
EVERY = 20  # trials between two writings of the table


def read(path: Path) -> dict[tuple[str, str], list[str]]:
    """Rows of a table by trial and layer; none where there is no table."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        return {(row[1], row[2]): row for row in list(csv.reader(file))[1:]}


def write(path: Path, rows: dict[tuple[str, str], list[str]]) -> None:
    """The table, whole or not at all."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows.values()])


def row(trial: Trial, name: str, layer: BBRLayer) -> list[str]:
    """One registration: its errors (displacement as a share of the source's radius) and its pairs' shares."""
    c = clouds(trial)
    given = as_pair(c)
    motion = layer(given.P, given.Q, P_normals=given.P_normals, Q_normals=given.Q_normals).target_from_source
    frame, pair = prepared(given, needs_normals=True, scaled=True)
    entered, seen = frame.enter(motion), judged_clouds(pair)
    shares = statistics(seen, matched(seen, entered))[0].tolist()
    numbers = (*errors(c, motion.item(0)), *shares, _close_share(c, motion.item(0)))
    return [trial.group, trial.name, name, *(f"{number:.4g}" for number in numbers)]


def as_pair(c: Clouds) -> CloudPair:
    """The clouds and their normals as the layer computes with them: a batch of one, float32."""
    return CloudPair._make(None if x is None else x.float()[None] for x in (c.P, c.Q, *c[3:], *[None] * 7))


def errors(c: Clouds, motion: RigidMotion) -> tuple[float, float]:
    """Degrees, and how far the points lie from where they belong on average, as a share of the source's radius."""
    degrees = math.degrees(angular_error(motion.rotation, c.truth.rotation).item())
    radius = (c.Q - c.Q.mean(0)).square().sum(1).mean().sqrt()
    return degrees, ((motion(c.Q) - c.truth(c.Q)).norm(dim=1).mean() / radius).item()


def _close_share(c: Clouds, motion: RigidMotion) -> float:
    """Share of the mutual pairs nearer than the next points of their own clouds: what was trusted before, from 0.75."""
    P, moved = c.P.numpy(), motion(c.Q).numpy()
    distances, nearest = cKDTree(P).query(moved)
    mutual = cKDTree(moved).query(P)[1][nearest] == np.arange(len(moved))
    gaps = [cKDTree(cloud).query(cloud, k=2)[0][:, 1] for cloud in (P, moved)]
    return float(np.mean((distances <= (gaps[0][nearest] + gaps[1]) / 2)[mutual]))


def main() -> None:
    """Fill the table."""
    parser = argparse.ArgumentParser(description="registrations whose answers are known")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/reliability.csv"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    default, robust = BBRLayer(backward=Detached()), BBRLayer.robust(Detached())
    in_space = {"default": default, "robust": robust}
    in_plane = {"default": default, "one start": BBRLayer(backward=Detached(), starts=1)}  # where the default has seven
    rows = read(options.out)
    for number, trial in enumerate(trials(options.seeds)):
        for name, layer in (in_plane if trial.group == "2D" else in_space).items():
            if (trial.name, name) not in rows:
                rows[trial.name, name] = row(trial, name, layer)
        if number % EVERY == 0:
            write(options.out, rows)
            print(len(rows), trial.name, flush=True)
    write(options.out, rows)


if __name__ == "__main__":
    main()
