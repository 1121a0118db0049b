"""What is claimed of a dataset's labels, and what was found of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

KEPT = 4000
"""Errors of one frame that quantiles are taken from."""


@dataclass(frozen=True)
class Claim:
    """One thing that holds of all pixels that can be judged.

    Attributes:
        says: it, in words. unit: of the error. limit: the greatest error of a pixel.
        stray: share of the pixels that may exceed it; ``why``: they do.
    """

    says: str
    unit: str
    limit: float
    stray: float = 0.0
    why: str = ""


CLAIMS = {
    "places": Claim("labels have values where there is surface, and nowhere else", "pixels", 0.0),
    "codes": Claim(
        "a label in several codes holds the same numbers", "half steps", 1.1, 1e-5, "the codes' ends"
    ),
    "flow": Claim("flow is what depth, poses and the tissue's motion give", "px", 0.05, 1e-4, "rounding"),
    "cycle": Claim("flow there and back ends where it began, if both frames see it", "px", 0.1, 0.02, "rims"),
    "warp": Claim("depth, moved into the other frame, is its depth", "% of it", 0.1, 0.02, "rims"),
    "hidden": Claim("hidden is what lies behind what is seen there", "pixels", 0.0, 0.02, "rims"),
    "occlusion": Claim("occlusion tells of what another frame sees behind", "pixels", 0.0, 0.005, "rims"),
    "normals": Claim("normals are the gradient of depth, over 17 pixels", "°", 0.5, 0.25, "coarse folds"),
    "triangles": Claim("a pixel's point lies on the triangle that is named", "mm", 0.01, 1e-4, "rounding"),
    "materials": Claim("materials stay with the tissue", "of 1", 0.01, 0.02, "edges"),
    "polyps": Claim("a polyp's number stays with its tissue", "pixels", 0.0, 0.02, "rims"),
    "fluids": Claim("a fluid's number stays with its place", "pixels", 0.0, 0.02, "rims"),
    "response": Claim("rgb is rgb_linear after the response", "of 255", 1.5, 1e-3, "rounding"),
    "split": Claim("rgb is diffuse and specular together", "of 255", 1.6, 1e-3, "rounding"),
}


@dataclass(frozen=True)
class Row:
    """What was found of one claim.

    Attributes:
        claim: its name in ``CLAIMS``. pixels: that were judged. median, high: median error, and that which
            one pixel in a thousand exceeds. beyond: share of the pixels beyond the limit.
    """

    claim: str
    pixels: int
    median: float
    high: float
    beyond: float

    @property
    def holds(self) -> bool:
        stray = CLAIMS[self.claim].stray
        return self.beyond * self.pixels <= max(stray * self.pixels, stray > 0)

    def cells(self) -> tuple[str, ...]:
        """What is claimed, how many pixels were judged, median, one in a thousand, limit, share beyond,
        verdict."""
        claim = CLAIMS[self.claim]
        limit = f"{claim.limit:g} {claim.unit}"
        if claim.stray:
            limit += f"; {claim.why}: {100 * claim.stray:g} % beyond"
        return (
            claim.says,
            f"{self.pixels:,}",
            f"{self.median:.2g}",
            f"{self.high:.2g}",
            limit,
            f"{self.beyond:.4%}",
            "holds" if self.holds else "BROKEN",
        )


HEADINGS = ("claim", "pixels", "median", "1 in 1000", "limit", "beyond", "")


@dataclass(frozen=True)
class Proof:
    """What was found of a dataset: ``frames`` in all, ``pairs`` of which were compared, a row a claim."""

    frames: int
    pairs: int
    rows: tuple[Row, ...]

    @property
    def holds(self) -> bool:
        """Whether all that could be judged holds."""
        return all(row.holds for row in self.rows)

    @property
    def broken(self) -> list[str]:
        """What does not hold, in words."""
        return [CLAIMS[row.claim].says for row in self.rows if not row.holds]

    @property
    def verdict(self) -> str:
        """One sentence."""
        if not self.rows:
            return "There are too few labels to compare with each other."
        judged = f"{len(self.rows)} claims on {self.pairs} pairs of frames"
        if self.holds:
            return f"The labels agree: {judged}."
        return f"The labels do not agree: of {judged}, {len(self.broken)} broken."

    def to_dict(self) -> dict:
        """JSON-ready content."""
        rows = [{**asdict(row), "limit": asdict(CLAIMS[row.claim]), "holds": row.holds} for row in self.rows]
        return {"frames": self.frames, "pairs": self.pairs, "holds": self.holds, "claims": rows}


class Tally:
    """Errors of pixels, claim by claim, as they come."""

    def __init__(self) -> None:
        self._pixels, self._beyond = dict.fromkeys(CLAIMS, 0), dict.fromkeys(CLAIMS, 0)
        self._kept: dict[str, list[np.ndarray]] = {name: [] for name in CLAIMS}

    def add(self, judged: Iterable[tuple[str, np.ndarray]]) -> None:
        """Take in errors [N] of pixels by the name of their claim."""
        for name, errors in judged:
            self._pixels[name] += len(errors)
            self._beyond[name] += int((errors > CLAIMS[name].limit).sum())
            self._kept[name].append(np.sort(errors.astype(np.float32))[:: max(len(errors) // KEPT, 1)])

    def proof(self, frames: int, pairs: int) -> Proof:
        """What was found, in the order of ``CLAIMS``; claims on no pixel are left out."""
        rows = []
        for name, pixels in self._pixels.items():
            if pixels:
                median, high = np.quantile(np.concatenate(self._kept[name]), (0.5, 0.999))
                rows.append(Row(name, pixels, float(median), float(high), self._beyond[name] / pixels))
        return Proof(frames, pairs, tuple(rows))
