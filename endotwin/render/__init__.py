"""Views of a twin from any pose, and what they cost."""

from endotwin.render.renderer import Renderer, View

__all__ = ["Renderer", "View"]
