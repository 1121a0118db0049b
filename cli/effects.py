"""``endotwin effects``: which effects a twin has, and why."""

from __future__ import annotations

import json as json_format
from typing import Annotated

import typer
from endotwin.cli import console


def effects(
    twin_folder: console.TwinFolder,
    json: Annotated[
        bool, typer.Option("--json", help="Print the decisions as JSON instead of a table.")
    ] = False,
) -> None:
    """List the effects of a fitted TWIN: on or off, the evidence, and the price of each.

    Example: endotwin effects twin
    """
    from dataclasses import asdict

    from rich import box
    from rich.console import Console
    from rich.table import Table

    from endotwin.effects import NAMES
    from endotwin.errors import TwinError
    from endotwin.twin import Twin

    twin = Twin.load(twin_folder)
    if not twin.decisions:
        raise TwinError(f"{twin_folder} has no effects yet; run 'endotwin fit' with the method twin on it")
    decisions = {name: twin.decisions[name] for name in NAMES if name in twin.decisions}
    if json:
        print(json_format.dumps({"effects": {name: asdict(value) for name, value in decisions.items()}}))
        return
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in ("effect", "state", "why", "gain", "fit", "a frame", "memory"):
        table.add_column(heading, no_wrap=heading != "why")
    for name, found in decisions.items():
        gain = "-" if found.gain_db is None else f"{found.gain_db:+.2f} dB"
        price = [f"{found.fit_s:.1f} s", f"{found.render_ms:.0f} ms", f"{found.memory_mb:.0f} MB"]
        table.add_row(name, found.state, found.reason, gain, *price)
    Console().print(table)
