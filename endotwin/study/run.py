"""The experiment: datasets rendered, networks trained and judged, each result kept as soon as it is there."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from endotwin import pipeline
from endotwin.cameras import Camera
from endotwin.errors import OptionError, OutputError, TwinError
from endotwin.run.output import (
    DATASET,
    STUDY,
    check_apart,
    check_free,
    copy_folder,
    goes_on,
    move_folder,
    unwritable,
    whole_file,
)
from endotwin.run.threads import THREADS, device_of
from endotwin.run.together import together
from endotwin.sequence import Sequence
from endotwin.sequence.readers import open_sequence
from endotwin.study import judge, report
from endotwin.study.arms import HEADLINE, Arm, arms
from endotwin.study.frames import Frames, kept, lit_pixels, of_dataset, of_sequence, require_depth
from endotwin.study.leak import require_unseen
from endotwin.study.networks import found, network
from endotwin.study.recipe import OTHER_LENSES, RENDERED, TRAJECTORY, Recipe
from endotwin.study.train import LOSSES, Course, finished, train
from endotwin.tradeoff.run import PARTIAL, machine
from endotwin.twin import Twin

Progress = Callable[[str, int, int], None]

OWN = ("study", "results", "networks", "recipes", "depth")
"""First parts of the names that a finished folder holds."""

SUPERSAMPLING = 2
"""Frames are rendered at so many times the network's width, and each pixel is the mean of what it covers."""

MOST = 1_000_000
"""Of frames, seeds and steps, each."""


@dataclass(frozen=True)
class Plan:
    """What is asked.

    Attributes:
        parts: of ``arms.PARTS``; the headline is always there.
        network: ``auto``, ``small``, or a folder with weights of Depth Anything.
        frames: that are rendered for an arm. seeds: trainings of each arm.
        steps: of each training; None: the network's own. loss: a name among ``train.LOSSES``.
        device: cpu, cuda or auto.
    """

    parts: tuple[str, ...] = ("headline",)
    network: str = "auto"
    frames: int = 500
    steps: int | None = None
    seeds: int = 3
    loss: str = "huber"
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("frames", "seeds", "steps"):
            number = getattr(self, name)
            if number is not None and not 1 <= number <= MOST:
                raise OptionError(f"the number of {name} is {number}, but must lie between 1 and {MOST:,}")
        if self.loss not in LOSSES:
            raise OptionError(f"there is no loss {self.loss!r}; choose one of {', '.join(LOSSES)}")


def study_depth(
    real: list[Path],
    twins: list[Path],
    tests: list[Path],
    out: Path,
    plan: Plan = Plan(),
    overwrite: bool = False,
    progress: Progress | None = None,
) -> report.Findings:
    """Train depth networks on real frames, on frames rendered from twins, and on both; judge them on others.

    Until all is done what is found lies in ``out.partial``, and the same call goes on from there.
    Frames are rendered in processes: a script that calls this needs ``if __name__ == "__main__":``.

    Args:
        real: sequences, all of whose frames are trained on.
        twins: fitted twins that frames are rendered from.
        tests: sequences, all of whose frames are tested on; no twin and no network may have seen them.

    Raises:
        LeakError: one has. SequenceError, TwinError: an input cannot be used. OptionError: an option makes no
        sense. OutputError: ``out`` is taken, or ``out.partial`` is another study's.
    """
    if find_spec("webdataset") is None:
        raise OptionError(
            "the study reads datasets with webdataset; install it with pip install 'endotwin[depth]'"
        )
    check_free(out, overwrite, STUDY)
    check_apart(out, [*real, *twins, *tests])
    experiment = _Experiment(real, twins, tests, out, plan, progress or (lambda *_: None))
    try:
        return experiment.run()
    except OSError as error:
        told = unwritable(Path(error.filename or experiment.work), error)
        raise OutputError(f"{told}; the same command goes on from {experiment.work}") from error


