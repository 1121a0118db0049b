"""Everything about a scene that its seed draws, and what each of its effects is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace

import numpy as np

from independent.lens import Lens
from independent.light import AT_LENS, Lamp
from independent.path import KINDS

EFFECTS = ("offset", "shadows", "interreflection", "gain", "profile", "vignetting", "coat", "tone")
"""In the order in which light meets them; shadows come and go with an offset."""

CHANCES = {
    "offset": 0.45,
    "interreflection": 0.5,
    "gain": 0.4,
    "profile": 0.3,
    "vignetting": 0.4,
    "coat": 0.4,
}

TONED = 0.3
"""Chance of a tone curve, which is drawn apart from the rest."""


@dataclass(frozen=True)
class Scene:
    """The truth of one scene; a parameter counts only while its effect is in ``effects``.

    Attributes:
        gamma: C = x^γ. n, q: of the lamp. L0: its strength, set so that the photos are well exposed.
        guides_mm: in the camera frame. vignetting: k of e^{−k r²}. gain: factor between the darkest and the
            brightest frame. tone: share of a smooth step. coat_weight, coat_roughness: of the film of water.
            diffuse: burley or lambert.
        roughness, f0: of the tissue's lobe. noise_levels: standard deviation in 1/255.
    """

    seed: int
    effects: frozenset[str]
    gamma: float
    n: float
    q: float
    guides_mm: tuple[tuple[float, float, float], ...]
    vignetting: float
    gain: float
    tone: float
    coat_weight: float
    coat_roughness: float
    diffuse: str
    roughness: float
    f0: float
    noise_levels: float
    lens: Lens
    path: str
    frames: int
    L0: float = 1.0

    @classmethod
    def draw(cls, seed: int, only: Collection[str] = EFFECTS) -> Scene:
        """The scene of a seed, with effects among ``only``; all else is the same whatever they are."""
        rng = np.random.default_rng([seed, 0])
        drawn = {name for name, chance in CHANCES.items() if rng.random() < chance}
        apart = np.random.default_rng([seed, 2])
        if apart.random() < TONED:
            drawn.add("tone")
        effects = drawn & set(only)
        if "offset" in effects:
            effects.add("shadows")
        return cls(
            seed=seed,
            effects=frozenset(effects),
            gamma=float(rng.choice([1 / 2.2, rng.uniform(0.40, 0.55)], p=[0.7, 0.3])),
            n=float(rng.uniform(1, 4)),
            q=2.0,
            guides_mm=_guides(rng),
            vignetting=float(rng.uniform(0.15, 0.5)),
            gain=float(rng.uniform(1.3, 2.5)),
            tone=float(apart.uniform(0.15, 0.4)),
            coat_weight=float(rng.uniform(0.5, 1)),
            coat_roughness=float(np.exp(rng.uniform(np.log(0.06), np.log(0.25)))),
            diffuse=str(rng.choice(["burley", "lambert"], p=[0.7, 0.3])),
            roughness=float(rng.uniform(0.35, 0.6)),
            f0=float(rng.uniform(0.02, 0.045)),
            noise_levels=float(rng.uniform(0.5, 2.5)),
            lens=Lens.omni(240) if rng.random() < 0.25 else Lens.pinhole(320, 240, rng.uniform(90, 110)),
            path=str(rng.choice(KINDS)),
            frames=int(rng.integers(8, 25)),
        )

    def having(self, effects: frozenset[str]) -> Scene:
        """The same scene with these effects and no others."""
        return replace(self, effects=effects)

    def without(self, name: str) -> Scene:
        """The same scene lacking one effect; without an offset there is no shadow."""
        return self.having(self.effects - ({"offset", "shadows"} if name == "offset" else {name}))

    @property
    def lamp(self) -> Lamp:
        """The light as its effects have it."""
        guides_mm = self.guides_mm if "offset" in self.effects else AT_LENS
        return Lamp(self.L0, self.n, self.q, "profile" in self.effects, guides_mm)

    @property
    def gains(self) -> np.ndarray:
        """Factor on each frame's radiance, [frames]: a smooth wander of the camera's gain."""
        if "gain" not in self.effects:
            return np.ones(self.frames)
        rng = np.random.default_rng([self.seed, 1])
        t = np.linspace(0, 1, self.frames)
        wander = sum(rng.uniform(0.3, 1) / k * np.cos(np.pi * k * t + rng.uniform(0, 6)) for k in (1, 2, 3))
        return np.exp((wander - wander.mean()) / np.ptp(wander) * np.log(self.gain))

    def to_dict(self) -> dict:
        """Plain values, with what the effects make of them."""
        values = asdict(self) | {"effects": [name for name in EFFECTS if name in self.effects]}
        values["lens"] = self.lens.to_dict()
        values["guides_mm"] = list(map(list, self.lamp.guides_mm))
        return values | {"gains": self.gains.tolist()}


def _guides(rng: np.random.Generator) -> tuple[tuple[float, float, float], ...]:
    """One to three guides 2 to 5 mm beside the lens, well apart, some a millimetre behind it."""
    count = int(rng.integers(1, 4))
    angle = (
        rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(count) + rng.uniform(-0.15, 0.15, count)) / count
    )
    aside = rng.uniform(2, 5) * rng.uniform(0.85, 1.15, count)
    behind = -1.0 if rng.random() < 0.25 else 0.0
    return tuple(
        (float(a * np.cos(w)), float(a * np.sin(w)), behind) for a, w in zip(aside, angle, strict=True)
    )
