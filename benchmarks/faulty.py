"""What faulty photos cost: some of a sequence's training photos are spoilt, and the others score the twin.

    python benchmarks/faulty.py examples/colon_small --scale 0.5

One in seven of the training photos is spoilt; poses, depth and held-out photos stay as they are. "named" are
those that `fit` tells to leave out, of those that were spoilt and of all others; "left out" is the twin of
``fuse --without`` the spoilt ones.
"""

import argparse
import logging
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

import endotwin

EVERY = 7

Fault = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""From a photo uint8 [H, W, 3], BGR, its faulty version, values 0 … 255."""


def blurred(photo: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """By a hundredth of its width."""
    return cv2.GaussianBlur(photo, (0, 0), photo.shape[1] / 100)


def smeared(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A drop on the lens, a quarter of the picture wide, blurs and veils what is behind it."""
    height, width = photo.shape[:2]
    y, x = np.mgrid[:height, :width]
    at = rng.uniform(0.3, 0.7, 2) * (width, height)
    drop = np.exp(-(((x - at[0]) / (width / 4)) ** 2) - ((y - at[1]) / (height / 4)) ** 2)[..., None]
    return photo * (1 - drop) + (0.8 * cv2.GaussianBlur(photo, (0, 0), width / 70) + 40) * drop


def with_tool(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A grey instrument with a bright edge comes in from below."""
    height, width = photo.shape[:2]
    tip = (rng.uniform(0.3, 0.6, 2) * (width, height)).astype(int)
    base = np.array([rng.uniform(0.7, 1.1) * width, 1.1 * height]).astype(int)
    photo = photo.copy()
    for aside, grey, share in ((0, 150, 0.1), (width // 80, 225, 0.02)):
        ends = ((end + aside).tolist() for end in (tip, base))
        cv2.line(photo, *ends, (grey,) * 3, int(share * width), cv2.LINE_AA)
    return photo


def bubbly(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sixty bubbles, rings with a glint each."""
    height, width = photo.shape[:2]
    photo = photo.copy()
    for _ in range(60):
        x, y = (rng.random(2) * (width, height)).astype(int).tolist()
        radius = int(width * rng.uniform(0.01, 0.05))
        cv2.circle(photo, (x, y), radius, (180, 190, 215), 2, cv2.LINE_AA)
        cv2.circle(photo, (x - radius // 3, y - radius // 3), 2, (255,) * 3, -1)
    return photo


FAULTS: dict[str, Fault] = {
    "none": lambda photo, _: photo,
    "blurred by 1 % of the width": blurred,
    "a drop on the lens": smeared,
    "an instrument": with_tool,
    "bubbles": bubbly,
    "red × 0.9": lambda photo, _: photo * [1, 1, 0.9],
    "all × 0.8": lambda photo, _: 0.8 * photo,
    "white": lambda photo, _: np.full_like(photo, 255),
}


class Named(logging.Handler):
    """The frames that warnings tell to leave out."""

    def __init__(self):
        super().__init__(logging.WARNING)
        self.frames: set[int] = set()

    def emit(self, record: logging.LogRecord) -> None:
        if found := re.search(r"--without ([\d,]+)", record.getMessage()):
            self.frames |= set(map(int, found[1].split(",")))


def rows(options: argparse.Namespace) -> Iterator[list[str]]:
    """The table, a row a fault."""
    sequence, clean_db = endotwin.open_sequence(options.sequence), 0.0
    for name, fault in FAULTS.items():
        with tempfile.TemporaryDirectory() as work:
            folder = Path(shutil.copytree(sequence.path, Path(work) / "faulty"))
            twin = endotwin.fuse_twin(folder, scale=options.scale)
            faulty = twin.source.training(len(sequence))[EVERY // 2 :: EVERY] if name != "none" else []
            for index in faulty:
                file = str(folder / sequence.color_files[index].relative_to(sequence.path))
                photo = fault(cv2.imread(file), np.random.default_rng([options.seed, index]))
                cv2.imwrite(file, np.rint(np.clip(photo, 0, 255)).astype(np.uint8))
            named = Named()
            logging.getLogger("endotwin").addHandler(named)
            twin = endotwin.fit_twin(twin)
            logging.getLogger("endotwin").removeHandler(named)
            scores = endotwin.evaluate(twin)
            clean_db = clean_db or scores.psnr_covered
            left = scores
            if faulty:
                fused = endotwin.fuse_twin(folder, scale=options.scale, without=faulty)
                left = endotwin.evaluate(endotwin.fit_twin(fused))
        yield [
            name,
            f"{scores.psnr_covered:.2f} dB",
            f"{clean_db - scores.psnr_covered:+.2f} dB",
            f"{twin.response.gamma:.4f}",
            f"{twin.light.n:.3f}",
            f"{len(named.frames & set(faulty))} of {len(faulty)}, {len(named.frames - set(faulty))}",
            f"{left.psnr_covered:.2f} dB",
            f"{left.gamma:.4f}",
        ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path, help="a folder")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the image size")
    parser.add_argument("--seed", type=int, default=0)
    titles = ["fault", "covered", "lost", "γ", "n", "named", "left out: covered", "γ"]
    for row in (titles, ["---"] * len(titles)):
        print("| " + " | ".join(row) + " |", flush=True)
    for row in rows(parser.parse_args()):
        print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
