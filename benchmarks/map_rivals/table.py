"""The table of rivals from their results, and our own figures out of the table of maps."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from benchmarks.map_rivals.chain import GRAPH, PLAIN
from benchmarks.mapping_rows import ROWS

OURS = "ours"
ERROR, SECONDS = "error", "CPU seconds"
# Column of `benchmarks/mapping_table.md` that holds each error.
COLUMNS = {"ape_rmse": "ATE", "point_rms_displacement": "points"}
# By row, rival, setting and kind of start: error and seconds.
Results = dict[str, dict[str, dict[str, dict[str, dict[str, float]]]]]
Cells = dict[str, float]


def parsed(text: str) -> dict[str, dict[str, str]]:
    """Rows of the first Markdown table of a text by their first cell, each by its titles."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    split = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    titles, rows = split[0], split[2:]
    return {row[0]: dict(zip(titles, row, strict=True)) for row in rows}


def own_figures(path: Path) -> Results:
    """Error and seconds of our mapper in every row of its own table, as results."""
    found: Results = {}
    for name, cells in parsed(path.read_text(encoding="utf-8")).items():
        if name in ROWS:
            numbers = {ERROR: float(cells[COLUMNS[ROWS[name].error]]), SECONDS: float(cells[SECONDS])}
            found[name] = {OURS: {"default": {PLAIN: numbers}}}
    return found


def best(settings: dict[str, dict[str, dict[str, float]]], start: str) -> tuple[str, dict[str, float]] | None:
    """The setting of the least error from this kind of start, and its numbers; None where nothing was run."""
    tried = [(name, found[start]) for name, found in settings.items() if start in found]
    return min(tried, key=lambda pair: pair[1][ERROR]) if tried else None


def columns_of(results: Results, rows: Sequence[str]) -> list[tuple[str, str]]:
    """Rivals with their kinds of start, in the order they were met."""
    met = [
        (rival, start)
        for row in rows
        for rival, settings in results[row].items()
        for found in settings.values()
        for start in found
    ]
    rivals = list(dict.fromkeys(rival for rival, _ in met))
    return sorted(dict.fromkeys(met), key=lambda column: rivals.index(column[0]))


def numbers_of(results: Results, row: str, columns: list[tuple[str, str]], measure: str) -> list[float | None]:
    """The measure of each column in a row, at the setting of the least error."""
    chosen = [best(results[row].get(rival, {}), start) for rival, start in columns]
    return [None if found is None else found[1][measure] for found in chosen]


def marked(numbers: list[float | None]) -> list[str]:
    """Three digits each, the least bold, with all that print alike."""
    least = min((x for x in numbers if x is not None), default=0.0)
    texts = ["" if x is None else f"{x:.3g}" for x in numbers]
    return [f"**{text}**" if text == f"{least:.3g}" else text for text in texts]


def table_of(results: Results, rows: list[str], units: dict[str, str]) -> list[str]:
    """Errors of the rows at each rival's best setting, a column for each kind of start."""
    columns = columns_of(results, rows)
    lines = _head(["sequence", "unit", *map(_title, columns)])
    numbers = [numbers_of(results, row, columns, ERROR) for row in rows]
    lines += [_line([row, units[row], *marked(found)]) for row, found in zip(rows, numbers, strict=True)]
    return lines


def summary_of(results: Results, groups: dict[str, list[str]], units: dict[str, str]) -> list[str]:
    """Median and worst error of each group of rows."""
    rows = [row for group in groups.values() for row in group]
    columns = columns_of(results, rows)
    lines = _head(["rows", "unit", *map(_title, columns)])
    measures: dict[str, Callable[[list[float]], float]] = {"median": median, "worst": max}
    for name, group in groups.items():
        by_column = zip(*(numbers_of(results, row, columns, ERROR) for row in group), strict=True)
        held = [[x for x in numbers if x is not None] for numbers in by_column]
        for word, measure in measures.items():
            cells = marked([measure(x) if len(x) == len(group) else None for x in held])
            lines.append(_line([f"{name}, {word} of {len(group)}", units[group[0]], *cells]))
    return lines


def seconds_of(results: Results, rows: list[str]) -> list[str]:
    """CPU seconds of each rival's chosen setting as it is made, all rows together."""
    columns = [column for column in columns_of(results, rows) if column[1] in (PLAIN, GRAPH)]
    lines = _head(["rows", *map(_title, columns)])
    held = zip(*(numbers_of(results, row, columns, SECONDS) for row in rows), strict=True)
    sums = [f"{sum(numbers):.0f}" if None not in numbers else "" for numbers in held]
    return [*lines, _line([f"{len(rows)}", *sums])]


def standing(results: Results, rows: list[str]) -> str:
    """In how many rows we are best, and who is in the others."""
    columns = columns_of(results, rows)
    lost: dict[str, str] = {}
    for row in rows:
        cells = marked(numbers_of(results, row, columns, ERROR))
        if not cells[columns.index((OURS, PLAIN))].startswith("**"):
            lost[row] = "; ".join(_title(x) for x, cell in zip(columns, cells, strict=True) if cell.startswith("**"))
    sentence = f"Ours is best, alone or level, in {len(rows) - len(lost)} of {len(rows)} rows."
    return sentence + "".join(f"\n- {row}: {who}" for row, who in lost.items())


def lacking(results: Results, wanted: dict[str, dict[str, list[str]]]) -> list[str]:
    """Of which rivals fewer settings were run than ``wanted`` by row and rival, and in which rows, a line each."""
    rows: dict[str, list[str]] = {}
    for row, held in results.items():
        for rival, words in wanted[row].items():
            run = sum(word in held.get(rival, {}) for word in words)
            if run < len(words):
                rows.setdefault(f"{rival}, {run} of {len(words)} settings", []).append(row)
    return [f"- {what}: " + "; ".join(names) for what, names in sorted(rows.items())]


def _title(column: tuple[str, str]) -> str:
    rival, start = column
    return rival if start == PLAIN else f"{rival} + {start.replace(', ', ' + ')}"


def _head(titles: list[str]) -> list[str]:
    return [_line(titles), "|---" * len(titles) + "|"]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
