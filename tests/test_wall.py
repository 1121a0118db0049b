"""The wall that closes a lumen: where the tissue is, off what was measured, and not between a camera and what
it shows."""

import numpy as np
import pytest
import trimesh
from independent.colon import LENGTH, Colon
from independent.wall import Wall

from endotwin.cameras import Pinhole
from endotwin.fusion.mesh import surface_of
from endotwin.fusion.tube import tube_of
from endotwin.fusion.views import View
from endotwin.fusion.wall import EDGE, GAP, with_wall
from endotwin.surface.casting import Caster

RADIUS_MM = 10.0
LONGER = 1.6
MEDIAN_MM = 2 * RADIUS_MM
CAMERA = Pinhole(64, 64, 32.0, 32.0, 31.5, 31.5)


@pytest.fixture(scope="module")
def torn():
    """An ellipsoid about the origin, longer along z, without all that lies more than .7 radii towards x."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    triangles = sphere.faces[sphere.triangles_center[:, 0] < 0.7 * RADIUS_MM, ::-1]
    return surface_of(np.zeros(3), (sphere.vertices * [1, 1, LONGER]).astype(np.float32), triangles)


def towards_minus_x(surface, x_mm):
    """What a camera at ``x_mm`` on the x axis that looks back along it measures."""
    pose = trimesh.transformations.rotation_matrix(-np.pi / 2, [0, 1, 0])
    pose[0, 3] = x_mm
    hits = Caster(surface).cast(CAMERA, pose)
    return View(0, pose, hits.laid_out(hits.distance_mm, (CAMERA.height, CAMERA.width), np.nan))


def walled(surface, x_mm=0.0):
    return with_wall(CAMERA, surface, towards_minus_x(surface, x_mm).T_world_camera[None], MEDIAN_MM)


def met(surface):
    """Share of the directions from the origin in which surface or wall is met from the front."""
    vertices_mm = np.concatenate([surface.vertices_mm, surface.wall_mm])
    triangles = np.concatenate([surface.triangles, surface.wall_triangles + len(surface.vertices_mm)])
    whole = surface_of(np.zeros(3), vertices_mm, triangles)
    rays = trimesh.creation.icosphere(subdivisions=4).vertices.astype(np.float32)
    hit, _, _ = Caster(whole).cast_rays(np.zeros_like(rays), rays)
    corners = whole.vertices_mm[whole.triangles[hit]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return ((hit >= 0) & (np.einsum("ra,ra->r", normals, rays) < 0)).mean()


def test_the_wall_closes_an_ellipsoid_near_where_it_was(torn):
    surface = walled(torn)
    np.testing.assert_allclose(np.linalg.norm(surface.wall_mm / [1, 1, LONGER], axis=1), RADIUS_MM, rtol=0.15)
    assert met(torn) < 0.86 < 0.95 < met(surface)


def test_the_surface_itself_stays_as_it_is_and_the_wall_keeps_off_it(torn):
    surface = walled(torn)
    for name in ("vertices_mm", "triangles", "normals", "filled"):
        assert getattr(surface, name) is getattr(torn, name)
    middle_mm = surface.wall_mm[surface.wall_triangles].mean(axis=1)
    gap_mm = np.linalg.norm(middle_mm[:, None] - torn.vertices_mm[None], axis=2).min(axis=1)
    assert gap_mm.min() > GAP * EDGE * MEDIAN_MM


def test_no_wall_shuts_a_camera_out_that_looks_in_from_outside(torn):
    """As the first frame of an insertion, which the lumen's open end lies before."""
    assert len(walled(torn).wall_triangles) > 50
    surface, view = walled(torn, 1.3 * RADIUS_MM), towards_minus_x(torn, 1.3 * RADIUS_MM)
    assert hidden(walled(torn), view) > 0.5
    assert hidden(surface, view) == 0


def strip(turn=0.9, folds=0.0):
    """A strip along z of a tube of RADIUS_MM about the z axis, that turns by so much about it, with rings of
    folds."""
    z, angle = np.meshgrid(np.linspace(-15, 15, 121), np.linspace(-turn, turn, 61), indexing="ij")
    reach = RADIUS_MM - folds * np.exp(-(((z - 7 * np.round(z / 7)) / 1.5) ** 2))
    points = np.stack([reach * np.cos(angle), reach * np.sin(angle), z], axis=-1).reshape(-1, 3)
    corner = np.arange(121 * 61).reshape(121, 61)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.stack([np.stack([a, c, b], -1), np.stack([d, b, c], -1)], axis=2).reshape(-1, 3)
    return surface_of(np.zeros(3), points.astype(np.float32), triangles)


@pytest.mark.parametrize("folds", [0.0, 1.5])
def test_a_strip_of_a_tube_tells_its_axis_and_radius(folds):
    tube = tube_of(strip(folds=folds))
    assert abs(tube.axis[2]) > 0.999
    assert tube.radius_mm == pytest.approx(RADIUS_MM, rel=0.02 if not folds else 0.1)
    centre_mm, _ = tube.centre(np.linspace(-15, 15, 7))
    assert np.linalg.norm(centre_mm[:, :2], axis=1).max() < 0.02 * RADIUS_MM + folds / 2
    assert tube.holds(np.zeros((1, 3))) and not tube.holds(np.array([[-1.2 * RADIUS_MM, 0, 0]]))


