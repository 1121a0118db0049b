"""What a training pixel shows, C = x^γ of its radiance x (``light.forward``), and the derivatives for least
squares."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from endotwin.effects.coat import Coat
from endotwin.effects.tone import Tone, bend
from endotwin.effects.vignetting import Vignetting
from endotwin.light import forward, shading
from endotwin.light.forward import Lit, Lobes
from endotwin.pixels.samples import Samples
from endotwin.twin import Light, Response

GLOBALS = ("gamma·ln L0", "gamma·n", "gamma·q", "gamma", "ln f0")
"""The shared parameters as they are fitted: those in which a diffuse surface's log C is linear."""

GAMMA, F0 = (GLOBALS.index(name) for name in ("gamma", "ln f0"))

EVERY_GLOBAL = (*GLOBALS, "gamma·k2", "contrast", "ln albedo scale")
"""Behind a lens that vignettes there is one more, since light of another n passes for most of that; under a
tone curve another; and with interreflection one that tells how bright the tissue is beside the light."""

K2 = EVERY_GLOBAL.index("gamma·k2")


@dataclass(frozen=True)
class Globals:
    """What all pixels share, as one vector float64 [G]: GLOBALS, and those of EVERY_GLOBAL that a scene calls
    for.

    Without ``specular`` there is no specular lobe, and ln f0 stays where it is. A ``coat`` adds a lobe of its
    own; a lens that ``vignettes`` adds a parameter, and so does a tone curve over x^γ, by which photos are
    ``toned``. ``tissue`` [3] is the mean of ln of the base colours that bounced light follows; None: what it
    was when that was found.
    """

    vector: Tensor
    specular: bool = True
    coat: Coat | None = None
    tissue: Tensor | None = None
    vignettes: bool = False
    toned: bool = False

    @classmethod
    def of(
        cls, light: Light, response: Response, f0: float, specular: bool = True, bounce: bool = False
    ) -> Globals:
        gamma = response.gamma
        values = [gamma * math.log(light.L0), gamma * light.n, gamma * light.q, gamma, math.log(f0)]
        return cls(torch.tensor(values + [0.0] * bounce, dtype=torch.float64), specular)

    def behind(self, lens: Vignetting | None) -> Globals:
        """The same behind a ``lens`` that vignettes, whose k2 is found; None: that does not vignette."""
        return self._beside(lens, self.tone)

    def under(self, tone: Tone | None) -> Globals:
        """The same under a ``tone`` curve, whose contrast is found; None: under none."""
        return self._beside(Vignetting(k2=self.k2) if self.vignettes else None, tone)

    def _beside(self, lens: Vignetting | None, tone: Tone | None) -> Globals:
        more = [*([self.gamma * lens.k2] if lens else []), *([tone.contrast] if tone else [])]
        bare, scale = self.vector[: len(GLOBALS)], self.vector[self.unscaled :]
        vector = torch.cat([bare, torch.tensor(more, dtype=torch.float64), scale])
        return replace(self, vector=vector, vignettes=lens is not None, toned=tone is not None)

    @property
    def log_light(self) -> tuple[float, float, float]:
        """ln L0, n, q."""
        return tuple((self.vector[:3] / self.vector[3]).tolist())

    @property
    def light(self) -> Light:
        log_L0, n, q = self.log_light
        return Light(L0=math.exp(log_L0), n=n, q=q)

    @property
    def gamma(self) -> float:
        return float(self.vector[3])

    @property
    def f0(self) -> float:
        return math.exp(self.vector[4]) if self.specular else 0.0

    @property
    def lobes(self) -> Lobes:
        return Lobes(self.f0, coat=None if self.coat is None else self.coat.lobe)

    def without_scale(self) -> Globals:
        """The same without interreflection."""
        return replace(self, vector=self.vector[: self.unscaled])

    @property
    def unscaled(self) -> int:
        """How many parameters come before the albedo's scale."""
        return len(GLOBALS) + self.vignettes + self.toned

    @property
    def bounces(self) -> bool:
        """Whether light bounces between tissue."""
        return len(self.vector) > self.unscaled

    @property
    def k2(self) -> float:
        """Of the lens's vignetting; 0 without any."""
        return float(self.vector[len(GLOBALS)]) / self.gamma if self.vignettes else 0.0

    @property
    def tone(self) -> Tone | None:
        """The curve over the photos; None without one."""
        return Tone(float(self.vector[self.unscaled - 1])) if self.toned else None

    @property
    def places(self) -> list[int]:
        """Of the parameters in EVERY_GLOBAL, [G]."""
        there = [True] * len(GLOBALS) + [self.vignettes, self.toned, self.bounces]
        return [place for place, is_there in enumerate(there) if is_there]

    @property
    def log_scale(self) -> float:
        """ln of the factor on all albedo; 0 without interreflection."""
        return float(self.vector[-1]) if self.bounces else 0.0

    @property
    def bouncing(self) -> tuple[float, float, float, float, float]:
        """What says how light bounces: n, q, ln of the albedo's scale, γ, f0."""
        return (*self.log_light[1:], self.log_scale, self.gamma, self.f0)


