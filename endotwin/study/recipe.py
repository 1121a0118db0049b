"""Which frames are rendered for an arm: poses, and what varies beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import yaml

TRAJECTORY = "jitter:translation=5,rotation=8"
"""Poses of what is rendered, in mm and degrees about the recorded ones (docs/study.md)."""

OTHER_LENSES = 1 / 5
"""Share of frames that are rendered through other lenses than the twin's own, where a recipe asks for any."""


@dataclass(frozen=True)
class Recipe:
    """A dataset of novel poses, and what else.

    Attributes:
        name: of the arm. words: what varies. vary: content of a file of ranges, as ``endotwin synth --vary``
            reads it. codec: least and greatest JPEG quality of the photos. lenses: whether it is rendered
            through the lenses of the test sequences too.
    """

    name: str
    words: str
    vary: dict[str, list[str] | dict[str, float]] = field(default_factory=dict)
    codec: tuple[int, int] | None = None
    lenses: bool = False

    def write(self, path: Path) -> None:
        """The ranges as a file for ``--vary``."""
        path.write_text(yaml.safe_dump(self.vary, sort_keys=False), encoding="utf-8")


POSES = Recipe("poses", "novel poses")

HUE = Recipe(
    "hue", "the base colour's hue", {"material": ["base_color.r*0.85..1.15", "base_color.b*0.85..1.15"]}
)

LENS = Recipe(
    "lens",
    "a fifth through the lenses of the test sequences, with the black around their circles",
    lenses=True,
)

INGREDIENTS = (
    HUE,
    Recipe("material", "brightness of the base colour", {"material": ["base_color*0.6..1.4"]}),
    Recipe(
        "light",
        "exposure, colour, profile and place of the light, response",
        {
            "light": [
                *("intensity*0.4..2", "n*0.5..1.5", "color.r*0.8..1.2", "color.b*0.8..1.2"),
                *("offset.x+-3..3", "offset.y+-3..3"),
            ],
            "response": ["gamma*0.8..1.2"],
        },
    ),
    Recipe(
        "highlights",
        "roughness, and a wet coat on every other frame",
        {"material": ["roughness*0.4..1.4"], "effects": {"coat": 0.5}, "parameters": ["coat.weight*0.3..3"]},
    ),
    Recipe(
        "camera",
        "noise, defocus and codec",
        {
            "effects": {"noise": 0.7, "defocus": 0.3},
            "parameters": ["noise.read_noise*0.5..3", "defocus.aperture_mm*1..8"],
        },
        codec=(30, 95),
    ),
    LENS,
)


def merged(name: str, recipes: tuple[Recipe, ...]) -> Recipe:
    """A recipe with all that varies in any of ``recipes``."""
    vary: dict = {}
    for recipe in recipes:
        for key, values in recipe.vary.items():
            kept = vary.get(key)
            vary[key] = (
                values if kept is None else kept | values if isinstance(values, dict) else kept + values
            )
    codec = next((recipe.codec for recipe in recipes if recipe.codec), None)
    words = "; ".join(recipe.words for recipe in recipes)
    return Recipe(name, words, vary, codec, any(recipe.lenses for recipe in recipes))


HELPED = (POSES, HUE, LENS)
RENDERED = merged("rendered", HELPED)
"""What stands for endotwin's datasets: what helped (docs/study.md)."""

EVERYTHING = merged("everything", (POSES, *INGREDIENTS))
