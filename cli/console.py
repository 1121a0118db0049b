"""What every command does the same way: progress on stderr, warnings, what each stage cost."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from endotwin.output import check_free, whole_file
from endotwin.stopwatch import Stopwatch

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there already.")]
Profile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Write each stage's seconds and the peak memory to FILE, as JSON."),
]
TwinFolder = Annotated[
    Path,
    typer.Argument(metavar="TWIN", show_default=False, help="A twin folder, as 'endotwin fuse' writes it."),
]


class _WarningLines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print("warning:", record.getMessage(), file=sys.stderr)


class Run:
    """A command at work: times its stages, and shows a bar where a person watches."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        columns = [TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}")]
        self.stopwatch = Stopwatch()
        self.bars = Progress(
            *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
        )
        self._bar = None
        self._label = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block as ``name``, under a bar of unknown length until ``progress`` is called."""
        self._show(name, None)
        with self.stopwatch.stage(name):
            yield

    def progress(self, label: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of ``label`` are done."""
        if label != self._label:
            self._show(label, total)
        self.bars.update(self._bar, completed=done, total=total, count=f"{done}/{total}")

    def _show(self, label: str, total: int | None) -> None:
        if self._bar is not None:
            self.bars.remove_task(self._bar)
        self._label = label
        self._bar = self.bars.add_task(label, total=total, count="")


@contextmanager
def command(name: str, profile: Path | None = None) -> Iterator[Run]:
    """A run that shows warnings as lines and, where the block ends well, says on stderr what it cost."""
    if profile is not None:
        check_free(profile, overwrite=True)
    handler = _WarningLines(logging.WARNING)
    logger = logging.getLogger("endotwin")
    logger.addHandler(handler)
    run = Run()
    try:
        with run.bars:
            yield run
    finally:
        logger.removeHandler(handler)
    if profile is not None:
        with whole_file(profile, overwrite=True) as file:
            file.write_text(json.dumps({"command": name, **run.stopwatch.to_dict()}, indent=1) + "\n")
    print(f"{name}: {run.stopwatch}", file=sys.stderr)
