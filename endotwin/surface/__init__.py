"""The mesh of a lumen, and what rays and views make of it."""

from endotwin.surface.surface import Surface

__all__ = ["Surface"]
