"""Gauss–Newton over hash features, light and response, coarse to fine.

Vertex parameters are a linear read-out of multiresolution hash features, θ = θ̄ + A·table. A Gaussian prior
on the table whose width shrinks with the cell edge says that tissue varies more over millimetres than over
tenths of one; it fills in what no photo shows. Each step solves (Aᵀ·JᵀWJ·A + P)·δ = Aᵀ·JᵀWe − P·table by
preconditioned conjugate gradients, with the five shared parameters eliminated exactly (Schur complement),
then searches along δ.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from endotwin.fit.following import Following
from endotwin.fit.frame_gains import FramePattern
from endotwin.fit.hashgrid import HashOperator
from endotwin.fit.linear import conjugate_gradients, joint_minimum, squared
from endotwin.fit.mesh_pattern import MeshPattern
from endotwin.fit.model import F0, GAMMA, at_pixels, columns_of, free_directions, predict
from endotwin.fit.normal_equations import CHANNELS, NormalEquations, assemble, robust_cost
from endotwin.fit.prior import global_prior, prior_precision
from endotwin.fit.state import State, at_furnace, bounded, without_furnace
from endotwin.light.bounced import WITH_ALL
from endotwin.pixels.samples import Samples, drawn
from endotwin.robust import robust_std

CPU = torch.device("cpu")

NOISE_MIN = 1 / 255
"""Least noise assumed, in display values: 8-bit rounding and a step of sensor noise."""

TEMPER = 4.0
"""Model errors of neighbouring pixels agree: so many pixels count as one independent observation."""

HUBER = 1.0
"""Residuals beyond so many noise widths count linearly: rims, highlights, what the model does not know."""

SEARCH_SAMPLES = 300_000
"""Samples by which the lengths of a step are judged."""

STANDARD_SPREAD = 0.05
"""Standard deviation among cameras of γ about that of displays: the curves of sRGB, BT.709 and BT.1886 are
nearly powers of 0.45, 0.51 and 0.42. Where light bounces few levels tell γ from it, and what the model lacks
bends γ instead: one that far off must explain what a model ``errs_by``, too."""

FIRST_ERROR = 1 / 255
"""Of display values, root mean square and alike in many pixels: what a model errs by before it is fitted."""

BLOCKS, OUTLYING, PASSING = 16, 3.0, 0.3
"""Blocks across a photo, in each of which a model errs alike; residuals so many standard deviations off are
highlights', and count as that much; the share of the error, of its square, that passes for another γ."""

MOST_BRIGHTER = 1.5
"""Of the logarithm of bounced light, by a step of the albedo: it grows faster than that."""

MOST_GAIN_STEP = 1.0
"""Of the logarithm of a gain: a photo all black or white tells none, and its slope is next to nothing."""

BORDER_TOLERANCE = 1e-3
"""To which the materials that follow each shared parameter are found: what they lack, the parameter makes up
for, and the pixels tell little of γ and f0 beside them. They change little from step to step."""

_NO_GAINS = np.zeros(0)
LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03)
"""Of the line search, as shares of the full step."""


class Step(NamedTuple):
    """What a step has found: ``state``, by how much its cost ``fell`` (0: no step), and what it adds to ln of
    each frame's gain, float64 [F], or [0] where gains were none of its business."""

    state: State
    fell: float
    log_gain: np.ndarray


