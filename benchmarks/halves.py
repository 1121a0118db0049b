"""What half of a recording tells: does the twin hang on which frames there are?

    python benchmarks/halves.py DATA/colon_wet --draws 8

fuses, fits and scores the even frames, the odd ones, the first and the last half, and halves drawn at random,
beside the whole. Columns: PSNR of the whole and the covered part of held-out photos; errors of γ, n and q
against ``truth/made.json``; the farthest that a light guide was found from where it is; precision and recall
of highlight pixels; effects that are on.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import endotwin
from endotwin.evaluation.evaluation import Evaluation
from endotwin.sequence import Sequence
from endotwin.sequence.poses import write_c3vd_poses

COLUMNS = ("frames", "PSNR", "covered", "γ", "n", "q", "guides", "precision", "recall", "effects")
GAMMA, Q = 1 / 2.2, 2.0
"""Of all sequences with truth."""


def halves(count: int, draws: int) -> Iterator[tuple[str, np.ndarray]]:
    """Names, and numbers of frames, of halves of ``count`` frames."""
    every = np.arange(count)
    yield "all", every
    yield "even", every[::2]
    yield "odd", every[1::2]
    yield "first", every[: count // 2]
    yield "last", every[count // 2 :]
    for seed in range(draws):
        yield f"draw {seed}", np.sort(np.random.default_rng(seed).choice(count, count // 2, replace=False))


def copied(sequence: Sequence, frames: np.ndarray, folder: Path) -> Path:
    """``frames`` of a sequence in C3VD's layout, in ``folder``, which is returned."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        for file in (sequence.color_files[frame], sequence.depth_files[frame]):
            shutil.copy(file, folder / f"{number:04d}_{file.name.partition('_')[2]}")
    write_c3vd_poses(folder / "pose.txt", sequence.T_world_camera[frames])
    (folder / "camera.json").write_text(json.dumps(sequence.camera.to_dict()))
    return folder


def row(name: str, frames: np.ndarray, scores: Evaluation, made: dict) -> list[str]:
    """Of the table."""
    twin, lights = scores.scored, np.array(made.get("lights", ())).reshape(-1, 3)
    found = np.array(twin.effects.guides_mm or [(0.0, 0.0, 0.0)])
    apart_mm = np.linalg.norm(lights[:, None] - found, axis=2).min(axis=1)
    return [
        *(name, str(len(frames)), f"{scores.psnr:.2f} dB", f"{scores.psnr_covered:.2f} dB"),
        f"{twin.response.gamma / GAMMA - 1:+.1%}",
        f"{twin.light.n / made['spread'] - 1:+.1%}" if "spread" in made else "-",
        f"{twin.light.q / Q - 1:+.1%}",
        f"{apart_mm.max():.2f} mm" if len(lights) else "-",
        *(f"{scores.mean(score):.2f}" for score in ("precision", "recall")),
        ", ".join(name for name, each in twin.decisions.items() if each.state == "on"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--draws", type=int, default=8, help="halves drawn at random (default 8)")
    options = parser.parse_args()
    sequence = endotwin.open_sequence(options.sequence)
    truth = options.sequence / "truth" / "made.json"
    made = json.loads(truth.read_text()) if truth.exists() else {}
    print("| half |", " | ".join(COLUMNS), "|")
    print("|---" * (1 + len(COLUMNS)) + "|")
    for name, frames in halves(len(sequence), options.draws):
        with tempfile.TemporaryDirectory() as work:
            fused = endotwin.fuse_twin(copied(sequence, frames, Path(work) / "half"))
            cells = row(name, frames, endotwin.evaluate(endotwin.fit_twin(fused)), made)
        print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
