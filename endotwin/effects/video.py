"""The recorder: a clip through H.264 at a bitrate, as capture boxes write it."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar

import cv2
import numpy as np

from endotwin.effects.effect import Effect, parameter
from endotwin.errors import OptionError
from endotwin.sequence import Sequence
from endotwin.sequence.poses import FRAMES_PER_SECOND

CLIP_FRAMES = 60
"""Frames of a clip: two seconds from one whole picture to the next."""


@dataclass(frozen=True)
class Video(Effect):
    """H.264 by x264 and back: 8 bits, colour differences at half the size (4:2:0, BT.601), what is left of
    each picture beside those before it, as coarsely rounded as the bitrate asks for. A clip begins with a
    whole picture, and no picture waits for a later one (``zerolatency``: no B frames), as in live recording.

    Attributes:
        bitrate: Mbit/s at 30 frames/s; the bits of half a second may come ahead of their time.
    """

    name: ClassVar[str] = "video"
    bitrate: float = parameter(4.0, 0.05, 200.0)

    @classmethod
    def require_encoder(cls) -> None:
        """Raise OptionError where PyAV is not installed, or has no x264."""
        _av()

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Video | None, str]:
        """Never by itself: what a sequence lost to its own recorder is not in its photos."""
        return None, "rendered on request: photos do not tell what their recorder took away"


class Clip:
    """Pictures of a clip, in order, through encoder and decoder; another size or bitrate begins a clip."""

    def __init__(self):
        self._kind: tuple | None = None

    def recorded(self, color: np.ndarray, video: Video) -> np.ndarray:
        """Display values float32 [H, W, 3] of the next picture as they are played back."""
        av, kind = _av(), (video, color.shape)
        if kind != self._kind:
            self._kind, self._count = kind, 0
            self._encoder, self._decoder = _encoder(av, video, color.shape), _decoder(av)
        levels = np.rint(np.clip(color, 0, 1) * np.float32(255)).astype(np.uint8)
        height, width = levels.shape[:2]
        even = cv2.copyMakeBorder(levels, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        picture = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(format="yuv420p")
        picture.pts = self._count
        self._count += 1
        (packet,) = self._encoder.encode(picture)
        (played,) = self._decoder.decode(packet)
        return played.to_ndarray(format="rgb24")[:height, :width].astype(np.float32) / np.float32(255)


def _av():
    """PyAV, which has x264; raises OptionError where it is not there."""
    try:
        import av
    except ImportError as error:
        raise OptionError(
            "the effect video needs PyAV; install it with pip install 'endotwin[video]'"
        ) from error
    if "libx264" not in av.codecs_available:
        raise OptionError("the effect video needs x264, which this PyAV lacks; install its wheel from PyPI")
    return av


def _encoder(av, video: Video, shape: tuple[int, ...]):
    """On one thread: with more, x264 cuts pictures into slices."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.height, encoder.width = (side + side % 2 for side in shape[:2])
    encoder.pix_fmt = "yuv420p"
    encoder.framerate = Fraction(FRAMES_PER_SECOND)
    encoder.time_base = 1 / encoder.framerate
    encoder.thread_count, encoder.gop_size = 1, CLIP_FRAMES
    bits = encoder.bit_rate = round(1e6 * video.bitrate)
    limits = {"maxrate": str(bits), "bufsize": str(bits // 2)}
    encoder.options = {"tune": "zerolatency", "threads": "1", **limits}
    return encoder


def _decoder(av):
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    decoder.flags |= av.codec.context.Flags.low_delay
    return decoder
