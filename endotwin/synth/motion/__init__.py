"""Tissue that moves by itself: contraction waves, and the sway of breathing."""

from endotwin.synth.motion.motion import Body, Motion, parse_motion

__all__ = ["Body", "Motion", "parse_motion"]
