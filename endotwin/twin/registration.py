"""Where photos lie beside what their sequence says, and through which camera: corrections that belong to a
twin."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from endotwin.cameras import Camera
from endotwin.errors import SequenceError
from endotwin.sequence import Sequence


@dataclass(frozen=True)
class Registration:
    """Corrections of the poses and the camera that a sequence was written with.

    Attributes:
        twists: one a frame, T_world_camera = T_written · exp(twist): a rotation vector in radians, then a
            translation in mm, in the camera's frame (SciPy's exponential coordinates).
        found: what they are made of, by name: ``model_mm``, ``model_deg``, ``hand_eye_mm``, ``hand_eye_deg``,
            ``lag_frames``, ``focal_percent``, ``centre_percent`` (of the width), and ``own_mm``, ``own_deg``:
            what photos have of their own, root mean square.
        with_depth: whether depth maps move with their photos, or stay where they are.
        intrinsics: of the photos' camera (see ``Camera.corrected``); depth keeps the written one.
    """

    twists: tuple[tuple[float, ...], ...]
    found: dict[str, float] = field(default_factory=dict)
    with_depth: bool = False
    intrinsics: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def poses(self, T_written: np.ndarray) -> np.ndarray:
        """The corrected poses float64 [N, 4, 4] of written ones."""
        return T_written @ RigidTransform.from_exp_coords(np.array(self.twists)).as_matrix()

    def camera(self, written: Camera) -> Camera:
        """The photos' camera where ``written`` is the sequence's, at any scale."""
        return written.corrected(np.array(self.intrinsics))

    def applied(self, sequence: Sequence) -> Sequence:
        """The sequence at its corrected poses, through its corrected camera; raises SequenceError if it has
        another number of frames by now."""
        if len(sequence) != len(self.twists):
            raise SequenceError(
                f"{sequence.path} has {len(sequence)} frames, but {len(self.twists)} were aligned; "
                "make it again with 'endotwin fuse'"
            )
        camera = self.camera(sequence.camera)
        return replace(sequence, camera=camera, T_world_camera=self.poses(sequence.T_world_camera))

    def to_dict(self) -> dict:
        """Plain values, from which ``from_dict`` makes it again."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> Registration:
        """Raises ValueError for what ``to_dict`` cannot have given."""
        twists = np.array(values["twists"], np.float64)
        if twists.ndim != 2 or twists.shape[1] != 6 or not np.isfinite(twists).all():
            raise ValueError("its registration has no six numbers a frame")
        longer, right, down = (float(value) for value in values.get("intrinsics", (0, 0, 0)))
        return cls(
            tuple(map(tuple, twists.tolist())),
            dict(values["found"]),
            bool(values["with_depth"]),
            (longer, right, down),
        )
