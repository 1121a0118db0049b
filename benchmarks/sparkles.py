"""Highlights of held-out photos, of a twin without its sparkles, and with them: how many of which size.

python benchmarks/sparkles.py TWIN
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.stats import wasserstein_distance

from endotwin.evaluation.evaluation import gain_of
from endotwin.evaluation.highlights import highlights, log_areas
from endotwin.evaluation.metrics import psnr
from endotwin.render import Renderer
from endotwin.twin import Twin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("twin")
    twin = Twin.load(parser.parse_args().twin)
    sequence, plain = twin.sequence(), replace(twin, effects=twin.effects.without(["sparkle"]))
    renderers = {"film": Renderer(plain, sequence.camera), "sparkles": Renderer(twin, sequence.camera)}
    areas = {name: [] for name in ("photo", *renderers)}
    quality = {name: [] for name in renderers}
    for index in twin.source.heldout(len(sequence)):
        frame = sequence.frame(index)
        photo, gain = frame.color.astype(np.float32) / 255, 1.0
        for name, renderer in renderers.items():
            view = renderer.view(frame.T_world_camera, sequence.lens_mask)
            valid = view.mask & np.isfinite(frame.depth_mm)
            if name == "film":
                gain = gain_of(twin.untoned(photo[valid]), view.radiance[valid], twin.response.gamma)
                areas["photo"].append(log_areas(highlights(photo, valid)))
            view = renderer.view(frame.T_world_camera, sequence.lens_mask, gain)
            areas[name].append(log_areas(highlights(view.color, valid)))
            quality[name].append(psnr(photo, view.color, valid))
    print("| | highlights a photo | by log2 of area, px | doublings of area off the photo's | PSNR |")
    print("|---|---|---|---|---|")
    for name, each in areas.items():
        count = np.histogram(np.concatenate(each), np.arange(13))[0]
        off = np.mean([wasserstein_distance(*pair) for pair in zip(areas["photo"], each, strict=True)])
        row = f"{count.sum() / len(each):.0f} | {' '.join(map(str, count))} | {off:.2f}"
        shown = f"{np.mean(quality[name]):.2f} dB" if name in quality else ""
        print(f"| {name} | {row} | {shown} |")


if __name__ == "__main__":
    main()