def columns_of(shared: Globals, bordered: bool) -> np.ndarray:
    """What the columns of ``Linearised.by_shared`` are of the shared parameters, [columns, G]."""
    plain, scale = np.split(np.eye(len(shared.vector)), [shared.unscaled])
    return np.concatenate([plain[: shared.unscaled * bordered], *[scale] * 3])


def free_directions(shared: Globals, held: tuple[str, ...]) -> np.ndarray:
    """Steps of the shared parameters that keep those named in ``held`` (L0, n, q, gamma, f0, k2, contrast,
    albedo scale, or the level γ·ln L0, with which displayed base colours stay): a basis [G, K].

    The light is fitted as γ·ln L0, γ·n and γ·q: γn − n·γ = 0 keeps n while γ moves.
    """
    log_L0, n, q = shared.log_light
    kept = {
        "L0": [1, 0, 0, -log_L0, 0, 0, 0, 0],
        "level": [1, 0, 0, 0, 0, 0, 0, 0],
        "n": [0, 1, 0, -n, 0, 0, 0, 0],
        "q": [0, 0, 1, -q, 0, 0, 0, 0],
        "gamma": [0, 0, 0, 1, 0, 0, 0, 0],
        "f0": [0, 0, 0, 0, 1, 0, 0, 0],
        "k2": [0, 0, 0, -shared.k2, 0, 1, 0, 0],
        "contrast": [0, 0, 0, 0, 0, 0, 1, 0],
        "albedo scale": [0, 0, 0, 0, 0, 0, 0, 1],
    }
    if not held:
        return np.eye(len(shared.vector))
    return scipy.linalg.null_space(np.array([kept[name] for name in held])[:, shared.places])


def at_pixels(samples: Samples, triangles: Tensor, per_vertex: Tensor) -> Tensor:
    """Vertex values [V, C] interpolated at the samples, [N, C]; ``triangles`` int64 [F, 3]."""
    corners, weights = triangles.index_select(0, samples.triangle), samples.barycentric
    return embedding_bag(corners, per_vertex, per_sample_weights=weights.to(per_vertex), mode="sum")


def radiance(samples: Samples, material: Tensor, shared: Globals) -> Tensor:
    """Radiance x [N, 3] of the samples with ``material``: base colour and roughness at the pixels, [N, 4]."""
    lit = _lit(samples, material[:, :3], shared)
    return forward.radiance(lit, shared.log_light, material[:, :3], material[:, 3], shared.lobes)


def glow(samples: Samples, material: Tensor, shared: Globals) -> Tensor | float:
    """The share of ``radiance`` that is bounced light, [N, 3], which does not depend on the normal; 0 where
    none bounces."""
    if samples.bounce is None:
        return 0.0
    return forward.glow(_lit(samples, material[:, :3], shared), shared.log_light, material[:, :3])


def log_exposure(samples: Samples, shared: Globals) -> Tensor | None:
    """ln of gain and vignetting at the samples, [N]; None: 0."""
    if not shared.vignettes:
        return samples.log_exposure
    passed = shared.k2 * samples.radius2
    return passed if samples.log_exposure is None else samples.log_exposure + passed


def _lit(samples: Samples, base_color: Tensor, shared: Globals) -> Lit:
    """What lights the samples, where light bounced off tissue of ``base_color`` [N, 3]."""
    lit, bounce = samples.lit(*shared.bouncing), samples.bounce
    if shared.vignettes:
        lit = replace(lit, log_exposure=log_exposure(samples, shared))
    if bounce is None or bounce.shown is None:
        return lit
    factor = bounce.followed(torch.log(base_color), shared.gamma, shared.tissue)
    return replace(lit, irradiance=lit.irradiance * factor, mirrored=lit.mirrored * factor)


def predict(samples: Samples, material: Tensor, shared: Globals) -> Tensor:
    """Display values C [N, 3]; above 1 where a photo would clip."""
    return displayed(radiance(samples, material, shared), shared)


def displayed(x: Tensor, shared: Globals) -> Tensor:
    """Display values of radiance ``x``."""
    untoned = shading.respond(x, shared.gamma)
    return untoned if shared.tone is None else shared.tone.shown(untoned)


def slope_by_log_exposure(samples: Samples, material: Tensor, shared: Globals) -> tuple[Tensor, Tensor]:
    """Display values C [N, 3] and dC/d ln x [N, 3]: what a change of exposure does."""
    x = radiance(samples, material, shared)
    power = torch.exp(shared.gamma * torch.log(x + shading.RADIANCE_MIN))
    floor = math.exp(shared.gamma * math.log(shading.RADIANCE_MIN))
    untoned, slope = power - floor, shared.gamma * power * x / (x + shading.RADIANCE_MIN)
    if shared.tone is None:
        return untoned, slope
    return shared.tone.shown(untoned), shared.tone.slope(untoned) * slope


