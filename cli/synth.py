"""``endotwin synth``: a labelled dataset from a twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from endotwin.cli import console

from endotwin.effects import parse_states
from endotwin.errors import OptionError
from endotwin.run.output import DATASET, check_apart, check_free, check_picture

LABELS = (
    "rgb, rgb_linear, rgb_exr, depth, depth_exr, normals, mask, albedo, roughness, metallic, diffuse, "
    "specular, flow, flow_forward, flow_exr, flow_npz, flow_forward_exr, flow_forward_npz, occlusion, "
    "triangles, overlay; of polyps polyp; of fluids fluid; of motion scene_flow, scene_flow_forward, "
    "vertices; 'all'"
)


def synth(
    twin_folder: console.TwinFolder,
    trajectory: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            show_default=False,
            help="A pose file (C3VD pose.txt, TUM, transforms.json), 'jitter:…', 'centerline:…', "
            "'spline:FILE,…' or 'orbit:…'.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DATASET", show_default=False, help="Folder for the dataset."),
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=f"What to write, joined by commas: {LABELS}.",
            show_default="rgb,depth,normals,mask, and polyp or fluid where there are some",
        ),
    ] = None,
    layout: Annotated[
        str,
        typer.Option(metavar="NAME", help="c3vd, c3vd2, transforms, tum, simcol, flat or webdataset."),
    ] = "c3vd",
    camera: Annotated[
        Path | None,
        typer.Option(metavar="CAMERA.json", help="Render through this camera.", show_default="the twin's"),
    ] = None,
    material: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EDIT",
            help="Change base_color, roughness or metallic, such as 'roughness*1.3'; may be repeated. "
            "Highlights stay white: metallic only darkens the base colour.",
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EDIT",
            help="Change the light's intensity, n, q, color.r, .g, .b or offset.x, .y, .z, such as "
            "'intensity*0.8'; may be repeated.",
        ),
    ] = None,
    vary: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.yaml", help="Draw edits from the ranges in this file, for each frame or clip."
        ),
    ] = None,
    effects: Annotated[
        str,
        typer.Option(
            metavar="NAME=STATE,…",
            help="Effects on or off, as in noise=on,shadows=off; as the twin has them unless named. "
            "like=SEQUENCE: with the noise, lens, sharpening, JPEG quality and more that its photos show.",
            show_default=False,
        ),
    ] = "",
    motion: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND:…",
            help="Let the tissue move: 'peristalsis:amplitude=…,width=…,speed=…,delay=…,pulse=…' or "
            "'breathing:amplitude=…,period=…,follow=…'; may be repeated.",
        ),
    ] = None,
    polyp: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CLASS:…",
            help="Grow polyps on the wall, of the Paris classes Ip (on a stalk), Is (sessile), IIa (slightly "
            "elevated), IIb (flat) or IIc (slightly depressed): "
            "'Is:size=6,height=…,count=3,ihb=…', at random where the trajectory sees the wall, or at "
            "'x=…,y=…,z=…' or 'frame=…,u=…,v=…'; may be repeated.",
        ),
    ] = None,
    fluid: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND:…",
            help="Let fluid lie on the wall, blood, mucus or stool: 'blood:size=12,thickness=…,count=2,…' "
            "or, level in a hollow, 'stool:pool=true', at random where the trajectory sees the wall, or at "
            "'x=…,y=…,z=…' or 'frame=…,u=…,v=…'; may be repeated.",
        ),
    ] = None,
    clearance: Annotated[
        float, typer.Option(metavar="MM", help="Least distance of a pose from the wall.")
    ] = 1.0,
    max_unseen: Annotated[
        float,
        typer.Option(metavar="SHARE", help="Greatest share of a view on unseen, filled-in or no surface."),
    ] = 0.5,
    max_distance: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Greatest distance of a pose from the training views.", show_default="any"
        ),
    ] = None,
    preview: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png", help="Draw the poses in the mesh and a contact sheet, and render no dataset."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option(metavar="N", min=0, help="Processes to render in.", show_default="all cores")
    ] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="tcp://…", help="Render on the workers of this Dask scheduler.", show_default=""
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of all random choices.")] = 0,
    overwrite: console.Overwrite = False,
    profile: console.Profile = None,
) -> None:
    """Render a labelled dataset at new poses, materials and lights.

    The same command and seed give the same bytes. A run that was stopped goes on when the command is run
    again.

    Example: endotwin synth twin --trajectory jitter:frames=100 --material 'roughness*1.3' -o dataset
    """
    if (output is None) == (preview is None):
        raise OptionError("give -o DATASET for a dataset, or --preview FILE.png for a look at its poses")
    if preview:
        check_picture(preview, overwrite)
    elif not output.absolute().with_name(f"{output.name}.partial").exists():
        check_free(output, overwrite, DATASET)
        check_apart(output, [twin_folder, trajectory, vary, camera])
    with console.command("synth", profile) as run:
        with run.stage("import"):
            from endotwin import pipeline
            from endotwin.synth import Limits
            from endotwin.twin import Twin
        with run.stage("load"):
            twin = Twin.load(twin_folder)
        limits = Limits(clearance, max_unseen, float("inf") if max_distance is None else max_distance)
        choices = {"material": material or (), "light": light or (), "vary": vary, "camera": camera}
        choices |= {
            "effects": parse_states(effects, like=True),
            "motion": motion or (),
            "polyps": polyp or (),
            "fluids": fluid or (),
        }
        choices |= {"limits": limits, "seed": seed, "overwrite": overwrite}
        with run.stage("synth"):
            if preview:
                summary = pipeline.preview(twin, trajectory, preview, **choices)
            else:
                choices |= {"labels": labels, "layout": layout, "workers": workers, "scheduler": scheduler}
                choices |= {"progress": run.progress}
                summary = pipeline.synthesize(twin, trajectory, output, **choices)
    print(f"wrote {summary}")
