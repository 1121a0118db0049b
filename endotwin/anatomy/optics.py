"""What a layer of fluid makes of the colour of the tissue below it.

Kubelka and Munk (Z. tech. Phys. 1931; 12: 593; hyperbolic solution: Kubelka, J. Opt. Soc. Am. 1948; 38: 448,
eq. 29): a layer of thickness X with the coefficients K of absorption and S of scattering of diffuse light, on
a substrate of reflectance Rg, reflects

    R = (1 − Rg·(a − b·coth bSX)) / (a − Rg + b·coth bSX),   a = 1 + K/S,   b = √(a² − 1),

which is Rg at X = 0, Rg·e^(−2KX) without scattering (Beer–Lambert, twice through), and a − b for a thick one.
K = 2·μa and S = ¾·μs', since diffuse light goes twice as far (Star et al., Phys. Med. Biol. 1988; 33: 437).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BANDS_NM = ((600, 660), (520, 560), (440, 480))
"""Of red, green and blue: the bands about the peaks of an RGB sensor. Which they are is a free choice."""

OXYHAEMOGLOBIN = {
    **{440: 102580.0, 450: 62816.0, 460: 44480.0, 470: 33209.2, 480: 26629.2},
    **{520: 24202.4, 530: 39956.8, 540: 53236.0, 550: 43016.0, 560: 32613.2},
    **{600: 3200.0, 610: 1506.0, 620: 942.0, 630: 610.0, 640: 442.0, 650: 368.0, 660: 319.6},
}
"""Molar extinction, 1/(cm·mol/L), by wavelength in nm: Prahl, Oregon Medical Laser Center 1999, from data of
Gratzer and Kollias (omlc.org/spectra/hemoglobin)."""

MOLAR_MASS = 64500.0
"""Of haemoglobin, g/mol (Prahl)."""

WHOLE_BLOOD = 150.0
"""Haemoglobin in whole blood, g/L (Prahl)."""

BLOOD_SCATTERING = 1.0
"""Reduced scattering of whole blood, 1/mm: of the order that Bosschaart et al. (Lasers Med. Sci. 2014; 29:
453) compile for the visible; it makes thick blood dark red rather than black."""


@dataclass(frozen=True)
class Optics:
    """Coefficients of diffuse light in a layer.

    Attributes:
        absorption: K of red, green and blue, 1/mm. scattering: S, 1/mm. roughness: of the layer's surface.
    """

    absorption: tuple[float, float, float]
    scattering: tuple[float, float, float]
    roughness: float

    @classmethod
    def of_thick(cls, reflectance: tuple[float, ...], scattering_per_mm: float, roughness: float) -> Optics:
        """Those of what reflects ``reflectance`` when it is thick: K/S = (1 − R)²/2R (Kubelka and Munk)."""
        absorption = tuple(scattering_per_mm * (1 - r) ** 2 / (2 * r) for r in reflectance)
        return cls(absorption, (scattering_per_mm,) * 3, roughness)

    def over(self, substrate: np.ndarray, thickness_mm: np.ndarray) -> np.ndarray:
        """Reflectance [N, 3] of layers of ``thickness_mm`` [N] over ``substrate`` [N, 3] in [0, 1]."""
        return layered(np.array(self.absorption), np.array(self.scattering), substrate, thickness_mm[:, None])


def layered(
    absorption: np.ndarray, scattering: np.ndarray, substrate: np.ndarray, thickness_mm: np.ndarray
) -> np.ndarray:
    """Reflectance of layers over a ``substrate``; all of shapes that go together. See the module's text.

    Written with S and x = √(K² + 2KS)·X, so that it has its limits where S or K is 0:
    R = (Rg·(x·coth x − KX − SX) + SX) / (x·coth x + KX + SX − Rg·SX).
    """
    kx, sx = absorption * thickness_mm, scattering * thickness_mm
    x = np.sqrt(kx * (kx + 2 * sx))
    safe = np.maximum(x, 1e-6)
    steep = safe / np.tanh(safe)
    return (substrate * (steep - kx - sx) + sx) / (steep + kx + sx - substrate * sx)


def blood(haemoglobin: float) -> Optics:
    """Blood with so many g/L of oxygenated ``haemoglobin``, its absorption the mean over each band."""
    per_mm = np.log(10) / 10 * haemoglobin / MOLAR_MASS
    absorption = [
        2 * per_mm * np.mean([e for nm, e in OXYHAEMOGLOBIN.items() if low <= nm <= high])
        for low, high in BANDS_NM
    ]
    scattering = 0.75 * BLOOD_SCATTERING * haemoglobin / WHOLE_BLOOD
    return Optics(tuple(map(float, absorption)), (scattering,) * 3, 0.18)


MUCUS = Optics.of_thick((0.86, 0.82, 0.66), 0.9, 0.2)
"""Whitish and yellowish, half transparent at the thickness of a film: free parameters, chosen by eye."""

STOOL = Optics.of_thick((0.3, 0.138, 0.034), 8.0, 0.5)
"""Brown-yellow, opaque from some tenths of a millimetre on: free parameters, chosen by eye."""
