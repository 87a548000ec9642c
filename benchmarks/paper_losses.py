"""Where other methods are better than ours, cell by cell, told from the results and not from memory."""

from collections.abc import Iterator

import numpy as np

from benchmarks.paper_methods import METHODS
from benchmarks.paper_results import Bench, Scores

PEERS = [method for method in METHODS if method.kind == "peer"]
ACCURATE, SURE = (next(x for x in METHODS if x.name == name) for name in ("BBRLayer()", "BBRLayer.robust()"))


# What the list below comes to. Written by hand after a run of 20 repeats: read it again when the list changes.
SUMMARY = """In short. Nearly every peer is faster, those of small_gicp mostly by several times. From one
start, `BBRLayer()` loses turns of 90 degrees and some of 60, where FPFH + RANSAC does not care; seven lose none of
them, at four to five times the cost. On whole models without shared points a peer ends a hair nearer in one of nine
cells, beside a distractor and in partial overlap in none. On lidar we never fail; a peer is nearer in angle in half of
the columns, in translation in nearly all, by millimetres to a centimetre. On bun180 and bun270, 5 cm off, seven starts
lose none of 40, where the others lose 23 to 40. Beside a distractor nearly as dense as the model seven starts lose none
of 20 (the peers 10 to 20 where the clouds share no point, 2 to 18 where they do)."""


def where_we_lose(benches: list[Bench]) -> Iterator[str]:
    """A paragraph and a list: lower medians, fewer failures and fewer seconds of a peer."""
    yield from ("## Where we lose", "", SUMMARY, "")
    yield (
        "Counted from the tables below: `BBRLayer()` against the best peer of each cell by median error, unless that "
        "is a failure too; `BBRLayer.robust()` against the peer with the fewest failures. The machine had other work "
        "to do meanwhile, so that seconds are worth more within a table than across tables."
    )
    yield ""
    for bench in benches:
        if lines := _of(bench):
            yield f"- **{bench.experiment.title}, {bench.sampling}.** " + " ".join(lines)


def _of(bench: Bench) -> list[str]:
    cells = [cell.name for cell in bench.known_cells()]
    worse, failing, farther, level = [], [], 0, 0
    for cell in cells:
        own, safe = bench.scores(ACCURATE, cell), bench.scores(SURE, cell)
        peers = {x.name: found for x in PEERS if (found := bench.scores(x, cell)) is not None}
        if own is None or safe is None or not peers:
            continue
        level += 1
        best = min(peers, key=lambda x: float(np.median(peers[x].degrees)))
        lowest = float(np.median(peers[best].degrees))
        if lowest < min(float(np.median(own.degrees)), bench.experiment.failed_deg):
            worse.append(f"{cell} ({best} {_median(peers[best])} against {_median(own)})")
        nearest = min(float(np.median(x.shifts)) for x in peers.values())
        farther += nearest < np.median(own.shifts)
        surest = min(peers, key=lambda x: peers[x].failed(bench.experiment))
        if peers[surest].failed(bench.experiment) < safe.failed(bench.experiment):
            fewer = f"{peers[surest].failed(bench.experiment)} against {safe.failed(bench.experiment)}"
            failing.append(f"{cell} ({surest} {fewer} of {len(safe.degrees)})")
    if not level:
        return []
    lines = [_sentence("A peer's median is lower", worse, level), _sentence("A peer fails less", failing, level)]
    lines += [f"A peer's median translation is lower in {farther}."]
    return [*lines, _faster(bench, cells[-1])]


def _sentence(what: str, places: list[str], of: int) -> str:
    return f"{what} in {len(places)} of {of} cells" + (f": {', '.join(places)}." if places else ".")


def _faster(bench: Bench, cell: str) -> str:
    own = bench.scores(ACCURATE, cell)
    seconds = {x.name: found.seconds.mean() for x in PEERS if (found := bench.scores(x, cell)) is not None}
    assert own is not None
    quickest = min(seconds, key=lambda name: seconds[name])
    quicker = sum(s < own.seconds.mean() for s in seconds.values())
    words = f"{quickest} {seconds[quickest]:.3f} s against {own.seconds.mean():.3f} s"
    return f"Faster at {cell}: {quicker} of {len(seconds)} peers, most of all {words}."


def _median(x: Scores) -> str:
    return f"{np.median(x.degrees):.3f}"
