"""Layouts of a dataset on disk, by name."""

from endotwin.synth.layouts import c3vd, flat, simcol, transforms, tum, webdataset
from endotwin.synth.layouts.layout import Layout

__all__ = ["LAYOUTS", "Layout"]

LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        c3vd.V1,
        c3vd.V2,
        transforms.LAYOUT,
        tum.LAYOUT,
        simcol.LAYOUT,
        flat.LAYOUT,
        webdataset.LAYOUT,
    )
}
