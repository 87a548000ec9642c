"""What is installed: the wheel holds the library alone, and every import is a declared requirement."""

import ast
import re
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from architecture import imports, sources
from hatchling.builders.wheel import WheelBuilder

PROJECT = Path(__file__).resolve().parent.parent
# Each package with the extras that its users install beside the runtime requirements.
EXTRAS = {"bbr_layer": ["gpu", "las"], "models": ["train"], "train": ["train"]}


def version() -> str:
    """``__version__`` as the source has it, without importing the library."""
    tree = ast.parse(sources(PROJECT, "bbr_layer")["__init__"])
    return next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__version__"
    )


def required(package: str) -> set[str]:
    """The distributions that are named for ``package``, spelled in lower case with hyphens."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = list(project["dependencies"])
    for extra in EXTRAS[package]:
        lines += project["optional-dependencies"][extra]
    return {canonical(re.match(r"[\w.-]+", line).group()) for line in lines}


def canonical(name: str) -> str:
    """A distribution's name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def test_the_wheel_holds_the_library_alone(tmp_path):
    (wheel,) = WheelBuilder(str(PROJECT)).build(directory=str(tmp_path), versions=["standard"])
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names} == {"bbr_layer", f"bbr_layer-{version()}.dist-info"}
    assert "bbr_layer/py.typed" in names
    assert f"bbr_layer-{version()}.dist-info/licenses/LICENSE" in names


@pytest.mark.parametrize("package", EXTRAS)
def test_every_import_is_required(package):
    owners = packages_distributions()  # before Python 3.12 silent on what is one compiled file: then by its own name
    texts = sources(PROJECT, package).values()
    used = {target.partition(".")[0] for text in texts for _, target in imports(text, set())}
    foreign = used - sys.stdlib_module_names - set(EXTRAS)
    named = {name for name in foreign if required(package) & set(map(canonical, owners.get(name, [name])))}
    assert foreign - named == set(), "imported, yet not named in pyproject.toml"
