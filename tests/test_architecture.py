"""Rooms lie one above the other, and an import only points downwards (docs/architecture.md)."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = {"endotwin": ROOT / "endotwin", "endotwin.cli": ROOT / "cli"}

STOREYS = re.findall(r"^\| (`.+?`) \|", (ROOT / "docs" / "architecture.md").read_text("utf-8"), re.M)
RANK = {room: rank for rank, storey in enumerate(STOREYS) for room in re.findall(r"`([a-z]+)`", storey)}
"""Rooms and modules at the top, lowest first, as the document lists them."""

EFFECTS_MAY_IMPORT = {"errors", "run", "cameras", "sequence", "effects"}

EXCEPTIONS = {
    ("twin.twin", "look.inspector"): "Twin.show() opens the window in which a twin is looked at",
    ("twin.twin", "export.export"): "Twin.export() writes it for other programs",
    ("twin.twin", "render"): "Twin.render() is how one asks a twin for a view",
}
"""Imports that point upwards, and why."""


def modules() -> dict[str, Path]:
    """Every module of the package by its name, a package's door by the name of the package."""
    found = {}
    for package, folder in SOURCES.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imported(path: Path) -> set[str]:
    """Modules of this package that the file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names = {f"{node.module}.{name.name}" for name in node.names}
            found |= {name if name in MODULES else node.module for name in names}
    return {name for name in found if name in MODULES and name != "endotwin"}


IMPORTS = {name: imported(path) for name, path in MODULES.items() if name != "endotwin"}


def room(module: str) -> str:
    return module.split(".")[1]


def upwards() -> set[tuple[str, str]]:
    """Imports that point to a higher storey, or to another room of the same one."""
    return {
        (name, other)
        for name, others in IMPORTS.items()
        for other in others
        if room(name) != room(other) and RANK[room(other)] >= RANK[room(name)]
    }


def test_every_room_has_its_storey_and_every_storey_its_room():
    assert {room(name) for name in IMPORTS} == set(RANK)


def test_imports_point_downwards():
    excepted = {tuple(f"endotwin.{name}" for name in pair) for pair in EXCEPTIONS}
    assert upwards() == excepted


def test_effects_know_nothing_above_a_sequence():
    effects = {name: others for name, others in IMPORTS.items() if room(name) == "effects"}
    assert {room(other) for others in effects.values() for other in others} <= EFFECTS_MAY_IMPORT


def test_no_two_packages_import_each_other():
    """A package is the modules in one folder. Its door, which may name what lies in folders within, counts by
    itself, and so does each module at the top."""
    doors = {name for name, path in MODULES.items() if path.name == "__init__.py"}

    def package(module: str) -> str:
        folder = module.rpartition(".")[0]
        return f"{module} (door)" if module in doors else module if folder == "endotwin" else folder

    graph: dict[str, set[str]] = {}
    for name, others in IMPORTS.items():
        for other in others:
            if (name, other) not in upwards() and package(name) != package(other):
                graph.setdefault(package(name), set()).add(package(other))
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" → ".join(error.args[1]))


def test_every_package_is_installed():
    listed = re.search(r"packages = \[(.*?)\]", (ROOT / "pyproject.toml").read_text("utf-8"), re.S)[1]
    packages = {name for name, path in MODULES.items() if path.name == "__init__.py"}
    assert set(re.findall(r'"(.+?)"', listed)) == {*packages, "endotwin.configs"}


def loaded_with(path: Path) -> set[str]:
    """What the file imports as it is loaded, and the packages that lie around it."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
    return {".".join(name.split(".")[:depth]) for name in found for depth in range(1, name.count(".") + 2)}


def test_what_takes_a_second_to_load_is_loaded_only_with_what_cannot_do_without():
    loads, slow, known = {name: loaded_with(path) for name, path in MODULES.items()}, set(), None
    while slow != known:
        known = slow
        slow = {name for name, others in loads.items() if others & {"open3d", "trimesh", *known}}
    assert {room(name) for name in slow} == {"fusion", "export", "selfcheck"}
