"""The figures of a map, and plain values in JSON and YAML."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from map_problems import SETTINGS, room_result

from train.outputs import MapResult
from train.report import map_metrics, write_json, write_yaml


def metrics_of(result: MapResult) -> dict:
    return map_metrics(result.scans, result.world_from_scan, result.world_points(), result.edges)


def test_sizes_and_trajectory_errors():
    metrics = metrics_of(room_result())
    assert metrics["scans"] == 5 and metrics["points"] == 5 * 180 and metrics["dimension"] == 2
    assert metrics["path_length"] == pytest.approx(0.8 * 2, abs=0.1)
    assert 0.003 < metrics["trajectory"]["ape_rmse"] < 0.03
    assert 0.003 < metrics["trajectory"]["point_rms_displacement"] < 0.03
    assert "trajectory_at_start" not in metrics and "edges" not in metrics


@pytest.mark.parametrize("d", [2, 3])
def test_map_entropy_prefers_the_better_poses(d):
    good, bad = metrics_of(room_result(d, error=0.0)), metrics_of(room_result(d, error=0.05))
    assert good["map_entropy_radius"] == bad["map_entropy_radius"]
    assert good["map_entropy"] < bad["map_entropy"] - 0.1


def test_without_truth_there_is_no_error_to_report():
    result = room_result()
    assert "trajectory" not in metrics_of(replace(result, scans=replace(result.scans, truth=None)))


def test_starting_poses_are_judged_too():
    result = room_result()
    metrics = metrics_of(replace(result, scans=replace(result.scans, start=result.scans.truth)))
    assert metrics["trajectory_at_start"]["ape_rmse"] < 1e-9


def test_json_is_strict(tmp_path):
    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    values = {"a": np.float64(1.5), "b": [1, float("nan"), float("-inf")], "c": np.arange(2), "d": Path("x") / "y"}
    write_json(tmp_path / "metrics.json", values)
    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refuse)
    assert read == {"a": 1.5, "b": [1, None, None], "c": [0, 1], "d": "x/y"}


def test_yaml_is_read_back_in_its_order(tmp_path):
    write_yaml(tmp_path / "config.yaml", SETTINGS | {"limit": float("inf")})
    read = yaml.safe_load((tmp_path / "config.yaml").read_text(encoding="utf-8"))
    assert read == SETTINGS | {"limit": float("inf")} and list(read)[: len(SETTINGS)] == list(SETTINGS)


@pytest.mark.parametrize("write", [write_json, write_yaml])
def test_values_that_are_not_plain_are_refused(write, tmp_path):
    with pytest.raises(ValueError, match="type Generator cannot be written"):
        write(tmp_path / "file", {"seed": np.random.default_rng(0)})
    assert not list(tmp_path.iterdir())