class GaussNewton:
    """Steps on one set of samples with one operator.

    Sums over samples, products and conjugate gradients run on ``device``. What it is given and gives back
    lies on the CPU.

    Attributes:
        held: which shared parameters stay in joint steps.
        errs_by: the model, where light bounces, in a way that passes for another γ: display values, root mean
            square, alike in many pixels.
        spread: standard deviations of the shared parameters beside all else, float64 [G], as the last joint
            step knew them.
        solve_s: seconds of the last step, of what does not take longer with more samples.
    """

    def __init__(
        self,
        samples: Samples,
        triangles: np.ndarray,
        operator: HashOperator,
        unit_mm: float = 1.0,
        seed: int = 0,
        out_of_time: Callable[[], bool] = lambda: False,
        device: torch.device = CPU,
    ):
        self._device = device
        vertex_count = operator.forward_csr.shape[0]
        self.triangles = torch.from_numpy(triangles.astype(np.int64))
        self.pattern = MeshPattern(samples, triangles, vertex_count)
        self._operator, self._told = operator.to(device), torch.from_numpy(self.pattern.vertices).to(device)
        self._at_told = operator.of_points(self.pattern.vertices).to(device)
        self._triangles = self.triangles.to(device)
        self.precision = prior_precision(operator, unit_mm).to(device)
        self._unit_mm = unit_mm
        self.held: tuple[str, ...] = ()
        self.errs_by = FIRST_ERROR
        self.spread = np.zeros(0)
        self.solve_s = 0.0
        self._border: Tensor | None = None
        self._out_of_time = out_of_time
        chosen = drawn(len(samples), SEARCH_SAMPLES, np.random.default_rng(seed))
        self.trial_rows = torch.from_numpy(chosen) if len(chosen) < len(samples) else slice(None)
        self.relight(samples)
        self.squared_adjoint = squared(self._at_told.adjoint_csr)

    def relight(self, samples: Samples) -> None:
        """Go on with the same samples under other light or exposure."""
        self.samples = samples
        self._trial, self._placed = samples[self.trial_rows].to(self._device), None
        self._known: tuple[State, Tensor] | None = None

    def _global_prior(self, state: State) -> tuple[Tensor, Tensor]:
        return global_prior(self._unit_mm, state.shared)

    def _here(self, state: State) -> State:
        """``state`` on the device, where it is a table of this operator."""
        if self._device.type == "cpu":
            return state
        table = None if state.table is None else state.table.to(self._device)
        operator = None if state.operator is None else self._operator
        return replace(state, operator=operator, mean=state.mean.to(self._device), table=table)

    def noise(self, state: State) -> float:
        """Robust standard deviation of the residual, in display values."""
        return self._noise(self._here(state))

    def _noise(self, state: State) -> float:
        error = self._trial.color.float() / 255 - self._predict(state)
        return robust_std(error.cpu().numpy(), NOISE_MIN)

    def tried(self, state: State) -> tuple[Samples, Tensor]:
        """The trial samples, and what is shown of them, display values [N, 3]."""
        return self._trial, self._predict(self._here(state))

    def cost(self, state: State, noise: float) -> float:
        """Negative log posterior, on the trial samples scaled up to all of them."""
        return self._cost(self._here(state), noise)

    def _cost(self, state: State, noise: float, log_gain: np.ndarray = _NO_GAINS) -> float:
        share, scale = len(self.samples) / max(1, len(self._trial)), 1 / (noise**2 * TEMPER)
        predicted = self._predict(state, log_gain)
        data = robust_cost(self._trial, predicted, HUBER * noise) * share * scale
        prior = float((self.precision * state.table**2).double().sum()) / 2
        mean, precision = self._prior(state, scale)
        return data + prior + float((precision * (state.shared.vector - mean) ** 2).sum()) / 2

    def _prior(self, state: State, scale: float) -> tuple[Tensor, Tensor]:
        """Mean and inverse variance of the shared parameters beside pixels that count ``scale`` each, [G]."""
        mean, spread = self._global_prior(state)
        precision = 1 / spread**2
        if state.shared.bounces:
            precision[GAMMA] += len(self.samples) * scale * (self.errs_by / STANDARD_SPREAD) ** 2
        return mean, precision

    def learn_error(self, state: State) -> None:
        """Take what the model errs by, if that is less than was known, from a ``state`` nearer the photos.

        It is off alike in BLOCKS of a photo: of two halves of a block the noise differs, and what their means
        share is the model's.
        """
        trial, views = self._trial, self.samples.views
        left = (trial.color.float() / 255 - self._predict(self._here(state))).mean(dim=1).cpu().numpy()
        width = OUTLYING * self.noise(state)
        left = left.clip(-width, width)
        camera, edge = views.camera, math.ceil(views.camera.width / BLOCKS)
        row, column = np.divmod(trial.pixel.cpu().numpy(), camera.width)
        shape = (len(views.frames), camera.height // edge + 1, camera.width // edge + 1)
        block = np.ravel_multi_index((views.row(trial.frame.cpu()), row // edge, column // edge), shape)
        halves, blocks = [slice(start, None, 2) for start in (0, 1)], math.prod(shape)
        count = np.stack([np.bincount(block[half], minlength=blocks) for half in halves])
        total = np.stack([np.bincount(block[half], left[half], blocks) for half in halves])
        whole = count.all(axis=0)
        if not whole.any():
            return
        alike = float(np.mean(np.prod(total[:, whole] / count[:, whole], axis=0)))
        self.errs_by = min(self.errs_by, math.sqrt(PASSING * max(0.0, alike)))

    def step(self, state: State, joint: bool = True, gains: bool = False) -> Step:
        """One Gauss–Newton step with a backtracking line search.

        Light, response and f0 move only in a ``joint`` step, which costs six times as much: interreflection
        needs it, whose light depends on the albedo (see ``within`` for the others). With ``gains`` each
        frame's moves with them.
        """
        given, state = state, self._here(state)
        noise = self._noise(state)
        equations = self._assembled(state, noise, joint, gains)
        table_step, shared_step, rise = self._direction(state, equations, 1 / (noise**2 * TEMPER), joint)
        trusted, gain_step = self._trusted(state, shared_step, rise), np.zeros(0)
        if gains:
            columns = columns_of(state.shared, joint) @ shared_step.numpy()
            if len(rise):
                columns[-3:] += WITH_ALL * (rise - columns[-3:])
            gain_step = equations.gains.step(
                state.link_slope[self._told] * self._at_told(table_step), columns
            )
            trusted = min(trusted, MOST_GAIN_STEP / max(float(np.abs(gain_step).max()), 1e-12))
        before = self._cost(state, noise)
        for length in (min(1.0, trusted) * each for each in LENGTHS):
            moved = replace(
                state,
                table=state.table + length * table_step,
                shared=bounded(state.shared, state.shared.vector + length * shared_step),
            )
            moved = without_furnace(moved) if joint and self._follows else moved
            after = self._cost(moved, noise, length * gain_step)
            if after < before:
                found = replace(given, table=moved.table.cpu(), shared=moved.shared)
                return Step(found, before - after, length * gain_step)
        return Step(given, 0.0, 0 * gain_step)

    def _assembled(self, state: State, noise: float, joint: bool, gains: bool) -> NormalEquations:
        if self._placed is None:
            self._placed = self.samples.to(self._device)
        return assemble(
            self._placed,
            self.pattern,
            self._triangles,
            state.materials,
            state.lighting,
            HUBER * noise,
            joint,
            self._frames if gains else None,
        )

    def _direction(
        self, state: State, equations: NormalEquations, scale: float, joint: bool
    ) -> tuple[Tensor, Tensor, np.ndarray]:
        """Steps of the table and of what is shared, and the ``_rise`` of albedo by them. Where tissue would
        be a furnace, the albedo's scale makes up for what its colours gain."""
        free = free_directions(state.shared, self.held) if joint else np.zeros((len(state.shared.vector), 0))
        began = time.perf_counter()
        table_step, shared_step = self._solve(state, equations, scale, free)
        self.solve_s = time.perf_counter() - began
        rise = self._rise(state, table_step, shared_step)
        kept = at_furnace(state, rise) if joint else None
        if kept is not None:
            free = free_directions(state.shared, (*self.held, "albedo scale"))
            table_step, shared_step = self._solve(state, equations, scale, free, kept)
            rise = self._rise(state, table_step, shared_step)
            shared_step[-1] -= rise[kept]
            rise = rise - rise[kept]
        return table_step, shared_step, rise

    def _rise(self, state: State, table_step: Tensor, shared_step: Tensor) -> np.ndarray:
        """What a step adds to ln of the mean albedo of each channel, [3]; [0] where light follows none."""
        if not self._follows:
            return np.zeros(0)
        raw_step = self._at_told(table_step)[:, :3]
        whiter = (self._whiteness(state) * raw_step).sum(dim=0).cpu().numpy()
        return whiter + float(shared_step[-1])

    def _trusted(self, state: State, shared_step: Tensor, rise: np.ndarray) -> float:
        """The share of a step, with the ``rise`` of albedo, for which the equations hold."""
        moved, most = shared_step.clone(), math.inf
        if len(rise):
            moved[F0] += moved[-1]
            moved[-1] = 0
            brighter = self._trial.bounce.by_scale.mean(dim=0).cpu().numpy() * rise
            most = MOST_BRIGHTER / max(float(np.abs(brighter).max()), 1e-12)
        return min(most, float((self._global_prior(state)[1] / moved.abs().clamp_min(1e-12)).min()))

    @cached_property
    def _frames(self) -> FramePattern:
        samples, pattern = self.samples, self.pattern
        row, count = samples.views.row(samples.frame), len(samples.views.frames)
        return FramePattern(pattern.corners[pattern.compact], row, len(pattern.vertices), count)

    def _brightened(self, log_gain: np.ndarray) -> Samples:
        """The trial samples with frames brighter by ``log_gain`` [F]."""
        by_sample = torch.from_numpy(log_gain[self._frames.row])[self.trial_rows].float()
        return replace(self._trial, log_exposure=self._trial.log_exposure + by_sample.to(self._device))

    def _predict(self, state: State, log_gain: np.ndarray = _NO_GAINS) -> Tensor:
        """Display values of the trial samples, [N, 3], frames brighter by ``log_gain`` [F], or as they are by
        [0]: those are kept for what is asked of the same state next."""
        if len(log_gain):
            return self._displayed(self._brightened(log_gain), state)
        if self._known is None or self._known[0] is not state:
            self._known = state, self._displayed(self._trial, state)
        return self._known[1]

    def _displayed(self, samples: Samples, state: State) -> Tensor:
        return predict(samples, at_pixels(samples, self._triangles, state.materials), state.lighting)

    def _solve(
        self,
        state: State,
        equations: NormalEquations,
        scale: float,
        free: np.ndarray,
        kept: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Steps of the table, and of what is shared along ``free`` [G, K], beside a scale of the albedo by
        which that of the channel ``kept`` stays on the whole what it is; None: by which it is as found."""
        link, adjoint = state.link_slope[self._told][..., None], self._at_told.adjoint_csr
        shape, joint = (len(state.table), CHANNELS, -1), free.shape[1] > 0
        sums = (equations.right * link * scale).reshape(len(link), -1)
        sums = (adjoint @ sums).reshape(shape)
        following = self._following(state, equations, scale, sums, kept)

        def product(x: Tensor) -> Tensor:
            rows, _, columns = x.shape
            vertex = (self._at_told.forward_csr @ x.reshape(rows, -1)).reshape(-1, CHANNELS, columns)
            vertex = link * (equations @ (link * vertex)) * scale
            back = adjoint @ vertex.reshape(len(vertex), -1)
            found = back.reshape(rows, CHANNELS, columns) + self.precision[..., None] * x
            return found if following is None else found + following.product(x)

        columns = columns_of(state.shared, joint) @ free
        right = torch.cat([sums[..., :1], sums[..., 1:] @ self._placed_matrix(columns)], dim=2)
        if following is not None:
            pulls = np.c_[equations.shared_right, equations.shared @ columns][-3:]
            right += following.right(self._placed_matrix(scale * pulls))
        right[..., 0] -= self.precision * state.table
        block = equations.lumped() * (link * link.transpose(1, 2)) * scale
        block = (self.squared_adjoint @ block.reshape(len(link), -1)).reshape(-1, CHANNELS, CHANNELS)
        inverse = torch.linalg.inv(block + torch.diag_embed(self.precision))
        solved, image = conjugate_gradients(product, right[..., :1], inverse, self._out_of_time)
        if not joint:
            return solved[..., 0], torch.zeros_like(state.shared.vector)
        known = self._border if self._border is not None and self._border.shape[2] == free.shape[1] else None
        bordering = product, right[..., 1:], inverse, self._out_of_time, known, BORDER_TOLERANCE
        self._border, border_image = conjugate_gradients(*bordering)
        solved, image = torch.cat([solved, self._border], dim=2), torch.cat([image, border_image], dim=2)
        mean, precision = self._prior(state, scale)
        pull = (precision * (mean - state.shared.vector)).numpy()
        shared_normal = columns.T @ equations.shared @ columns * scale + free.T @ np.diag(precision) @ free
        shared_right = columns.T @ equations.shared_right * scale + free.T @ pull
        weights, along, covariance = joint_minimum(solved, image, right, shared_normal, shared_right)
        self.spread = np.sqrt(np.einsum("gk,kl,gl->g", free, covariance, free).clip(0))
        return solved @ self._placed_matrix(weights), torch.from_numpy(free @ along)

    def _following(
        self, state: State, equations: NormalEquations, scale: float, sums: Tensor, kept: int | None
    ) -> Following | None:
        """How bounced light follows the mean colour of the tissue, from the ``sums`` at the table; None where
        it follows none."""
        if not self._follows:
            return None
        along = self._at_told.adjoint_csr @ self._whiteness(state)
        inner = self._placed_matrix(scale * equations.shared[-3:, -3:])
        turn = Following.turning(kept).to(self._device)
        return Following(along, turn, sums[..., -3:].contiguous(), inner)

    @property
    def _follows(self) -> bool:
        """Whether light bounces, and follows the colours that throw it."""
        return self.samples.bounce is not None and self.samples.bounce.shown is not None

    def _whiteness(self, state: State) -> Tensor:
        """d mean ln of each channel / dθ of the vertices that photos tell of, [V, 3]."""
        slope, material = (each[self._told, :3] for each in (state.link_slope, state.materials))
        return slope / material / len(self._told)

    def _placed_matrix(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).float().to(self._device)
