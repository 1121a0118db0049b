"""``endotwin fit``: materials, light and response from the photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.errors import OutputError
from endotwin.output import check_free


def fit(
    twin_folder: console.TwinFolder,
    method: Annotated[
        str,
        typer.Option(
            metavar="twin|endopbr",
            help="twin: endotwin's own. endopbr: Han & Wu 2025 as published; slow without a GPU.",
        ),
    ] = "twin",
    budget: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Stop after this time.", show_default="the method's own"),
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Passes over the training photos (endopbr).", show_default="the method's own"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of all random choices.")] = 0,
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

    Example: endotwin fit twin --budget 60
    """
    if output is not None:
        check_free(output, overwrite)
    with console.command("fit", profile) as run:
        with run.stage("import"):
            from endotwin.pipeline import fit_twin
            from endotwin.twin import Twin
        twin = Twin.load(twin_folder)
        if output is None and twin.fitted and not overwrite:
            raise OutputError(f"{twin_folder} is fitted already; pass --overwrite, or -o OTHER to keep it")
        with run.stage("fit"):
            twin = fit_twin(twin, method, budget_s=budget, epochs=epochs, seed=seed, progress=run.progress)
        with run.stage("write"):
            twin.save(output or twin_folder, overwrite=True)
    light = f"L0 {twin.light.L0:.4g}, n {twin.light.n:.3f}, q {twin.light.q:.3f}"
    print(f"wrote {output or twin_folder}: {light}, γ {twin.response.gamma:.4f}")