class _Experiment:
    """What ``study_depth`` does, in the folder ``out.partial`` and at last in ``out``."""

    def __init__(
        self,
        real: list[Path],
        twins: list[Path],
        tests: list[Path],
        out: Path,
        plan: Plan,
        progress: Progress,
    ) -> None:
        for what, given in (("--real", real), ("--twin", twins), ("--test", tests)):
            if not given:
                raise OptionError(f"the study needs at least one {what}")
            places = [Path(path).resolve() for path in given]
            if twice := [path for path, place in zip(given, places, strict=True) if places.count(place) > 1]:
                raise OptionError(f"{twice[0]} is named twice as {what}; name it once")
        self.plan, self.out, self.progress = plan, Path(out), progress
        self.work = self.out.absolute().with_name(self.out.name + PARTIAL)
        self.device = device_of(plan.device)
        self.twins = {Path(folder): _fitted(folder) for folder in twins}
        self.real, self.tests = ([open_sequence(path) for path in each] for each in (real, tests))
        self.unseen, self.sums = require_unseen(self.tests, self.real, self.twins)
        self.network = found(plan.network)
        sample = network(self.network, 0)
        self.size, self.batch, self.rate = sample.size, sample.batch, sample.rate
        for sequence in (*self.real, *self.tests):
            require_depth(sequence, self.size)
        self.steps = (
            plan.steps or getattr(sample, "steps", None) or sample.epochs * plan.frames // sample.batch
        )
        self.parameters = sum(each.numel() for each in sample.parameters() if each.requires_grad)
        self.arms = arms(plan.parts, plan.frames)
        self._pools: dict[str, Frames] = {}
        self._tested: list[Frames] = []

    def run(self) -> report.Findings:
        self._enter()
        try:
            tests = enumerate(self.tests)
            self._tested = [self._sequences(f"test-{number}", [test], self.size) for number, test in tests]
            self._train_all()
            if self.network != "small":
                self._zero_shot()
            if "robustness" in self.plan.parts:
                self._robustness()
        except BaseException as stopped:
            stopped.add_note(f"the same command goes on from {self.work}")
            raise
        findings = report.Findings.read(self.work, self.arms, self.plan.seeds, self._facts())
        report.write(findings, self.work)
        self._tested.clear()  # which hold files open
        self._pools.clear()
        for name in ("datasets", "frames"):
            shutil.rmtree(self.work / name, ignore_errors=True)
        move_folder(self.work, self.out, lambda name: name.parts[0].partition(".")[0] in OWN)
        return findings

    def _enter(self) -> None:
        """Make the working folder; or go on in it, or from what is in ``out``, if that was asked then too."""
        asked = {
            "real": [str(sequence.path.resolve()) for sequence in self.real],
            "twins": {str(folder.resolve()): twin.seal for folder, twin in self.twins.items()},
            "tests": [str(sequence.path.resolve()) for sequence in self.tests],
            "checksums": self.sums,
            "network": self.network,
            "parameters": self.parameters,
            "rendered": RENDERED.vary,
            "frames": self.plan.frames,
            "steps": self.steps,
            "batch": self.batch,
            "loss": self.plan.loss,
        }
        done = self.out / STUDY
        if (
            not goes_on(self.work, STUDY, asked, "another study or network, or of other frames")
            and done.exists()
            and _read(done) == asked
        ):
            copy_folder(self.out, self.work)  # more parts are wanted
        for folder in ("results", "networks", "recipes", "datasets", "frames"):
            (self.work / folder).mkdir(parents=True, exist_ok=True)
        _keep(asked, self.work / STUDY)

    # What is trained and tested on

    def _sequences(self, name: str, sequences: list[Sequence], size: tuple[int, int]) -> Frames:
        """Frames of sequences at ``size``."""
        frames = chain.from_iterable(of_sequence(sequence, size) for sequence in sequences)
        asked = {"source": ", ".join(str(sequence.path) for sequence in sequences), "size": list(size)}
        return kept(frames, sum(map(len, sequences)), size, self.work / "frames" / name, asked)

    def _pool(self, name: str) -> Frames:
        if name not in self._pools:
            if name == "real":
                self._pools[name] = self._sequences("real", self.real, self.size)
            else:
                recipe = next(arm.recipe for arm in self.arms if arm.recipe and arm.recipe.name == name)
                self._pools[name] = self._rendered(recipe)
        return self._pools[name]

    def _rendered(self, recipe: Recipe) -> Frames:
        """The frames of a recipe: evenly from all twins, through each lens its share."""
        lenses = [(twin, *lens) for twin in self.twins.values() for lens in self._lenses(twin, recipe)]
        shares = np.cumsum([share for *_, share in lenses])
        counts = np.diff(np.rint(self.plan.frames * shares / shares[-1]).astype(int), prepend=0).tolist()
        recipe.write(self.work / "recipes" / f"{recipe.name}.yaml")
        parts, count = [], 0
        for number, ((twin, lens, lit, _), wanted) in enumerate(zip(lenses, counts, strict=True)):
            if wanted:
                data = self._dataset(recipe, number, twin, lens, wanted)
                parts.append(of_dataset(data, self.size, lit, recipe.codec, number))
                count += _read(data / DATASET)["frames"]
        folder = self.work / "frames" / recipe.name
        return kept(chain(*parts), count, self.size, folder, {"source": recipe.name, "size": list(self.size)})

    def _dataset(self, recipe: Recipe, number: int, twin: Twin, lens: Camera, count: int) -> Path:
        """The dataset of that ``number`` of a recipe, of so many poses, rendered unless it is there."""
        name = f"{recipe.name}-{number}"
        data, lens_file = self.work / "datasets" / name, self.work / "recipes" / f"{name}.camera.json"
        if not data.exists():
            _keep(lens.to_dict(), lens_file)
            pipeline.synthesize(
                twin,
                f"{TRAJECTORY},frames={count}",
                data,
                vary=self.work / "recipes" / f"{recipe.name}.yaml",
                camera=lens_file,
                labels="rgb,depth,mask",
                layout="webdataset",
                seed=number,
                workers=0,
                progress=lambda _, done, total: self.progress(f"render {recipe.name}", done, total),
            )
        _keep(_read(data / DATASET)["command"], self.work / "recipes" / f"{name}.command.json")
        return data

    def _lenses(self, twin: Twin, recipe: Recipe) -> list[tuple[Camera, np.ndarray, float]]:
        """The twin's own lens, and where the recipe says so those of the tests, each once: the camera, which
        pixels are not black around its circle, and the share of frames that are seen through it."""
        width = SUPERSAMPLING * self.size[0]
        found = {}
        for sequence in (twin.sequence(), *(self.tests if recipe.lenses else ())):
            camera = sequence.camera.scaled(min(1.0, width / sequence.camera.width))
            key = json.dumps(camera.to_dict())
            if key not in found:
                found[key] = camera, lit_pixels(sequence, self.size)
        others = len(found) - 1
        shares = [1 - OTHER_LENSES, *others * [OTHER_LENSES / others]] if others else [1.0]
        return [(*lens, share) for lens, share in zip(found.values(), shares, strict=True)]

    # Training and judging

    def _train_all(self) -> None:
        """Train and judge each arm with each seed that has no result yet; small networks on a CPU one a core,
        for two on a core each see 1.2 times as many photos as one on both."""
        jobs = [(arm, seed) for arm in self.arms for seed in range(self.plan.seeds)]
        jobs = [job for job in jobs if not self._result(*job).exists()]
        for arm, _ in jobs:
            self._pools_of(arm)  # rendered before any training, on all cores

        def work(job: tuple[Arm, int], count: Callable[[int], None]) -> None:
            started = time.monotonic()
            scores = self._judged(self._trained(*job, count))
            _keep({"scores": scores, "seconds": time.monotonic() - started}, self._result(*job))

        small = self.network == "small" and self.device.type == "cpu"
        total = len(jobs) * self.steps
        together(work, jobs, THREADS if small else 1, lambda done: self.progress("train", done, total))

    def _result(self, arm: Arm, seed: int) -> Path:
        return self.work / "results" / f"{arm.name}.{seed}.json"

    def _judged(self, trained: torch.nn.Module) -> list[dict]:
        """Scores of each test."""
        return [judge.judged(trained, test, self.device) for test in self._tested]

    def _trained(self, arm: Arm, seed: int, progress: Callable[[int], None]) -> torch.nn.Module:
        course = Course(self.steps, self.batch, self.rate, self.plan.loss, seed)
        checkpoint = self.work / "networks" / f"{arm.name}.{seed}.pt"
        first = network(self.network, seed)
        pools = [] if finished(checkpoint, course) else self._pools_of(arm)
        return train(first, pools, course, checkpoint, progress, self.device)

    def _pools_of(self, arm: Arm) -> list[Frames]:
        """What an arm is trained on."""
        pools = [self._pool("real")] if arm.real else []
        if arm.recipe:
            rendered = self._pool(arm.recipe.name)
            pools.append(rendered.some(arm.frames) if arm.frames else rendered)
        return pools

    def _zero_shot(self) -> None:
        """Judge the network as its authors published it."""
        result = self.work / "results" / "zero-shot.0.json"
        if not result.exists():
            plain = network(self.network, 0, adapted=False).to(self.device).eval()
            _keep({"scores": self._judged(plain), "seconds": 0.0}, result)

    def _robustness(self) -> None:
        """Judge the first seed of each headline arm after each corruption."""
        width, height = self.size
        large = (judge.CORRUPTED_WIDTH, round(height * judge.CORRUPTED_WIDTH / width))
        networks = {arm.name: self._trained(arm, 0, lambda _: None) for arm in HEADLINE}
        for number, test in enumerate(self.tests):
            result = self.work / "results" / f"robustness.{number}.json"
            self.progress("corruptions", number, len(self.tests))
            if not result.exists():
                frames = self._sequences(f"large-{number}", [test], large)
                _keep(judge.judged_corrupted(networks, frames, self.size, self.device), result)

    def _facts(self) -> dict:
        """What the page says beside the numbers."""
        width, height = self.size
        return {
            "network": self.network,
            "parameters": self.parameters,
            "size": f"{width}×{height}",
            "steps": self.steps,
            "batch": self.batch,
            "loss": self.plan.loss,
            "seeds": self.plan.seeds,
            "frames": {"real": sum(map(len, self.real)), "rendered": self.plan.frames},
            "real": [sequence.path.name for sequence in self.real],
            "twins": [folder.name for folder in self.twins],
            "tests": _names(self.tests),
            "test_frames": [len(sequence) for sequence in self.tests],
            "trajectory": TRAJECTORY,
            "unseen": self.unseen,
            "machine": machine(),
        }


def _names(sequences: list[Sequence]) -> list[str]:
    """What the sequences are called: their folders' names, or the whole paths where two are the same."""
    names = [sequence.path.name for sequence in sequences]
    return names if len(set(names)) == len(names) else [str(sequence.path) for sequence in sequences]


def _fitted(folder: Path) -> Twin:
    twin = Twin.load(Path(folder))
    if not twin.fitted:
        raise TwinError(f"{folder} has no materials yet; run 'endotwin fit {folder}' first")
    return twin


def _read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def _keep(content: dict, path: Path) -> None:
    """Write JSON whole or not at all."""
    with whole_file(path, overwrite=True) as file:
        file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
