"""``endotwin fit``: materials, light and response from the photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.config import DEFAULT, load_config, seconds
from endotwin.effects import parse_states
from endotwin.errors import OutputError
from endotwin.run.output import TWIN, check_free

AROUND = 0.2
"""Python's start before the stopwatch's, in shares of the time that the imports took."""

LEAST_S = 0.1
"""A budget already spent on the start still asks for the least that a fit can be."""


def fit(
    twin_folder: console.TwinFolder,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="twin|endopbr",
            help="twin: endotwin's own. endopbr: Han & Wu 2025 as published; slow without a GPU.",
            show_default="twin",
        ),
    ] = None,
    config: console.Config = DEFAULT,
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Give the best twin of this time: 10, 10s or 2m, of the whole command.",
            show_default="the method's own",
        ),
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Passes over the training photos (endopbr).", show_default="the method's own"
        ),
    ] = None,
    effects: Annotated[
        str,
        typer.Option(
            metavar="NAME=STATE,…",
            help="auto, on or off by name, as in shadows=off,gain=on; auto unless named.",
            show_default=False,
        ),
    ] = "",
    align: Annotated[
        str | None,
        typer.Option(
            metavar="auto|on|off",
            help="Align the photos to the surface first, as 'endotwin align' does.",
            show_default="as decided before, else auto; off under a budget and for endopbr",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of all random choices.")] = 0,
    device: Annotated[
        str,
        typer.Option(metavar="cpu|cuda|auto", help="Where to compute; auto: on a GPU if there is one."),
    ] = "cpu",
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="OTHER", help="Write the fitted twin there.", show_default="TWIN itself"
        ),
    ] = None,
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Fit base colour, roughness, metallic, the light and the camera response to TWIN's training photos.

    A stopped fit with --method endopbr goes on when the same command is given again.

    Example: endotwin fit twin --budget 60s
    """
    if output is not None:
        check_free(output, overwrite, TWIN)
    target = (output or twin_folder).absolute()
    settings = load_config(config)
    plan, states = settings.fit, {**settings.effects, **parse_states(effects)}
    budget_s = plan.budget if budget is None else seconds(budget)
    with console.command("fit", profile) as run:
        with run.stage("import"):
            from endotwin.pipeline import fit_twin
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        if output is None and twin.fitted and not overwrite:
            raise OutputError(f"{twin_folder} is fitted already; pass --overwrite, or -o OTHER to keep it")
        if budget_s is not None:
            budget_s = max(LEAST_S, budget_s - run.stopwatch.total - AROUND * run.stopwatch.seconds["import"])
        with run.stage("fit"):
            twin = fit_twin(
                twin,
                method,
                budget_s=budget_s,
                epochs=epochs,
                seed=seed,
                config=plan,
                effects=states,
                align=align,
                progress=run.progress,
                checkpoint=target.with_name(f".{target.name}.fit"),
                device=device,
            )
        run.stopwatch.parts["fit"] = twin.record["fit"]["stages"]
        with run.stage("write"):
            twin.save(target, overwrite=True)
    light = f"L0 {twin.light.L0:.4g}, n {twin.light.n:.3f}, q {twin.light.q:.3f}"
    extra = ", ".join(name for name in twin.effects if name != "specular") or "none"
    print(f"wrote {output or twin_folder}: {light}, γ {twin.response.gamma:.4f}, effects: {extra}")
