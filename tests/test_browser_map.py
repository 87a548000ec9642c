"""The map for the browser: self-contained, thinned, and with the right points in it."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from train.browser_map import write_browser_map


def traces(page: Path) -> list[dict]:
    """The traces that the page draws, their arrays decoded."""
    text = page.read_text(encoding="utf-8")
    call = text[text.rindex("Plotly.newPlot(") :]
    drawn, _ = json.JSONDecoder().raw_decode(call, call.index("[{"))
    for trace in drawn:
        for axis in "xyz":
            if isinstance(trace.get(axis), dict):
                trace[axis] = np.frombuffer(base64.b64decode(trace[axis]["bdata"]), trace[axis]["dtype"])
    return drawn


@pytest.mark.parametrize("d", [2, 3])
def test_points_and_path_are_in_the_page(d, tmp_path):
    rng = np.random.default_rng(0)
    points, positions = rng.normal(size=(50, d)), rng.normal(size=(4, d))
    write_browser_map(tmp_path / "map.html", points, positions, "m", names=list("abcd"))
    cloud, path, start, end = traces(tmp_path / "map.html")
    assert cloud["type"] == path["type"] == ("scatter3d" if d == 3 else "scattergl")
    for trace, expected in ((cloud, points), (path, positions), (start, positions[:1]), (end, positions[-1:])):
        shown = np.stack([trace[axis] for axis in "xyz"[:d]], axis=1)
        np.testing.assert_allclose(shown, expected, rtol=1e-6)
    assert path["text"] == list("abcd")


def test_many_points_are_thinned_evenly(tmp_path, monkeypatch):
    monkeypatch.setattr("train.browser_map.MOST_POINTS", 1000)
    points = np.stack((np.arange(50_000.0), np.zeros(50_000)), axis=1)
    write_browser_map(tmp_path / "map.html", points, points[:2], "m", names=["a", "b"])
    shown = traces(tmp_path / "map.html")[0]["x"]
    assert len(set(shown)) == len(shown) == 1000
    assert np.histogram(shown, 10, (0, 50_000))[0].min() > 60


def test_the_page_loads_nothing(tmp_path):
    write_browser_map(tmp_path / "map.html", np.eye(3), np.eye(3), "m", names=list("abc"))
    text = (tmp_path / "map.html").read_text(encoding="utf-8")
    assert "<script src" not in text and "<link" not in text.split("<script")[0]
    assert "Plotly.newPlot" in text and len(text) > 1_000_000
