"""Which file holds a twin how."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from endotwin.errors import OptionError, TwinError
from endotwin.run.arguments import as_path
from endotwin.run.output import check_free
from endotwin.twin import Twin, as_twin

FORMATS = {
    ".glb": "glTF 2.0: textured mesh, camera path, lights; metres, Y up",
    ".ply": "mesh with every map as a named property of its vertices; mm",
    ".obj": "textured mesh, with .mtl and three .png beside it; mm",
    ".usdz": "USD: textured mesh, camera path, lights; metres, Y up",
    ".html": "a page that shows the twin in any browser, without a network",
    ".mitsuba": "folder with a scene of Mitsuba 3; mm",
}
"""What each suffix stands for."""


def export(twin: Twin | Path | str, path: Path | str, overwrite: bool = False) -> None:
    """Write a fitted twin for other programs, by the suffix of ``path`` (FORMATS).

    Args:
        twin: or its folder. overwrite: whether ``path`` may exist.

    Raises:
        TwinError: the twin is not fitted, or has no triangle. OptionError: the suffix is none of FORMATS.
        OutputError: ``path`` exists, or cannot be written.
    """
    path = as_path("export", path)
    check_export(path, overwrite)
    twin = as_twin(twin)
    twin.require_fitted()
    if not len(twin.surface.triangles):
        raise TwinError("the twin has no triangle that could be exported; fuse its sequence again")
    _writer(path.suffix.lower())(twin, path, overwrite)


def check_export(path: Path, overwrite: bool) -> None:
    """Raise OptionError unless the suffix is known, and OutputError unless ``path`` may be written."""
    if path.suffix.lower() not in FORMATS:
        raise OptionError(f"{path} has no suffix that says what to write; use one of {', '.join(FORMATS)}")
    check_free(path, overwrite, "scene.xml" if path.suffix.lower() == ".mitsuba" else None)


def _writer(suffix: str) -> Callable[[Twin, Path, bool], None]:
    """The function that writes files of ``suffix``, in the module of its name."""
    name = suffix.removeprefix(".")
    return getattr(import_module(f"endotwin.export.{name}"), f"write_{name}")
