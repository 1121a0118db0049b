"""Photos registered to the surface, only as far as photos prove it."""

from endotwin.align.decide import STATES, Alignment, align

__all__ = ["STATES", "Alignment", "align"]
