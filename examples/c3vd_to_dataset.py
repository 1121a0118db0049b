"""From a C3VD download to a labelled dataset with new poses, a rougher wall and a dimmer light.

    python examples/c3vd_to_dataset.py C3VD/cecum_t1_a dataset [--scale 0.5] [--frames 200]

The first argument is one video's folder as C3VD ships it (https://durrlab.github.io/C3VD/), version 1
(``NNNN_color.png``, ``NNNN_depth.tiff``, ``pose.txt``) or 2 (``rgb/``, ``depth/``, ``pose.txt``). Any other
sequence that endotwin reads will do. The dataset has C3VD's layout again.
"""

import argparse
from pathlib import Path

import endotwin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path, help="folder of one C3VD video")
    parser.add_argument("dataset", type=Path, help="folder to make")
    parser.add_argument("--scale", type=float, default=0.5, help="factor on C3VD's 1350×1080 pixels")
    parser.add_argument("--frames", type=int, default=200, help="frames to render")
    parser.add_argument("--budget", type=float, help="seconds for the fit")
    parser.add_argument("--twin", type=Path, help="folder to keep the twin in, to inspect or export it")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for folder in (options.dataset, options.twin):
        if folder is not None and folder.exists():
            parser.error(f"{folder} is there already; name another folder")

    twin = endotwin.fuse_twin(options.sequence, scale=options.scale)
    twin = endotwin.fit_twin(twin, budget_s=options.budget, seed=options.seed)
    print(endotwin.evaluate(twin))
    if options.twin is not None:
        twin.save(options.twin)
    summary = endotwin.synthesize(
        twin,
        f"jitter:frames={options.frames},translation=2,rotation=10",
        options.dataset,
        material=["roughness*1.3"],
        light=["intensity*0.8"],
        seed=options.seed,
        workers=0,
    )
    print(summary)


if __name__ == "__main__":
    main()
