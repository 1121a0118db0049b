"""What other programs must know of a twin's light, response and lobes, in one place.

Their renderers are physical: a point light of radiant intensity I throws I·cosθ_i/d² on a surface, of which a
lobe f sends f·I·cosθ_i/d² to the camera. endotwin's x = f·L0·cosⁿθ/d^q·cosθ_i·2π is that with I = 2π·L0 where
q is 2. Another q is no point light; the closest one is equal at the distance from which tissue is usually
seen.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from endotwin.light import shading
from endotwin.light.guides import AT_LENS
from endotwin.surface.casting import Caster
from endotwin.synth.trajectories.recorded import path_or_flight
from endotwin.twin import Twin

VIEWS, PIXELS = 5, 4096
"""The usual distance is the median over so many views, of about so many pixels each."""


@dataclass(frozen=True)
class Appearance:
    """Light, response and lobes of a fitted twin.

    Attributes:
        L0, n, q: L0·cosⁿθ/d^q, d in mm. profile: angular shape of the light, 0 for cosⁿθ (see
            ``guides.log_axis``). guides_mm: places of the light guides in the camera frame (OpenCV axes);
            together they have L0.
        gamma, tone: display value D = C + tone·(3C² − 2C³ − C) of C = x^gamma.
        f0: specular reflectance at normal incidence. burley: whether the diffuse lobe is Burley's.
        coat_f0, coat_roughness, coat_tail: reflectance, times its weight, roughness and tail of the wet coat;
            a reflectance of 0: no coat.
        film_f0, film_roughness: those of a film of weight 1; 0: no film.
        vignetting_k2, vignetting_k4: transmission exp(k2·r² + k4·r⁴) of the lens.
        bounce: strength of light that other tissue throws.
        usual_mm: the distance from which tissue is usually seen.
    """

    L0: float
    n: float
    q: float
    profile: float
    guides_mm: tuple[tuple[float, float, float], ...]
    gamma: float
    tone: float
    f0: float
    burley: bool
    coat_f0: float
    coat_roughness: float
    coat_tail: float
    film_f0: float
    film_roughness: float
    vignetting_k2: float
    vignetting_k4: float
    bounce: float
    usual_mm: float

    @classmethod
    def of(cls, twin: Twin) -> Appearance:
        """What ``twin`` has."""
        effects = twin.effects
        coat, lens = effects.get("coat"), effects.get("vignetting")
        film = effects.get("film") if twin.film else None
        return cls(
            L0=twin.light.L0,
            n=twin.light.n,
            q=twin.light.q,
            profile=effects.profile,
            guides_mm=effects.guides_mm or AT_LENS,
            gamma=twin.response.gamma,
            tone=effects["tone"].contrast if "tone" in effects else 0.0,
            f0=twin.materials.f0,
            burley=twin.materials.diffuse == "burley",
            coat_f0=coat.weight * shading.F0_WATER if coat else 0.0,
            coat_roughness=coat.roughness if coat else 0.0,
            coat_tail=coat.tail if coat else 2.0,
            film_f0=film.amount * shading.F0_WATER if film else 0.0,
            film_roughness=film.roughness if film else 0.0,
            vignetting_k2=lens.k2 if lens else 0.0,
            vignetting_k4=lens.k4 if lens else 0.0,
            bounce=effects.bounce,
            usual_mm=usual_distance_mm(twin),
        )

    @property
    def intensity_mm2(self) -> float:
        """I on the optical axis of all guides together, for lengths in mm and display white at 1."""
        return 2 * math.pi * self.L0 * self.usual_mm ** (2 - self.q)

    @property
    def displayed(self) -> str:
        """What is displayed of radiance x, as a formula."""
        power = f"x^{self.gamma:.6g}"
        return f"C + {self.tone:.6g}*(3*C^2 - 2*C^3 - C) of C = {power}" if self.tone else power

    @property
    def coat_weight(self) -> float:
        """Of a clear coat of a dielectric's reflectance, as formats have it, in [0, 1]."""
        return min(self.coat_f0 / shading.F0_DIELECTRIC, 1.0)

    def to_dict(self) -> dict:
        """All of it as plain values, with what the names mean."""
        return {
            **asdict(self),
            "words": "x = 2*pi*L0*sum over guides(cos(theta)^n/d^q*(n.wi)*(diffuse + specular))/guides, "
            "C = x^gamma, display = C + tone*(3*C^2 - 2*C^3 - C); d in mm; guides_mm in the camera frame: "
            "x right, y down, z forward",
        }


def diffuse_color(twin: Twin) -> np.ndarray:
    """Base colour of the diffuse lobe, float32 [V, 3], linear: Han & Wu's metallic darkens that alone."""
    return twin.materials.base_color * (1 - twin.materials.metallic)[:, None]


def usual_distance_mm(twin: Twin) -> float:
    """Median distance of the surface over views of the path; 1 where nothing is seen."""
    poses, caster = path_or_flight(twin), Caster(twin.surface)
    camera = twin.camera.scaled(min(1.0, math.sqrt(PIXELS / (twin.camera.width * twin.camera.height))))
    chosen = poses[np.linspace(0, len(poses) - 1, min(VIEWS, len(poses))).astype(int)] if len(poses) else []
    seen = [caster.cast(camera, pose).distance_mm for pose in chosen]
    distance_mm = np.concatenate(seen) if seen else np.ones(1)
    return float(np.median(distance_mm)) if len(distance_mm) else 1.0
