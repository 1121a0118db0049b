"""How tissue moves: as a contraction of the lumen, or as a shift of its centreline, by place and time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

AHEAD, WIDER = 5.0, 2.0
"""Relaxation ahead of a wave: its place and its width, in widths of the wave. It is half as high as the
contraction, so that the lumen's radius has the same sum over its length at any time."""


@dataclass(frozen=True)
class Peristalsis:
    """Options of ``peristalsis:``, waves of contraction that travel against the line, towards its start, and
    haustra that pulse in their places.

    The wall nears the line by A·(e^(−x²/2) − ½·e^(−(x−5)²/8)), x the way ahead of the wave in widths:
    contraction, and descending relaxation before it (Bayliss & Starling 1899). Haustra:
    P·sin(2πs/λ)·sin(2πt/T).
    """

    amplitude: float = field(default=0.5, metadata={"help": "of the waves, mm at the wall"})
    width: float = field(default=0.09, metadata={"help": "standard deviation, as a share of the centreline"})
    speed: float = field(default=20.0, metadata={"help": "of the waves, mm/s"})
    delay: float = field(default=5.0, metadata={"help": "from one wave to the next, s"})
    pulse: float = field(default=0.3, metadata={"help": "of the haustra, mm at the wall"})
    spacing: float = field(default=25.0, metadata={"help": "of two haustra that contract together, mm"})
    period: float = field(default=6.0, metadata={"help": "of the haustra, s"})

    def contraction_mm(self, s_mm: np.ndarray, length_mm: float, time_s: float) -> np.ndarray:
        """How much nearer to the line the wall is at ``s_mm``, [S], ascending, of its ``length_mm``; [S]."""
        width_mm, apart_mm = self.width * length_mm, self.speed * self.delay
        margin_mm = (AHEAD + 4 * WIDER) * width_mm
        front_mm = length_mm - self.speed * np.mod(time_s, self.delay)
        first = np.floor((s_mm[0] - margin_mm - front_mm) / apart_mm)
        last = np.ceil((s_mm[-1] + margin_mm - front_mm) / apart_mm)
        x = (front_mm + apart_mm * np.arange(first, last + 1) - s_mm[:, None]) / width_mm
        waves = np.exp(-(x**2) / 2) - np.exp(-((x - AHEAD) ** 2) / (2 * WIDER**2)) / WIDER
        pulse = np.sin(2 * np.pi * s_mm / self.spacing) * np.sin(2 * np.pi * time_s / self.period)
        return self.amplitude * waves.sum(axis=1) + self.pulse * pulse

    def shift_mm(self, s_mm: np.ndarray, time_s: float) -> np.ndarray:
        """No shift of the line, [S]."""
        return np.zeros_like(s_mm)


@dataclass(frozen=True)
class Breathing:
    """Options of ``breathing:``, which sways the line sideways: A·(1 − cos⁴(πt/T))·sin(2πs/Λ).

    The course of a breath is that of Lujan et al. 1999: longest where the breath is out. The camera rides on
    the line with a share of its motion.
    """

    amplitude: float = field(default=8.0, metadata={"help": "of the line's way sideways, mm"})
    period: float = field(default=4.0, metadata={"help": "of a breath, s"})
    wavelength: float = field(default=200.0, metadata={"help": "of the sway along the line, mm"})
    follow: float = field(default=0.75, metadata={"help": "share of the line's motion that the camera takes"})

    def contraction_mm(self, s_mm: np.ndarray, length_mm: float, time_s: float) -> np.ndarray:
        """No contraction, [S]."""
        return np.zeros_like(s_mm)

    def shift_mm(self, s_mm: np.ndarray, time_s: float) -> np.ndarray:
        """How far sideways the line is at ``s_mm`` [S], [S]."""
        breath = 1 - np.cos(np.pi * time_s / self.period) ** 4
        return self.amplitude * breath * np.sin(2 * np.pi * s_mm / self.wavelength)


KINDS = {"peristalsis": Peristalsis, "breathing": Breathing}