@pytest.mark.parametrize("bend_mm", [35.0, 80.0])
def test_a_strip_of_a_bent_tube_tells_how_it_goes_on(bend_mm):
    """An arc of six radii in length about (0, −bend, 0); a radius beyond each of its ends the tube still lies
    on it."""
    straight = strip()
    around, aside, along = straight.vertices_mm.T
    angle = 2 * along / bend_mm
    bent = np.stack(
        [-aside, (bend_mm + around) * np.cos(angle) - bend_mm, (bend_mm + around) * np.sin(angle)]
    )
    tube = tube_of(surface_of(np.zeros(3), bent.T.astype(np.float32), straight.triangles))
    assert tube.radius_mm == pytest.approx(RADIUS_MM, rel=0.03)
    angle = np.linspace(-1, 1, 9) * 40 / bend_mm
    true_mm = np.stack([0 * angle, bend_mm * (np.cos(angle) - 1), bend_mm * np.sin(angle)], axis=1)
    centre_mm, tangent = tube.centre(tube.along_mm(true_mm))
    assert np.linalg.norm(np.cross(true_mm - centre_mm, tangent), axis=1).max() < 0.3 * RADIUS_MM


@pytest.mark.parametrize("seed", range(4))
def test_a_side_of_a_random_colon_tells_its_radius(seed):
    """Folds, bumps and bends are no part of it. Three fifths of the girth are there, over three radii."""
    colon = Colon.draw(np.random.default_rng(seed))
    rows, columns = colon.points_mm.shape[:2]
    length = int(rows * 3 / LENGTH)
    side = Wall(colon.points_mm[(rows - length) // 2 : (rows + length) // 2])
    ahead = (side.triangles % columns).max(axis=1) < 0.6 * columns
    middle_mm = side.vertices_mm.mean(axis=0)
    tube = tube_of(surface_of(np.zeros(3), side.vertices_mm - middle_mm, side.triangles[ahead]))
    assert tube.radius_mm == pytest.approx(colon.radius_mm, rel=0.06)


def test_points_of_a_tube_lie_on_it_and_its_round_ends_and_face_inside():
    tube = tube_of(strip())
    points_mm, normals = tube.points(np.array([[0, 0, -15.0], [0, 0, 15]]), 5.0, 1.0)
    inner_mm = np.clip(points_mm[:, 2], -20, 20)[:, None] * [0, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(points_mm - inner_mm, axis=1), RADIUS_MM, rtol=0.02)
    assert (np.einsum("pa,pa->p", normals, points_mm - inner_mm) / RADIUS_MM).max() < -0.97
    assert 20 + 0.9 * RADIUS_MM < np.abs(points_mm[:, 2]).max() < 20 + 1.1 * RADIUS_MM


def test_a_plane_and_a_ball_from_outside_are_no_tubes():
    plane = trimesh.creation.box([30, 30, 0]).subdivide().subdivide().subdivide()
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_MM)
    facing = plane.face_normals[:, 2] > 0.5
    for mesh, triangles in ((plane, plane.faces[facing]), (ball, ball.faces)):
        assert tube_of(surface_of(np.zeros(3), np.asarray(mesh.vertices, np.float32), triangles)) is None


def test_the_wall_of_a_strip_is_the_rest_of_its_tube():
    """A camera on the axis looks at a strip; where it does not look, the lumen goes on around it."""
    surface = strip()
    pose = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    walled = with_wall(CAMERA, surface, pose[None], RADIUS_MM)
    middle_mm = walled.wall_mm[walled.wall_triangles].mean(axis=1)
    around = middle_mm[np.abs(middle_mm[:, 2]) < 10]
    reach_mm = np.linalg.norm(around[:, :2], axis=1)
    assert np.quantile(np.abs(reach_mm / RADIUS_MM - 1), 0.9) < 0.05
    turn = np.histogram(np.arctan2(around[:, 1], around[:, 0]), 12, (-np.pi, np.pi))[0]
    assert (turn[[0, 1, 2, 9, 10, 11]] > 0).all()


def hidden(surface, view):
    """Of the pixels that measured something, the share that the wall lies before."""
    wall = surface_of(np.zeros(3), surface.wall_mm, surface.wall_triangles)
    hits = Caster(wall).cast(CAMERA, view.T_world_camera)
    before = hits.distance_mm < view.distance_mm.reshape(-1)[hits.pixel]
    return before.sum() / np.isfinite(view.distance_mm).sum()


def test_the_same_surface_gets_the_same_wall(torn):
    one, other = walled(torn), walled(torn)
    assert one.wall_mm.tobytes() == other.wall_mm.tobytes()
    assert one.wall_triangles.tobytes() == other.wall_triangles.tobytes()
