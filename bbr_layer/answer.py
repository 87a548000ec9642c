"""The answer of ``python -m bbr_layer register``: as a dictionary for programs, as text for people."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bbr_layer.cloud_writing import write_cloud
from bbr_layer.clouds import Cloud
from bbr_layer.directions import Direction
from bbr_layer.two_clouds import TwoClouds


def described(found: TwoClouds, target: Cloud, source: Cloud) -> dict[str, Any]:
    """The answer in plain numbers, lists and words; angles in degrees, lengths in the data's unit."""
    motion, verdict = found.registration.target_from_source, found.verdict
    matrix = in_space(found.target_from_source)
    return {
        "target_from_source": matrix.tolist(),
        "rotation_angle_deg": math.degrees(float(motion.rotvec.norm())),
        "translation": matrix[:3, 3].tolist(),
        "status": found.registration.words,
        "trustworthy": verdict.trustworthy,
        "sentence": verdict.sentence,
        "buddies": verdict.buddies,
        "buddy_share": verdict.buddy_share,
        "residual_rms": verdict.residual_rms,
        "confidence": verdict.confidence,
        "weakest_direction": _plain(_of_one(found)[0]),
        "free_directions": [_plain(direction) for direction in _of_one(found) if direction.free],
        "points_read": {"target": len(target.points), "source": len(source.points)},
        "points_dropped": {"target": target.dropped, "source": source.dropped},
    }


def _of_one(found: TwoClouds) -> list[Direction]:
    """The directions of a registration without batch dimensions."""
    return [direction for direction in found.registration.directions if isinstance(direction, Direction)]


def _plain(direction: Direction) -> dict[str, Any]:
    deviation = math.degrees(direction.deviation) if direction.turning else direction.deviation
    return {
        "motion": "rotation" if direction.turning else "translation",
        "axis": direction.axis.tolist(),
        "deviation": deviation if math.isfinite(deviation) else None,
        "deviation_unit": "deg" if direction.turning else "data",
        "share_of_mean_information": direction.share,
        "words": direction.words,
    }


def in_space(motion: np.ndarray) -> np.ndarray:
    """A motion of the plane, ``(3, 3)``, as one of space, ``(4, 4)``; one of space as it is."""
    if motion.shape == (4, 4):
        return motion
    spatial = np.eye(4)
    spatial[:2, :2], spatial[:2, 3] = motion[:2, :2], motion[:2, 2]
    return spatial


def write_moved(path: str | Path, source: Cloud, target_from_source: np.ndarray) -> None:
    """Write the whole source, carried by the ``(4, 4)`` motion, with its normals and intensity."""
    d = source.points.shape[1]
    rotation, translation = target_from_source[:d, :d], target_from_source[:d, 3]
    write_cloud(
        path,
        source.points @ rotation.T + translation,
        normals=None if source.normals is None else source.normals @ rotation.T,
        columns=None if source.intensity is None else {"intensity": source.intensity},
    )


def show(console: Console, found: TwoClouds, answer: dict[str, Any], out: Path | None) -> None:
    """Print the answer for people."""
    console.print("target_from_source (x_target = R x_source + t)", highlight=False)
    for row in answer["target_from_source"]:
        console.print("  " + " ".join(f"{number:15.9f}" for number in row), highlight=False, soft_wrap=True)
    read = answer["points_read"]
    directions = _of_one(found)
    weak = [direction for direction in directions if direction.free] or directions[:1]
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, words in (
        ("rotation", f"{answer['rotation_angle_deg']:.4f} deg"),
        ("translation", "  ".join(f"{number:.6g}" for number in answer["translation"])),
        ("status", answer["status"]),
        ("best buddies", f"{answer['buddies']}, {answer['buddy_share']:.1%} of the smaller cloud's points"),
        ("their RMS residual", f"{answer['residual_rms']:.4g}"),
        ("confidence", f"{answer['confidence']:.2f}"),
        *(("free direction" if direction.free else "weakest direction", direction.words) for direction in weak),
        ("points", f"{read['target']} and {read['source']}"),
    ):
        table.add_row(f"{name}  ", escape(words))
    console.print(table)
    console.print(escape(answer["sentence"]), style="green" if answer["trustworthy"] else "bold red", soft_wrap=True)
    if out is not None:
        console.print(f"The moved source is in {escape(str(out))}", soft_wrap=True)
