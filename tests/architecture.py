"""Finds what breaks the drawing of the house: imports that point upwards, files and functions too long."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

LONGEST_FILE = 200
LONGEST_FUNCTION = 40
MOST_POSITIONAL = 5


class Drawing(NamedTuple):
    """Who may import whom."""

    order: dict[str, str]  # per package: rows of module names, each importing only from rows above its own
    below: dict[str, set[str]]  # per package: the packages whose public names it may import
    forbidden: dict[str, set[str]]  # per package: top-level names that it must not import


def levels(rows: str) -> dict[str, int]:
    """The row number of every listed module."""
    return {name: number for number, row in enumerate(rows.split("\n")) for name in row.split()}


def sources(root: Path, package: str) -> dict[str, str]:
    """The text of every module of ``package``, named below it: "geometry", "inner.adam", "__init__"."""
    found = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root / package).with_suffix("").parts
        name = ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)
        found[name] = path.read_text(encoding="utf-8")
    assert found, f"{package}/ is missing or holds no Python file"
    return found


def imports(text: str, modules: set[str]) -> Iterator[tuple[int, str]]:
    """(line, full module name) of every import in ``text``; names in ``modules`` are known to be modules."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = "." * node.level + (node.module or "")
            for alias in node.names:
                below = f"{origin}.{alias.name}"
                yield node.lineno, below if below in modules else origin


def import_faults(root: Path, package: str, drawing: Drawing) -> list[str]:
    """A sentence for every import in ``package`` that the drawing does not allow."""
    row = levels(drawing.order[package])
    files = {owner: sources(root, owner) for owner in drawing.order}
    modules = {f"{owner}.{name}" for owner, found in files.items() for name in found if name != "__init__"}
    faults = []
    for name, text in files[package].items():
        for line, target in imports(text, modules):
            place = f"{package}/{name}, line {line}"
            owner, _, inner = target.partition(".")
            if not owner:
                faults.append(f"{place}: a relative import; name the package")
            elif owner in drawing.forbidden[package]:
                faults.append(f"{place}: {package} must not import {owner}")
            elif owner == package:
                if row.get(inner or "__init__", len(row)) >= row.get(name, -1):
                    faults.append(f"{place}: {name} does not stand below {inner or '__init__'}")
            elif owner in drawing.order and owner not in drawing.below[package]:
                faults.append(f"{place}: {package} must not import {owner}")
            elif owner in drawing.order and inner:
                faults.append(f"{place}: {target} is not public; import its names from {owner}")
    return faults


def size_faults(root: Path, package: str) -> list[str]:
    """A sentence for every file or function of ``package`` that is too long or takes too many arguments."""
    faults = []
    for name, text in sources(root, package).items():
        if (length := len(text.splitlines())) > LONGEST_FILE:
            faults.append(f"{package}/{name}: {length} lines, at most {LONGEST_FILE}")
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            place = f"{package}/{name}, {node.name}"
            if (length := _code_lines(node)) > LONGEST_FUNCTION:
                faults.append(f"{place}: {length} lines, at most {LONGEST_FUNCTION}")
            positional = [argument.arg for argument in node.args.posonlyargs + node.args.args]
            if (count := len([word for word in positional if word not in {"self", "cls"}])) > MOST_POSITIONAL:
                faults.append(f"{place}: {count} positional arguments, at most {MOST_POSITIONAL}")
    return faults


def _code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring: shapes, units and errors belong there and should not cost code."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    return function.end_lineno - function.lineno + 1 - (first.end_lineno - first.lineno + 1 if documented else 0)
