"""Edits of a twin, one draw of them a frame."""

from endotwin.synth.variation.variation import Draw, Variation, fixed, read_variation

__all__ = ["Draw", "Variation", "fixed", "read_variation"]
