"""Progress is shown wherever the output goes: bars on a terminal, now and then a line in a log."""

import io
import signal

import pytest
import torch
from map_problems import room_result
from rich.console import Console

from bbr_layer import RigidMotion
from train import console as module
from train.console import PrintedUnit, one_sentence, show_map, show_metrics, shown_progress
from train.mapping import Mapped
from train.training import Stopped


class Clock:
    """Seconds that pass when the test says so."""

    def __init__(self):
        self.seconds = 100.0

    def monotonic(self) -> float:
        return self.seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def test_a_log_gets_a_line_for_every_stage_and_one_every_ten_seconds(clock):
    log = io.StringIO()
    with shown_progress(Console(file=log, width=80)) as report:
        for done in range(4):
            report("window", done, 4)
            clock.seconds += 6.0
        report("loops", 0, 90)
        report("window", 4, 4)
        clock.seconds += module.SECONDS_APART
        report("loops", 32, 90)
        assert "loops 32/90" in log.getvalue(), "told at once, not at the end"
    assert log.getvalue().splitlines() == [
        "     0 s  window 0/4",
        "    12 s  window 2/4",
        "    24 s  loops 0/90",
        "    34 s  loops 32/90",
    ]


def test_a_terminal_gets_bars():
    screen = io.StringIO()
    with shown_progress(Console(file=screen, force_terminal=True, width=80)) as report:
        report("window", 1, 4)
        report("window", 4, 4)
    assert "window" in screen.getvalue() and "4/4" in screen.getvalue() and "━" in screen.getvalue()


def test_a_signal_is_told_of_with_the_exit_code_of_a_shell(capsys):
    with pytest.raises(SystemExit) as ended, one_sentence():
        raise Stopped(signal.SIGTERM)
    assert ended.value.code == 143
    told = capsys.readouterr().err
    assert told.startswith("SIGTERM stopped the training") and told.count("\n") == 1


def test_brackets_in_names_are_no_markup(tmp_path):
    log, out = io.StringIO(), tmp_path / "run[" / "a] :dog: [red]"
    out.mkdir(parents=True)
    (out / "poses.npz").touch()
    start = RigidMotion.from_matrix(torch.from_numpy(room_result().world_from_scan))
    show_map(Console(file=log, width=80), out, Mapped(room_result(), start, 0), PrintedUnit(1.0, "[m]"))
    show_metrics(Console(file=log, width=80), {"ape_rmse": 2.0}, PrintedUnit(1.0, "[/m]"))
    assert f"trajectory {out / 'poses.npz'}\n" in log.getvalue()
    assert " [m]\n" in log.getvalue() or " [m] " in log.getvalue()
    assert "ape_rmse                  2 [/m]\n" in log.getvalue()
