"""Tissue that moves by itself: contraction waves, and the sway of breathing."""

from endotwin.synth.motion.motion import Motion, parse_motion

__all__ = ["Motion", "parse_motion"]
