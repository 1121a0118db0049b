"""Where glints say that guides are: exact mirrors, and glints drawn at random."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import pinhole
from scipy.spatial.transform import Rotation

from endotwin.evidence.glints import PLACES_A_GUIDE, Glints, crossings_mm, outshining
from endotwin.pixels.samples import Samples, Views
from endotwin.pixels.start import Start
from endotwin.surface import Surface
from endotwin.surface.vectors import unit
from endotwin.twin import Light, Response

REACH_MM, CELLS = 12.0, 64
X_MM = (np.arange(CELLS) + 0.5) / CELLS * 2 * REACH_MM - REACH_MM
THREE_MM = np.array([[3.2, 0.6, 0], [-2.8, 2.7, 0], [-1.3, -3.1, 0]])


def bumps(guides_mm: np.ndarray, spread_mm: float) -> np.ndarray:
    """Sum of Gaussians about the guides at the cells of the map."""
    apart2_mm = (np.add.outer((X_MM - x) ** 2, (X_MM - y) ** 2) for x, y, _ in guides_mm)
    return sum(np.exp(-each / 2 / spread_mm**2) for each in apart2_mm)


def drawn(guides_mm: np.ndarray, seed: int, spread_mm: float = 1.2, elsewhere: float = 0.01) -> Glints:
    """Glints of a million pixels all over the map: three in ten at a guide, and a few everywhere."""
    rng = np.random.default_rng(seed)
    seen = rng.poisson(1_000_000 / CELLS**2, (CELLS, CELLS)).astype(float)
    shone = rng.poisson(seen * (elsewhere + 0.3 * bumps(guides_mm, spread_mm)))
    return Glints(X_MM, shone.astype(float), seen)


def seen_by_a_camera(rng: np.random.Generator, count: int) -> tuple[Samples, np.ndarray]:
    """So many pixels, each of a triangle of its own, 5 to 40 mm away; and the camera's rotation."""
    camera, pose = pinhole(), np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    ones, zeros = torch.ones(count), torch.zeros(count)
    samples = Samples(
        triangle=torch.arange(count),
        barycentric=torch.full((count, 3), 1 / 3),
        cos=ones,
        sin2=zeros,
        log_cos_axis=zeros,
        log_distance=torch.from_numpy(np.log(rng.uniform(5, 40, count)).astype(np.float32)),
        color=torch.zeros(count, 3, dtype=torch.uint8),
        frame=torch.zeros(count, dtype=torch.int32),
        pixel=torch.from_numpy(rng.integers(0, camera.width * camera.height, count).astype(np.int32)),
        views=Views(camera, np.ones((camera.height, camera.width), bool), np.array([0]), pose[None]),
    )
    return samples, pose[:3, :3]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), x_mm=st.floats(-6, 6), y_mm=st.floats(-6, 6))
def test_a_ray_mirrored_halfway_to_a_guide_meets_the_lens_plane_there(seed, x_mm, y_mm):
    samples, rotation = seen_by_a_camera(np.random.default_rng(seed), 50)
    guide_mm = np.array([x_mm, y_mm, 0])
    halfway = unit(unit(guide_mm - samples.points_mm) - samples.directions)
    normals = np.repeat(halfway @ rotation.T, 3, axis=0).astype(np.float32)
    surface = Surface.from_mesh(np.zeros_like(normals), np.arange(150).reshape(50, 3), normals)
    found_mm, steep = crossings_mm(samples, surface)
    assert steep.any()
    np.testing.assert_allclose(found_mm[steep], np.tile(guide_mm[:2], (steep.sum(), 1)), atol=2e-3)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("number", [1, 2, 3])
def test_guides_are_found_in_the_middle_of_their_glints(number, seed):
    true_mm = THREE_MM[:number]
    found_mm = drawn(true_mm, seed).guides_mm(number)
    assert found_mm.shape == (number, 3)
    assert np.linalg.norm(found_mm[:, None] - true_mm, axis=2).min(axis=0).max() < 0.1


def test_half_the_squares_of_the_residuals_are_negative_log_likelihoods():
    glints = drawn(THREE_MM, 0)
    _, spread_mm, rates = glints._best(3)

    def negative_log_likelihood(guides_mm: np.ndarray) -> float:
        mean = glints.seen * (rates[0] + rates[1] * bumps(guides_mm, spread_mm))
        told = glints.seen > 0
        return float((mean - glints.shone * np.log(np.where(told, mean, 1))).sum())

    def half_squares(guides_mm: np.ndarray, place_pixels: float) -> float:
        return float((glints.residuals(guides_mm, place_pixels) ** 2).sum()) / 2

    aside_mm, every = THREE_MM + np.array([0.4, -0.3, 0]), glints.shone.sum()
    lost = negative_log_likelihood(aside_mm) - negative_log_likelihood(THREE_MM)
    assert lost > 0
    assert half_squares(aside_mm, every) - half_squares(THREE_MM, every) == pytest.approx(lost)
    worth = 3 * PLACES_A_GUIDE * 8 / every
    assert half_squares(aside_mm, 8) - half_squares(THREE_MM, 8) == pytest.approx(worth * lost)


