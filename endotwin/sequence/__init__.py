"""Posed RGB-D sequences: photos, depth maps and poses in memory, whatever lies on disk."""

from endotwin.sequence.sequence import Frame, Sequence, Split

__all__ = ["Frame", "Sequence", "Split"]
