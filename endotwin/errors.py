"""The errors a user can mend: one sentence each, raised where the fact is known and caught once, in
``cli``.
"""


class EndotwinError(Exception):
    """Base class. The message says what is wrong, in which file, and what to do."""


class SequenceError(EndotwinError):
    """A sequence folder, image, depth map or pose file that cannot be used as it is."""


class CameraError(EndotwinError):
    """A camera description that is unknown or impossible."""


class TwinError(EndotwinError):
    """A twin folder that is missing, damaged, unfitted, or of a newer version."""


class TrajectoryError(EndotwinError):
    """A trajectory that cannot be read, or whose poses do not lie inside the surface."""


class OptionError(EndotwinError):
    """An option whose value makes no sense."""


class OutputError(EndotwinError):
    """An output that exists already, or cannot be written."""
