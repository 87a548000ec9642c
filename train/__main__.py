"""``python -m train map|fit|simulate|evaluate``: from a folder of scans to a trajectory and a map."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from bbr_layer import read_poses
from train.beforehand import check_beforehand
from train.config import TERMS, load_config
from train.console import PrintedUnit, one_sentence, show_map, show_metrics, shown_progress
from train.evaluate import evaluate_trajectory
from train.known_edges import KnownEdges
from train.mapping import map_scans
from train.run_folder import open_run
from train.scans import ScanSet, planar_poses, read_scan_set
from train.simulate import DEFAULTS, SimulatedScans, simulate
from train.simulation_files import TRUTH_FILE, write_simulation
from train.world_settings import Kind

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)

# Where ``map`` puts the world that it simulates when it is given no scans.
WORLD, SIMULATED_UNIT = "world", "m"

Scans = Annotated[
    list[Path] | None,
    typer.Argument(help="A folder of scans, or scan files. Without: a simulated world, put into OUT/world."),
]
Out = Annotated[Path, typer.Option(help="Folder for the trajectory, the map and the pictures.")]
Truth = Annotated[Path | None, typer.Option(help="True poses (TUM, KITTI or .npz), for the report.")]
Start = Annotated[Path | None, typer.Option(help="Starting poses (TUM, KITTI or .npz).")]
Config = Annotated[Path | None, typer.Option(help="Settings (YAML), as config.yaml of an earlier map; options win.")]
Term = Annotated[str | None, typer.Option(help=f"Registration term (default F): {', '.join(TERMS)}.")]
Epochs = Annotated[int | None, typer.Option(help="Passes over all edges (default 40); 0 keeps the edges' map.")]
Stride = Annotated[int | None, typer.Option(help="Use every how many-th scan (default 1).")]
Seed = Annotated[int | None, typer.Option(help="Of everything random in the training (default 0).")]
Device = Annotated[str | None, typer.Option(help="cpu (default), cuda, mps or auto.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from what an earlier run left in OUT.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a map of other scans or settings in OUT.")]
UnitScale = Annotated[float, typer.Option(help="Printed lengths are multiplied by this; files are not.")]
Unit = Annotated[str, typer.Option(help="Name of the unit of printed lengths.")]


@app.callback()
def main() -> None:
    """From a folder of scans to a trajectory and a map."""
    # Lightning's news of devices and loggers; warnings still come through.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


@app.command("map")
def map_command(
    out: Out,
    *,
    scans: Scans = None,
    truth: Truth = None,
    start: Start = None,
    config: Config = None,
    term: Term = None,
    epochs: Epochs = None,
    stride: Stride = None,
    seed: Seed = None,
    device: Device = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    unit_scale: UnitScale = 1.0,
    unit: Unit = "",
) -> None:
    """Register neighbouring scans, solve for the poses, train the map and write it all to OUT."""
    console, printed = Console(), PrintedUnit(unit_scale, unit if scans or unit else SIMULATED_UNIT)
    with one_sentence():
        settings = load_config(config, changes(term=term, epochs=epochs, stride=stride, seed=seed, device=device))
        check_beforehand(settings, out, scans or [], (start, truth))
        with shown_progress(console) as progress:
            if scans:
                given = read_scan_set(scans, start=start, truth=truth, stride=settings.stride, progress=progress)
                run = open_run(out, given, settings, resume=resume, overwrite=overwrite)
            else:
                if start or truth:
                    raise ValueError("poses were given without scans; name the folder of their scans too")
                world = simulate(DEFAULTS[2])
                given = simulated_scans(world, settings.stride)
                run = open_run(out, given, settings, resume=resume, overwrite=overwrite)
                write_simulation(out / WORLD, world)
            mapped = map_scans(run, given, settings, unit=printed.of_files, progress=progress)
        show_map(console, out, mapped, printed)


@app.command()
def fit(
    scans: Annotated[list[Path], typer.Argument(help="A folder of scans, or scan files.")],
    poses: Annotated[Path, typer.Option(help="Their poses (TUM, KITTI or .npz): where the training starts.")],
    out: Out,
    *,
    edges: Annotated[Path | None, typer.Option(help="edges.npz of an earlier map; without: from the poses.")] = None,
    truth: Truth = None,
    config: Config = None,
    term: Term = None,
    epochs: Epochs = None,
    stride: Stride = None,
    seed: Seed = None,
    device: Device = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    unit_scale: UnitScale = 1.0,
    unit: Unit = "",
) -> None:
    """Train the map from known poses; nothing is registered."""
    console, printed = Console(), PrintedUnit(unit_scale, unit)
    with one_sentence():
        settings = load_config(config, changes(term=term, epochs=epochs, stride=stride, seed=seed, device=device))
        check_beforehand(settings, out, scans, (poses, edges, truth))
        if edges is None and settings.training.term == "residual":
            raise ValueError("term residual compares poses with registered edges: give --edges, or another term")
        with shown_progress(console) as progress:
            given = read_scan_set(scans, start=poses, truth=truth, stride=settings.stride, progress=progress)
            known = KnownEdges(edges)
            run = open_run(out, given, settings, origin=known.origin, resume=resume, overwrite=overwrite)
            mapped = map_scans(run, given, settings, register=known, unit=printed.of_files, progress=progress)
        show_map(console, out, mapped, printed)


@app.command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Argument(help="Folder for the scans and their true poses.")],
    *,
    kind: Annotated[Kind, typer.Option(help="What building.")] = "rooms",
    dimension: Annotated[int, typer.Option(help="2: a plane of rays, 3: a spinning lidar.")] = 2,
    scans: Annotated[int | None, typer.Option(help="How many scans.")] = None,
    beams: Annotated[int | None, typer.Option(help="Rays of a scan, in 3D of a ring.")] = None,
    movers: Annotated[int, typer.Option(help="People and trolleys that move between the scans.")] = 0,
    noise: Annotated[float, typer.Option(help="Standard deviation of a range, metres.")] = DEFAULTS[2].noise_m,
    view_deg: Annotated[float, typer.Option(help="Horizontal field of view, degrees.")] = 360.0,
    seed: Annotated[int, typer.Option(help="Another seed is another building.")] = 0,
) -> None:
    """Scan a simulated world: a folder to map, with its truth."""
    with one_sentence():
        if dimension not in DEFAULTS:
            raise ValueError(f"dimension is {dimension}; choose 2 (a plane of rays) or 3 (a spinning lidar)")
        default = DEFAULTS[dimension]
        settings = replace(
            default,
            kind=kind,
            scans=default.scans if scans is None else scans,
            beams=default.beams if beams is None else beams,
            movers=movers,
            noise_m=noise,
            field_of_view_deg=view_deg,
            seed=seed,
        )
        write_simulation(out, simulate(settings))
    typer.echo(f"scans       {out}\ntruth       {out / TRUTH_FILE}")


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Estimated poses: TUM, KITTI or .npz.")],
    truth: Annotated[Path, typer.Argument(help="True poses of the same scans, in the same order.")],
    as_json: Annotated[
        bool, typer.Option("--json", help="Answer in JSON and nothing else, in the data's unit.")
    ] = False,
    unit_scale: UnitScale = 1.0,
    unit: Unit = "",
) -> None:
    """Errors of a trajectory against the truth: APE after rigid alignment, RPE between consecutive poses."""
    with one_sentence():
        metrics = evaluate_trajectory(read_poses(estimate), read_poses(truth))
    if as_json:
        typer.echo(json.dumps(metrics, indent=2))
    else:
        show_metrics(Console(), metrics, PrintedUnit(unit_scale, unit))


def changes(
    *, term: str | None, epochs: int | None, stride: int | None, seed: int | None, device: str | None
) -> dict[str, object]:
    """What was typed, as the configuration file would have it."""
    training = {"term": term, "epochs": epochs}
    tree: dict[str, object] = {"stride": stride, "seed": seed, "device": device}
    given = {name: value for name, value in tree.items() if value is not None}
    typed = {name: value for name, value in training.items() if value is not None}
    return {**given, "training": typed} if typed else given


def simulated_scans(world: SimulatedScans, stride: int) -> ScanSet:
    """The scans of a simulated world with their truth."""
    flat = world.points[0].shape[1] == 2
    truth = planar_poses(world.world_from_scan, "truth") if flat else world.world_from_scan
    names = [str(number) for number in range(len(world.points))]
    return ScanSet(world.points[::stride], names[::stride], world.timestamps[::stride], truth=truth[::stride])


if __name__ == "__main__":
    app(prog_name="python -m train")
