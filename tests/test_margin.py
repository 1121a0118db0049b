"""The surface goes on beyond the pictures, on the tissue, as far as photos may be displaced, and not where a
picture shows what is there."""

import numpy as np
import pytest
import trimesh

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.cameras.base import padded
from endotwin.fusion.agreement import Tolerance
from endotwin.fusion.margin import ERROR_DEG, ERROR_MM, ERRORS, margin_px, with_margin
from endotwin.fusion.mesh import surface_of
from endotwin.fusion.views import View
from endotwin.surface.casting import Caster

RADIUS_MM = 10.0
TOLERANCE = Tolerance(0.1, 0.01)
PINHOLE = Pinhole(96, 80, 70.0, 72.0, 47.5, 40.5, k1=-0.1)
FISHEYE = Fisheye(96, 80, 45.0, 45.0, 47.0, 40.0, k1=0.03)
OMNI = CALIBRATIONS["c3vd-v1"].scaled(1 / 12)
PLACE = np.array([1.0, -2.0, 3.0])


def pose(degrees=0.0):
    """At ``PLACE``, turned about y."""
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 1, 0])
    turn[:3, 3] = PLACE
    return turn


def measured(camera, T_world_camera):
    """What a camera within the sphere about the origin measures."""
    rays = camera.pixel_directions @ T_world_camera[:3, :3].T
    along = rays @ PLACE
    distance_mm = np.sqrt(along**2 + RADIUS_MM**2 - PLACE @ PLACE) - along
    return View(0, T_world_camera, distance_mm.astype(np.float32))


def seen_part(camera, T_world_camera):
    """Of the sphere, the triangles that reach into the picture."""
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_MM)
    uv = camera.project((sphere.vertices - PLACE) @ T_world_camera[:3, :3])
    with np.errstate(invalid="ignore"):
        inside = ((uv >= -0.4) & (uv <= np.array([camera.width, camera.height]) - 0.6)).all(axis=1)
    triangles = sphere.faces[inside[sphere.faces].any(axis=1)][:, ::-1]
    used, numbers = np.unique(triangles, return_inverse=True)
    return surface_of(np.zeros(3), sphere.vertices[used].astype(np.float32), numbers.reshape(-1, 3))


def continued(camera, view, *others):
    surface = seen_part(camera, view.T_world_camera)
    return with_margin(camera, surface, [view], [view, *others], TOLERANCE, RADIUS_MM)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, OMNI], ids=lambda camera: camera.model)
def test_the_wall_goes_on_where_it_is_and_meets_the_rays_beside_the_picture(camera):
    view = measured(camera, pose())
    surface = continued(camera, view)
    new_mm = surface.vertices_mm[surface.filled]
    np.testing.assert_allclose(np.linalg.norm(new_mm, axis=1), RADIUS_MM, rtol=0.02)
    assert met(camera, surface) > 0.998
    assert met(camera, seen_part(camera, pose())) < 0.95


def met(camera, surface):
    """Share of the rays of a picture and the margin about it, but for its last pixels, that meet it."""
    wide = padded(camera, margin_px(camera, RADIUS_MM) - 1)
    return len(Caster(surface).cast(wide, pose()).pixel) / (wide.width * wide.height)


def test_the_margin_is_what_twice_the_error_of_registration_displaces_by():
    displaced = np.array([ERRORS * ERROR_MM, 0, RADIUS_MM])
    turn = np.radians(ERRORS * ERROR_DEG)
    displaced = displaced @ np.array(
        [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
    )
    moved_px = PINHOLE.project(displaced)[0] - PINHOLE.cx
    assert moved_px <= margin_px(PINHOLE, RADIUS_MM) < moved_px + 2


@pytest.mark.parametrize("median_mm", [1.0, 0.02, 1e-9])
def test_beside_tissue_nearer_than_errors_of_registration_the_wall_goes_on_by_a_sixteenth_of_the_picture(
    median_mm,
):
    assert margin_px(PINHOLE, median_mm) == PINHOLE.height // 16


@pytest.mark.parametrize("share", [1.0, 1.5], ids=["at it", "behind it"])
def test_nothing_goes_on_where_another_picture_shows_tissue_at_that_place_or_behind_it(share):
    aside = measured(PINHOLE, pose(20))
    aside.distance_mm[:] *= share
    alone = continued(PINHOLE, measured(PINHOLE, pose()))
    surface = continued(PINHOLE, measured(PINHOLE, pose()), aside)
    uv = PINHOLE.project((surface.vertices_mm[surface.filled] - PLACE) @ pose(20)[:3, :3])
    in_aside = ((uv > 0) & (uv < (PINHOLE.width - 1, PINHOLE.height - 1))).all(axis=1)
    assert not in_aside.any()
    assert 0 < surface.filled.sum() < alone.filled.sum()


def test_a_rim_that_the_picture_cuts_does_not_go_on():
    view = measured(PINHOLE, pose())
    view.distance_mm[:, -12:] *= np.linspace(1, 3, 12, dtype=np.float32)
    surface = seen_part(PINHOLE, pose())
    uv = PINHOLE.project(continued(PINHOLE, view).vertices_mm[len(surface.vertices_mm) :] - PLACE)
    assert len(uv)
    assert not (uv[:, 0] > PINHOLE.width - 1).any()


def test_a_surface_whose_views_measured_nothing_at_their_borders_stays_as_it_is():
    view = measured(PINHOLE, pose())
    view.distance_mm[:10] = view.distance_mm[-10:] = np.nan
    view.distance_mm[:, :10] = view.distance_mm[:, -10:] = np.nan
    before = seen_part(PINHOLE, pose())
    assert with_margin(PINHOLE, before, [view], [view], TOLERANCE, RADIUS_MM) is before
