"""``python -m bbr_layer register TARGET SOURCE``: two files registered, and how far to trust the answer."""

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from bbr_layer.answer import described, show, write_moved
from bbr_layer.atomic import writable_path
from bbr_layer.cloud_writing import writer_of
from bbr_layer.clouds import read_cloud
from bbr_layer.named_stages import SOFT_POINTS
from bbr_layer.trajectories import read_motion
from bbr_layer.two_clouds import DEFAULT_LOSS, common_dimension, register_clouds

BAD_INPUT = 2  # the exit code that command lines give to wrong arguments

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


class LossName(StrEnum):
    """The losses by the paper's names, and the measured sequence of them."""

    DEFAULT = DEFAULT_LOSS
    SOFT_BBS = "softBBS"
    SOFT_BD = "softBD"
    N = "N"
    F = "F"


class Preset(StrEnum):
    """The layers that are measured."""

    DEFAULT = "default"
    FAST = "fast"
    ROBUST = "robust"


Starts = Annotated[int | None, typer.Option(help="Starting rotations tried. Default 1; robust, and in the plane, 7.")]
SoftPoints = Annotated[
    int, typer.Option(help="Most points of each cloud in the soft stage; fast: at most 300; not with --loss F.")
]


@app.callback()
def main() -> None:
    """Best Buddies Registration of point clouds."""


@app.command()
def register(
    target: Annotated[Path, typer.Argument(help="The cloud that stays: .ply .pcd .bin .las .npz .xyz .csv ...")],
    source: Annotated[Path, typer.Argument(help="The cloud that is moved onto it.")],
    *,
    preset: Annotated[Preset, typer.Option(help="The default, fewer steps, or several starts.")] = Preset.DEFAULT,
    loss: Annotated[LossName, typer.Option(help="One loss alone instead of a preset.")] = LossName.DEFAULT,
    out: Annotated[Path | None, typer.Option(help="Write the moved source here: .ply .pcd .npz .csv .xyz")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Answer in JSON and nothing else.")] = False,
    start: Annotated[Path | None, typer.Option(help="A text file: the 4 x 4 target_from_source to begin with.")] = None,
    starts: Starts = None,
    points: SoftPoints = SOFT_POINTS,
) -> None:
    """Find the motion that carries SOURCE onto TARGET, and say how far to trust it."""
    try:
        if out is not None:  # asked before the work is done
            writer_of(writable_path(out))
        whole = read_cloud(source)
        P, Q = common_dimension(read_cloud(target), whole)
        begun = None if start is None else _of_dimension(read_motion(start), P.points.shape[1])
        found = register_clouds(
            P, Q, loss=loss.value, preset=preset.value, start=begun, starts=starts, soft_points=points
        )
        answer = described(found, P, Q)
        if out is not None:
            write_moved(out, whole, np.array(answer["target_from_source"]))
    except (ValueError, OSError) as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(BAD_INPUT) from error
    if as_json:
        typer.echo(json.dumps(answer, indent=2, allow_nan=False))
    else:
        show(Console(), found, answer, out)


def _of_dimension(motion: np.ndarray, d: int) -> np.ndarray:
    """A ``(4, 4)`` motion as ``(d + 1, d + 1)``; in 2D the part within the plane."""
    if d == 3:
        return motion
    kept = [0, 1, 3]
    if not np.allclose(motion[2], [0, 0, 1, 0]):
        raise ValueError("the start leaves the plane z = 0 and the clouds are 2D: give it in the plane")
    return motion[np.ix_(kept, kept)]


if __name__ == "__main__":
    app(prog_name="python -m bbr_layer")
