"""How well a twin, or another method, predicts the photos that its fit never saw.

The held-out frames, or all of another recording of the same surface, are rendered at their own poses and
compared with their photos, both display-encoded in [0, 1]. Three kinds of pixels:

- *valid*: inside the lens circle and with a measured depth. Where the twin shows no surface it is black, and
  that counts.
- *covered*: valid, and the vertices of the triangle that the pixel's ray hits were each seen by a training
  photo. The rest of a held-out frame shows what no training photo showed. The definition is by surface: where
  the mesh is wrong, so that a ray ends on another part of the colon that was seen, the error counts.
- all others are ignored.

Where the camera changes its gain, that of a held-out frame is one number that no other photo tells. It is
read from the frame's own photo, as the median of photo over twin, and kept with the scores.

Where poses err from photo to photo, each half of a photo can be scored at a pose that was fitted to its other
half: a score under another name, which says what the twin is worth, and not what sequence and twin are.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from endotwin.align.photos import photo_of, well_inside
from endotwin.align.scene import Scene
from endotwin.align.single import placed
from endotwin.errors import OptionError, TwinError
from endotwin.evaluation import metrics
from endotwin.evaluation.highlights import Alike
from endotwin.evaluation.kept import keep_scores
from endotwin.evaluation.renders import read_render, rendered_files
from endotwin.evaluation.sheet import sheet_row
from endotwin.light import shading
from endotwin.render import Renderer
from endotwin.run.arguments import as_path, check_progress
from endotwin.run.output import check_picture
from endotwin.sequence import Frame, Sequence
from endotwin.sequence.images import write_png
from endotwin.sequence.readers import open_sequence
from endotwin.sequence.readers.transforms import MARK
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences
from endotwin.twin import Light, Source, Twin, as_twin

logger = logging.getLogger("endotwin")

Progress = Callable[[str, int, int], None]

MID_TONES = (0.1, 0.9)
"""Display values that are neither noise nor clipped."""

POOR_DB = 20.0
"""A twin with a lower PSNR does not look like its photos."""

HALVES = ("psnr_halves", "psnr_halves_covered")

MEANS = (
    *("psnr", "ssim", "lpips", "psnr_covered", "covered", "psnr_dull", "precision", "recall", "sizes"),
    *HALVES,
)
"""Scores of which a twin keeps the mean."""


@dataclass(frozen=True)
class FrameScore:
    """Scores of one held-out frame; NaN where there is nothing to measure.

    Attributes:
        index, name: which frame.
        gain: factor on the twin's radiance that its photo shows; 1 where the camera keeps its gain.
        psnr, ssim, lpips: over its valid pixels.
        psnr_covered, ssim_covered, lpips_covered: over its covered pixels.
        covered: fraction of the valid pixels that are covered; NaN where no twin tells.
        psnr_dull: over its valid pixels with no highlight near them.
        precision, recall, sizes: how alike the highlights are, see ``Alike``.
        psnr_halves, psnr_halves_covered: of each half of the photo at a pose that was fitted to the other
            half; NaN where that was not asked for.
    """

    index: int
    name: str
    gain: float
    psnr: float
    ssim: float
    lpips: float
    psnr_covered: float
    ssim_covered: float
    lpips_covered: float
    covered: float
    psnr_dull: float
    precision: float
    recall: float
    sizes: float
    psnr_halves: float = math.nan
    psnr_halves_covered: float = math.nan


@dataclass(frozen=True)
class Evaluation:
    """Scores of a twin on its held-out frames; a mean score is the mean of the frames' scores.

    Attributes:
        frames: one score a held-out frame. scored: the twin that they are of; None: another method's renders.
        lpips_network: what LPIPS is of.
    """

    frames: tuple[FrameScore, ...]
    scored: Twin | None = None
    lpips_network: str = metrics.LPIPS_NETWORKS[0]

    @property
    def twin(self) -> Twin | None:
        """The twin with these scores in its record."""
        return self.scored and self.scored.with_record(eval=self.to_dict())

    @property
    def gamma(self) -> float | None:
        """What the fit found of the response."""
        return self.scored and self.scored.response.gamma

    @property
    def light(self) -> Light | None:
        """What the fit found of the light."""
        return self.scored and self.scored.light

    def mean(self, score: str) -> float:
        """Mean of a score, such as ``psnr_covered``, over the frames that have it; NaN where none has."""
        values = [value for frame in self.frames if math.isfinite(value := getattr(frame, score))]
        return float(np.mean(values)) if values else math.nan

    @property
    def psnr(self) -> float:
        """Mean PSNR in dB over valid pixels."""
        return self.mean("psnr")

    @property
    def ssim(self) -> float:
        """Mean SSIM over valid pixels."""
        return self.mean("ssim")

    @property
    def lpips(self) -> float:
        """Mean LPIPS over valid pixels; NaN where the extra is not installed."""
        return self.mean("lpips")

    @property
    def psnr_covered(self) -> float:
        """Mean PSNR in dB over covered pixels."""
        return self.mean("psnr_covered")

    @property
    def covered(self) -> float:
        """Mean fraction of valid pixels that some training photo saw."""
        return self.mean("covered")

    def to_dict(self) -> dict:
        """The scores as plain values; what could not be measured is None."""

        def plain(value):
            return None if isinstance(value, float) and not math.isfinite(value) else value

        return {
            **{name: plain(self.mean(name)) for name in MEANS},
            "lpips_network": self.lpips_network,
            "gamma": self.gamma,
            "light": self.light and asdict(self.light),
            "frames": [
                {name: plain(value) for name, value in asdict(frame).items()} for frame in self.frames
            ],
        }

    def __str__(self) -> str:
        told = {"index", "name"} | ({"gain"} if all(frame.gain == 1 for frame in self.frames) else set())
        if all(math.isnan(self.mean(name)) for name in HALVES):
            told |= set(HALVES)
        scores = [field.name for field in fields(FrameScore) if field.name not in told]
        rows = [["frame", *scores]]
        for frame in self.frames:
            rows.append([frame.name, *(self._shown(name, getattr(frame, name)) for name in scores)])
        rows.append(["mean", *(self._shown(name, self.mean(name)) for name in scores)])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.rjust, row, widths)) for row in rows]
        if self.light is None:
            return "\n".join(lines)
        light = f"L0 {self.light.L0:.4g}, n {self.light.n:.3f}, q {self.light.q:.3f}"
        lines.append(f"{light}; γ {self.gamma:.4f}; geometry {self.scored.source.geometry}")
        return "\n".join(lines)

    def _shown(self, score: str, value: float) -> str:
        if score.startswith("lpips") and not metrics.lpips_installed(self.lpips_network):
            return "not installed"
        if not math.isfinite(value):
            return "-"
        return f"{value:.2f}" if score.startswith("psnr") else f"{value:.4f}"


def covered_pixels(hits: Correspondences, surface: Surface, shape: tuple[int, int]) -> np.ndarray:
    """Bool [H, W]: pixels whose hit triangle has only vertices that a training photo saw."""
    covered = np.zeros(shape[0] * shape[1], bool)
    covered[hits.pixel] = surface.seen()[hits.triangle]
    return covered.reshape(shape)


def gain_of(photo: np.ndarray, radiance: np.ndarray, gamma: float) -> float:
    """Factor on ``radiance`` [..., 3] that makes it look like ``photo`` (x^γ, of its shape).

    The median of their ratio over mid-tones, which highlights and shadows' edges do not move; 1 where there
    are none.
    """
    tells = (photo > MID_TONES[0]) & (photo < MID_TONES[1]) & (radiance > 0)
    ratio = shading.radiance_of(photo[tells], gamma) / radiance[tells]
    return float(np.median(ratio)) if ratio.size else 1.0


@dataclass(frozen=True)
class _HeldOut:
    """A held-out frame beside its rendering.

    Attributes:
        photo, render: float32 [H, W, 3], display-encoded, in [0, 1]. gain: factor on the radiance that was
            rendered. valid, covered: bool [H, W]; the latter None where no twin tells.
    """

    frame: Frame
    photo: np.ndarray
    render: np.ndarray
    gain: float
    valid: np.ndarray
    covered: np.ndarray | None


Show = Callable[[Frame, np.ndarray, np.ndarray], tuple[np.ndarray, float, np.ndarray | None]]
"""From a frame, its photo in [0, 1] and its valid pixels: the rendering, its gain, and the covered pixels."""


def _compared(
    sequence: Sequence, indices: list[int], show: Show, progress: Progress | None
) -> Iterator[_HeldOut]:
    """Each frame with a valid pixel beside what ``show`` makes of it; others are skipped with a warning."""
    for done, index in enumerate(indices):
        if progress:
            progress("held-out frames", done, len(indices))
        frame = sequence.frame(index)
        valid = sequence.lens_mask & np.isfinite(frame.depth_mm)
        if not valid.any():
            logger.warning("Held-out frame %s has no valid pixel and is not scored.", frame.name)
            continue
        photo = frame.color.astype(np.float32) / 255
        render, gain, covered = show(frame, photo, valid)
        yield _HeldOut(frame, photo, render, gain, valid, covered)
    if progress:
        progress("held-out frames", len(indices), len(indices))


def _shown_by_twin(twin: Twin, sequence: Sequence) -> Show:
    twin = replace(twin, effects=twin.effects.without(["sparkle"]))
    renderer = Renderer(twin, sequence.camera)

    def show(frame: Frame, photo: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        view, gain = renderer.view(frame.T_world_camera, sequence.lens_mask), 1.0
        if "gain" in twin.effects:
            gain = gain_of(twin.untoned(photo[valid]), view.radiance[valid], twin.response.gamma)
            view = renderer.view(frame.T_world_camera, sequence.lens_mask, gain)
        color = view.color
        if "bloom" in twin.effects:
            radiance = torch.from_numpy(view.radiance)
            glared = twin.effects["bloom"].through(radiance, view.depth_mm, sequence.camera)
            color = twin.displayed(glared).clamp(0, 1).numpy()
        return color, gain, valid & covered_pixels(view.hits, twin.surface, valid.shape)

    return show


def _shown_by_files(files: Mapping[int, Path], sequence: Sequence, twin: Twin | None) -> Show:
    """Pictures of another method; what is covered is known where there is a twin."""
    caster = Caster(twin.surface) if twin else None

    def show(
        frame: Frame, photo: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, float, np.ndarray | None]:
        render = read_render(files[frame.index], valid.shape)
        if caster is None:
            return render, 1.0, None
        hits = caster.cast(sequence.camera, frame.T_world_camera, valid)
        return render, 1.0, covered_pixels(hits, caster.surface, valid.shape)

    return show


def _halved(held_out: _HeldOut, sequence: Sequence, scene: Scene, show: Show) -> dict[str, float]:
    """PSNR of each half of the photo at a pose that was fitted to the other."""
    frame, photo, valid = held_out.frame, held_out.photo, held_out.valid
    seen = photo_of(frame.color, well_inside(sequence.lens_mask))

    def at(T_world_camera: np.ndarray):
        return show(replace(frame, T_world_camera=T_world_camera), photo, valid)

    left = np.zeros_like(valid)
    left[:, : valid.shape[1] // 2] = True
    render, covered = np.zeros_like(photo), np.zeros_like(valid)
    for scored in (left, ~left):
        T_world_camera = placed(scene, seen, frame.T_world_camera, valid & ~scored, lambda T: at(T)[0])
        shown, _, known = at(T_world_camera)
        render[scored], covered[scored] = shown[scored], known[scored]
    whole, of_covered = (metrics.psnr(photo, render, mask) for mask in (valid, covered))
    return dict(zip(HALVES, (whole, of_covered), strict=True))


def _score(held_out: _HeldOut, lpips: str) -> FrameScore:
    photo, render, valid = held_out.photo, held_out.render, held_out.valid
    covered = np.zeros_like(valid) if held_out.covered is None else held_out.covered
    similarity = metrics.ssim_map(photo, render, valid)
    distance = np.full(valid.shape, np.nan)
    if metrics.lpips_installed(lpips):
        distance = metrics.lpips_map(photo, render, valid, lpips)
    glints = Alike.of(photo, render, valid)
    return FrameScore(
        index=held_out.frame.index,
        name=held_out.frame.name,
        gain=held_out.gain,
        psnr=metrics.psnr(photo, render, valid),
        ssim=metrics.masked_mean(similarity, valid),
        lpips=metrics.masked_mean(distance, valid),
        psnr_covered=metrics.psnr(photo, render, covered),
        ssim_covered=metrics.masked_mean(similarity, covered),
        lpips_covered=metrics.masked_mean(distance, covered),
        covered=math.nan if held_out.covered is None else float(covered.sum() / valid.sum()),
        psnr_dull=metrics.psnr(photo, render, glints.dull),
        precision=glints.precision,
        recall=glints.recall,
        sizes=glints.sizes,
    )


def evaluate(
    twin: Twin | Path | str | None = None,
    sheet: Path | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
    sequence: Sequence | Path | str | None = None,
    renders: Path | str | None = None,
    halves: bool = False,
    lpips: str | None = None,
) -> Evaluation:
    """Score a fitted twin, or another method's pictures, on frames that were held out of the fit.

    Args:
        twin: or its folder, in which the scores on its own sequence then are kept. With ``renders`` it may be
            unfitted, and tells what is covered; or None.
        sheet: PNG file to write a contact sheet to, one row photo | render | error a frame.
        progress: called with (label, done, total).
        overwrite: whether ``sheet`` may exist.
        sequence: another recording of the twin's surface, in the same world frame, all of which is scored.
            With ``renders`` alone, the sequence whose held-out frames they show.
        renders: folder of pictures of the held-out frames, each named as its photo.
        halves: also fit the pose of each photo to one half of it and score the other, and the reverse: what
            the twin is worth where poses err from photo to photo.
        lpips: the network that LPIPS is of, ``alex`` or ``vgg``; unless given ``alex``, if it is installed.

    Raises:
        TwinError: the twin is not fitted, or no held-out frame has a valid pixel.
        SequenceError: the twin's sequence has moved, or a render is missing or of another size.
        OptionError: ``sequence`` is the twin's own, renders have none, their poses are asked for, or
            ``lpips`` is no network of LPIPS, or is not installed.
        OutputError: ``sheet`` exists or cannot be written.
    """
    renders = None if renders is None else as_path("folder of renders", renders)
    kept = sequence is None and renders is None and not isinstance(twin, Twin)
    folder = twin if kept else None
    twin = None if twin is None and renders is not None else as_twin(twin)
    if halves and renders is not None:
        raise OptionError("pictures of another method have no pose to fit; leave --halves or --renders out")
    lpips = _network(lpips)
    check_progress(progress)
    if sheet is not None:
        check_picture(sheet, overwrite)
    sequence, indices = _to_be_scored(twin, sequence)
    if renders is None:
        show = _shown_by_twin(twin, sequence)
    else:
        show = _shown_by_files(rendered_files(renders, sequence, indices), sequence, twin)
    scene = Scene.of(Caster(twin.surface), sequence.camera, 0) if halves else None
    scores, rows = [], []
    for held_out in _compared(sequence, indices, show, progress):
        scores.append(_score(held_out, lpips))
        if scene is not None:
            scores[-1] = replace(scores[-1], **_halved(held_out, sequence, scene, show))
        if sheet is not None:
            score, name = scores[-1], held_out.frame.name
            pictures = held_out.photo, held_out.render, held_out.valid
            rows.append(sheet_row(name, *pictures, score.psnr, score.recall))
    if not scores:
        raise TwinError(
            f"{sequence.path} has no held-out frame to score; fuse a sequence of two or more frames"
        )
    if sheet is not None:
        write_png(Path(sheet), np.vstack(rows), overwrite)
    evaluation = Evaluation(tuple(scores), twin if renders is None else None, lpips)
    if renders is not None:
        return evaluation
    if evaluation.psnr < POOR_DB:
        logger.warning(
            "the twin does not look like its photos (%.1f dB); 'endotwin check %s' looks for the cause",
            *(evaluation.psnr, sequence.path),
        )
    if folder is not None:
        keep_scores(evaluation.to_dict(), twin, Path(folder))
    return evaluation


def _network(lpips: str | None) -> str:
    """The network that LPIPS is of; one that is asked for has to be there."""
    if lpips is None:
        return metrics.LPIPS_NETWORKS[0]
    if lpips not in metrics.LPIPS_NETWORKS:
        raise OptionError(
            f"lpips {lpips!r} is no network of LPIPS; choose from {', '.join(metrics.LPIPS_NETWORKS)}"
        )
    if not metrics.lpips_installed(lpips):
        raise OptionError(f"LPIPS of {lpips} cannot be computed: run pip install 'endotwin[lpips]'")
    return lpips


def _to_be_scored(twin: Twin | None, sequence: Sequence | Path | str | None) -> tuple[Sequence, list[int]]:
    """The sequence and the indices of its frames that are scored."""
    if sequence is None:
        if twin is None:
            raise OptionError(
                "the renders have no photos to be compared with; give their sequence, or a twin"
            )
        sequence = twin.sequence()
        return sequence, twin.source.heldout(len(sequence))
    if not isinstance(sequence, Sequence):
        sequence = open_sequence(sequence)
    if twin is None:
        source = Source(str(sequence.path), sequence.format, sequence.scale, split=sequence.split)
        return sequence, source.heldout(len(sequence))
    if _folder(sequence.path) == _folder(Path(twin.source.path)):
        raise OptionError(
            f"{sequence.path} is the twin's own sequence; leave --sequence out, or name another"
        )
    return sequence, list(range(len(sequence)))


def _folder(path: Path) -> Path:
    """What a sequence is in, whether that or the ``transforms.json`` there was named."""
    path = path.resolve()
    return path.parent if path.name == MARK else path
