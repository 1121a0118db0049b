"""The slow half of the geometry: a wall thinner than a voxel, seen from both of its sides."""

import numpy as np
import pytest

import endotwin
from endotwin.fusion.agreement import Tolerance, agreement
from endotwin.fusion.views import read_views
from endotwin.selfcheck.journey import warnings_said
from endotwin.selfcheck.tube import Tube, flight

pytestmark = pytest.mark.slow

VOXEL_MM = 0.5


class Divided(Tube):
    """The tube with a fold into it at z = 20 mm, ``THICK_MM`` thick and 7 mm high."""

    THICK_MM = 0.2

    def photograph(self, T_world_camera):
        photo, depth_mm = super().photograph(T_world_camera)
        world, origin = self.rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
        face = 20 - np.sign(20 - origin[2]) * self.THICK_MM / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (face - origin[2]) / world[..., 2]
            point = origin + distance[..., None] * world
            hit = (distance > 0) & (point[..., 0] < -3) & (distance * self.rays[..., 2] < depth_mm)
        photo[hit] = 120
        return photo, np.where(hit, distance * self.rays[..., 2], depth_mm).astype(np.float32)


@pytest.fixture(scope="module")
def both_sides() -> np.ndarray:
    """Eight poses before the wall that look ahead, and eight behind it that look back."""
    ahead, back = flight(8, 0.5), flight(8, 0.5)
    turned = np.diag([-1.0, 1, -1, 1])
    back[:, 2, 3] = 40 - back[:, 2, 3]
    return np.concatenate([ahead, np.stack([T @ turned for T in back])])


def test_two_sheets_closer_than_half_a_voxel_are_both_kept(both_sides, tmp_path):
    sequence_folder = Divided(width=96).write(tmp_path / "divided", both_sides)
    with warnings_said() as said:
        twin = endotwin.fuse_twin(sequence_folder, voxel_mm=VOXEL_MM)
    sequence = endotwin.open_sequence(sequence_folder)
    views = read_views(sequence, range(8))  # those that look back see 7 % of the open end too coarsely
    share = agreement(sequence.camera, twin.surface, views, Tolerance(VOXEL_MM, 0.01))
    assert share.agrees > 0.97, (share, said)
    assert np.isfinite(twin.surface.normals).all()
    lengths = np.linalg.norm(twin.surface.normals, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
