"""The arms of the experiment: what each network is trained on."""

from __future__ import annotations

from dataclasses import dataclass

from endotwin.errors import OptionError
from endotwin.study.recipe import EVERYTHING, INGREDIENTS, POSES, RENDERED, Recipe, merged

PARTS = ("headline", "ingredients", "curve", "robustness")
CURVE = (50, 100, 200, 500, 1000, 2000, 5000)


@dataclass(frozen=True)
class Arm:
    """One training.

    Attributes:
        name: of the arm, and of its files. part: of the experiment. real: whether it sees the real frames.
        recipe: of the rendered frames that it sees. frames: how many of those; None: all.
    """

    name: str
    part: str
    real: bool = False
    recipe: Recipe | None = None
    frames: int | None = None

    @property
    def words(self) -> str:
        """What it sees."""
        rendered = f"rendered: {self.recipe.words}" if self.recipe else ""
        return " and ".join(filter(None, ("real frames" if self.real else "", rendered)))


HEADLINE = (
    Arm("real", "headline", real=True),
    Arm("rendered", "headline", recipe=RENDERED),
    Arm("both", "headline", real=True, recipe=RENDERED),
)
VARIED = tuple(merged(f"poses+{each.name}", (POSES, each)) for each in INGREDIENTS)
TASTED = tuple(Arm(recipe.name, "ingredients", recipe=recipe) for recipe in (POSES, *VARIED, EVERYTHING))


def arms(parts: tuple[str, ...], frames: int) -> list[Arm]:
    """The trainings of ``parts`` with so many rendered frames; the headline's are always among them."""
    curve = [
        Arm(f"rendered@{count}", "curve", recipe=RENDERED, frames=count) for count in CURVE if count < frames
    ]
    return [
        *HEADLINE,
        *(TASTED if "ingredients" in parts else ()),
        *(curve if "curve" in parts else ()),
    ]


def parse_parts(text: str) -> tuple[str, ...]:
    """Names of ``PARTS`` joined by commas, or ``all``; raises OptionError."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if names == ["all"]:
        return PARTS
    unknown = [name for name in names if name not in PARTS]
    if unknown or not names:
        raise OptionError(
            f"there is no part {(unknown or [text])[0]!r}; choose from {', '.join(PARTS)}, or all"
        )
    return tuple(name for name in PARTS if name in names)
