"""What every command does the same way: progress on stderr, warnings, what each stage cost."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from endotwin.errors import OutputError
from endotwin.run.output import check_free, whole_file
from endotwin.run.stopwatch import Stopwatch

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there already.")]
Profile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Write each stage's seconds and the main process's peak memory to FILE, as JSON."
    ),
]
Config = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE.yaml",
        help="draft, standard or fine: how much time to spend; or a file of your own. Options win over it.",
    ),
]
TwinFolder = Annotated[
    Path,
    typer.Argument(metavar="TWIN", show_default=False, help="A twin folder, as 'endotwin fuse' writes it."),
]

SPEED_PERIOD_S = 120.0
"""Time left is told from the speed of the latest seconds."""


class _WarningLines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print("warning:", record.getMessage(), file=sys.stderr)


class Run:
    """A command at work: times its stages, and shows a bar where a person watches."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        console = Console(stderr=True)
        columns = [TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}")]
        self.stopwatch = Stopwatch()
        self.bars = Progress(
            *columns,
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=SPEED_PERIOD_S,
        )
        self._bar = None
        self._label, self._began = "", None

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
        self.bars.update(self._bar, completed=done, total=total, count=f"{done}/{total}{self._rate(done)}")

    def _rate(self, done: int) -> str:
        """Steps a second since the first call of ``progress`` with this label, once it is known."""
        now = time.perf_counter()
        if self._began is None:
            self._began = (now, done)
        started, before = self._began
        return f" · {(done - before) / (now - started):.1f}/s" if done > before and now > started else ""

    def _show(self, label: str, total: int | None) -> None:
        if self._bar is not None:
            self.bars.remove_task(self._bar)
        self._label, self._began = label, None
        self._bar = self.bars.add_task(label, total=total, count="")


def _check_profile(path: Path) -> None:
    """Raise OutputError unless ``path`` is free, or an earlier profile to be replaced."""
    check_free(path, overwrite=True)
    try:
        replaceable = not path.exists() or {"command", "seconds"} <= set(
            json.loads(path.read_text(encoding="utf-8"))
        )
    except (OSError, ValueError, TypeError):
        replaceable = False
    if not replaceable:
        raise OutputError(f"{path} exists already and is no profile of endotwin's; choose another name")


@contextmanager
def command(name: str, profile: Path | None = None) -> Iterator[Run]:
    """A run that shows warnings as lines and, where the block ends well, says on stderr what it cost."""
    if profile is not None:
        _check_profile(profile)
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
        _check_profile(profile)  # again: it may be the name of what the block wrote
        with whole_file(profile, overwrite=True) as file:
            cost = {"command": name, **run.stopwatch.to_dict()}
            file.write_text(json.dumps(cost, indent=1) + "\n", encoding="utf-8")
    print(f"{name}: {run.stopwatch}", file=sys.stderr)