@pytest.mark.parametrize("number", [1, 3])
def test_glints_say_no_more_of_a_guide_however_many_they_are(number):
    true_mm = THREE_MM[:number]
    few, many = (drawn(true_mm, 0), drawn(true_mm, 0))
    many.shone, many.seen = 16 * many.shone, 16 * many.seen
    aside_mm = true_mm + np.array([0.4, -0.3, 0])
    lost = [
        (glints.residuals(aside_mm, 8) ** 2).sum() - (glints.residuals(true_mm, 8) ** 2).sum()
        for glints in (few, many)
    ]
    assert lost[1] == pytest.approx(lost[0], rel=0.02)


def test_where_nothing_glints_nothing_is_said_of_guides():
    glints = Glints(X_MM, np.zeros((CELLS, CELLS)), np.ones((CELLS, CELLS)))
    assert glints.guides_mm(2).shape == (0, 3)
    assert not glints.residuals(THREE_MM, 8.0).any()


def test_a_pixel_glints_that_outshines_its_place_in_other_photos_however_near_they_were_taken():
    distance_mm, gamma = np.array([10, 12, 15, 20, 30, 20], np.float32), 0.5
    shown = 255 * 10 * (0.2 / distance_mm**2) ** gamma
    shown[5] += 30
    color = torch.from_numpy(np.tile(np.uint8(shown)[:, None], 3))
    samples, _ = seen_by_a_camera(np.random.default_rng(0), 6)
    samples = Samples(
        **vars(samples) | {"color": color, "log_distance": torch.from_numpy(np.log(distance_mm))}
    )
    start = Start(Light(1.0, 2.0, 2.0), Response(gamma), np.ones((1, 3), np.float32), ())
    told, shines = outshining(samples, np.zeros(6, int), start)
    assert told.all()
    assert shines.tolist() == [False] * 5 + [True]
    told, _ = outshining(samples, np.arange(6), start)
    assert not told.any()


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_a_photo_that_is_brighter_as_a_whole_does_not_glint(seed):
    rng, places, photos = np.random.default_rng(seed), 30, 7
    place, photo = (x.ravel() for x in np.divmod(np.arange(places * photos), photos))
    log_gain, log_albedo = rng.uniform(-0.5, 0.5, photos), rng.uniform(-0.3, 0.3, places)
    shown = 90 * np.exp(0.5 * log_gain[photo] + log_albedo[place])
    glint = rng.integers(len(place))
    shown[glint] += 40
    samples, _ = seen_by_a_camera(rng, len(place))
    views = samples.views
    poses = np.repeat(views.T_local_camera, photos, axis=0)
    samples = Samples(
        **vars(samples)
        | {
            "color": torch.from_numpy(np.repeat(np.uint8(shown)[:, None], 3, axis=1)),
            "log_distance": torch.zeros(len(place)),
            "frame": torch.from_numpy(photo.astype(np.int32)),
            "views": Views(views.camera, views.lens_mask, np.arange(photos), poses),
        }
    )
    start = Start(Light(1.0, 2.0, 2.0), Response(0.5), np.ones((1, 3), np.float32), ())
    told, shines = outshining(samples, place, start)
    assert told.all()
    assert np.flatnonzero(shines).tolist() == [glint]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("number", [1, 2, 3])
def test_glints_tell_as_many_guides_as_they_stand_about(number, seed):
    glints = drawn(THREE_MM[:number], seed, spread_mm=0.6, elsewhere=1e-4)
    assert glints.told() == number
    assert glints.tell(THREE_MM[:number])
    assert not glints.tell(-THREE_MM[:number])


@pytest.mark.parametrize("seed", range(3))
def test_glints_about_the_lens_tell_no_guides(seed):
    glints = drawn(np.zeros((1, 3)), seed, elsewhere=1e-4)
    assert glints.shone.sum() > 1000
    assert glints.told() == 0


def test_a_handful_of_glints_tells_no_guides():
    shone = np.zeros((CELLS, CELLS))
    shone[50, 40:44] = 10
    glints = Glints(X_MM, shone, np.full((CELLS, CELLS), 100.0))
    assert not glints.tell(np.array([[X_MM[50], X_MM[42], 0]]))