@dataclass(frozen=True)
class Linearised:
    """Prediction and derivatives at N samples.

    Attributes:
        predicted: [N, 3]. by_color: dC/db [N, 3] (each channel by its own base colour).
        by_roughness: dC/dr [N, 3]. by_globals: dC by the shared parameters, [N, 3, G].
        by_coat: dC by the coat's weight, [N, 3]; None: there is no coat.
    """

    predicted: Tensor
    by_color: Tensor
    by_roughness: Tensor
    by_globals: Tensor
    by_coat: Tensor | None

    def by_shared(self, shared: Globals, bordered: bool) -> Tensor:
        """dC by the ``shared`` parameters, if the equations are ``bordered`` by them, with the albedo's scale
        apart for each channel: [N, 3, columns]."""
        count = shared.unscaled
        plain, scale = self.by_globals[..., : count * bordered], self.by_globals[..., count:]
        return torch.cat([plain, torch.diag_embed(scale[..., 0])], dim=2) if scale.shape[2] else plain

    def under(self, shared: Globals) -> Linearised:
        """The same as the tone curve of the ``shared`` parameters displays it, and by its contrast."""
        if not shared.toned:
            return self
        steep, place = shared.tone.slope(self.predicted), shared.unscaled - 1
        by_globals = steep[..., None] * self.by_globals
        parts = by_globals[..., :place], bend(self.predicted)[..., None], by_globals[..., place:]
        return Linearised(
            predicted=shared.tone.shown(self.predicted),
            by_color=steep * self.by_color,
            by_roughness=steep * self.by_roughness,
            by_globals=torch.cat(parts, dim=-1),
            by_coat=None if self.by_coat is None else steep * self.by_coat,
        )


def linearise(samples: Samples, material: Tensor, shared: Globals) -> Linearised:
    """The model and its derivatives at ``material`` [N, 4]; those by roughness come from automatic
    differentiation.
    """
    lobes, log_light = shared.lobes, shared.log_light
    lit = _lit(samples, material[:, :3], shared)
    roughness = material[:, 3].detach().requires_grad_()
    with torch.enable_grad():
        shares = forward.shares(lit, log_light, roughness, lobes)
        per_color = sum(share.per_color for share in shares)
        shine = sum(share.shine for share in shares) if shared.specular else torch.zeros_like(per_color)
        color_slope = torch.autograd.grad(per_color.sum(), roughness, retain_graph=True)[0]
        shine_slope = 0 * color_slope
        if shared.specular:
            shine_slope = torch.autograd.grad(shine.sum(), roughness)[0]
    base_color, per_color, shine = material[:, :3].detach(), per_color.detach()[:, None], shine.detach()
    x = axis = distance = 0.0
    for share in shares:
        given = share.radiance(base_color, lobes).detach()
        x, axis = x + given, axis + given * share.log_axis[:, None]
        distance = distance + given * share.log_distance[:, None]
    coat = None if lobes.coat is None else sum(share.coat for share in shares).detach()[:, None]
    if samples.bounce is not None:
        bounced, mirrored = forward.bounced(lit, log_light)
        glow = bounced * base_color + mirrored * lit.gloss[:, :1]
        x, per_color = x + glow, per_color + bounced
        axis = axis + glow * samples.bounce.by_n[:, None]
        distance = distance - glow * samples.bounce.by_q[:, None]
    gamma, (log_L0, n, q) = shared.gamma, log_light
    log_x = torch.log(x + shading.RADIANCE_MIN)
    power = torch.exp(gamma * log_x)
    slope = gamma * power / (x + shading.RADIANCE_MIN)
    log_floor = math.log(shading.RADIANCE_MIN)
    floor = math.exp(gamma * log_floor)
    by_color = slope * per_color
    by_light = slope / gamma
    told = log_L0 * x + n * axis - q * distance
    by_k2 = []
    if shared.vignettes:
        passed = samples.radius2[:, None] * x
        told, by_k2 = told + shared.k2 * passed, [by_light * passed]
    by_gamma = power * log_x - floor * log_floor - by_light * told
    by_gamma = by_gamma - by_color * base_color * torch.log(base_color) / gamma
    if samples.bounce is not None:
        by_gamma = by_gamma + slope * glow * samples.bounce.by_gamma
        if samples.bounce.shown is not None:
            by_color = by_color + slope * glow * samples.bounce.following / base_color
    by_f0, by_scale = shine[:, None], []
    if samples.bounce is not None:
        by_scale = [slope * glow * samples.bounce.by_scale]
        if samples.bounce.by_f0 is not None:
            whiter = glow * samples.bounce.by_f0
            by_f0 = by_f0 + whiter + shared.f0 * samples.bounce.gloss_by_f0[:, None] * mirrored
            by_scale[0] = by_scale[0] + slope * whiter
    by_globals = [by_light * x, by_light * axis, -by_light * distance, by_gamma, slope * by_f0]
    by_globals += by_k2 + by_scale
    return Linearised(
        predicted=power - floor,
        by_color=by_color,
        by_roughness=slope * (color_slope[:, None] * base_color + shine_slope[:, None]),
        by_globals=torch.stack(by_globals, dim=-1),
        by_coat=None if coat is None else slope * coat,
    ).under(shared)
