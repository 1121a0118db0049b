"""Anatomy grown on a twin's own surface: polyps of the Paris classes."""

from endotwin.anatomy.classes import CLASSES
from endotwin.anatomy.grow import Seedling, grown
from endotwin.anatomy.site import Site

__all__ = ["CLASSES", "Seedling", "Site", "grown"]
