"""The lamp and the lobes against closed forms and energy."""

import numpy as np
import pytest

from independent.gloss import Gloss
from independent.light import Lamp, burley, dot, ggx, lambert
from independent.radiosity import Radiosity
from independent.shapes import disc
from independent.wall import unit

UP = np.array([0.0, 0.0, 1.0])


def hemisphere(count: int = 400) -> tuple[np.ndarray, float]:
    """Directions about z, evenly spread over the hemisphere, and the solid angle of each."""
    z, angle = np.meshgrid((np.arange(count) + 0.5) / count, 2 * np.pi * (np.arange(count) + 0.5) / count)
    side = np.sqrt(1 - z * z)
    directions = np.stack([side * np.cos(angle), side * np.sin(angle), z], axis=-1).reshape(-1, 3)
    return directions, 2 * np.pi / len(directions)


def test_a_plane_under_a_lamp_follows_inverse_square_and_lambert() -> None:
    """At angle θ on a plane at height h: L0·cosⁿθ·cosθ/d², d = h/cosθ."""
    wall = disc(radius_mm=10, at_mm=8)
    radiosity = Radiosity(wall, np.ones((*wall.shape, 3)), np.random.default_rng(0))
    lamp = Lamp(L0=500, n=2.5, q=2)
    got = radiosity.direct(lamp, np.eye(4)).reshape(radiosity.shape)
    middle_mm = 10 * (1 - (np.arange(8) + 0.5) / 8)
    cos = 8 / np.hypot(8, middle_mm)
    expected = 500 * cos**2.5 * cos / (8 / cos) ** 2
    np.testing.assert_allclose(got[1:-1], np.repeat(expected[1:-1, None], got.shape[1], 1), rtol=0.02)


def test_guides_share_the_strength_of_one_lamp() -> None:
    points_mm = np.array([[1.0, 2, 15], [4, -3, 20]])
    one, two = Lamp(100, 2, 2), Lamp(100, 2, 2, guides_mm=((0, 0, 0), (0, 0, 0)))
    np.testing.assert_allclose(
        one.arriving(0, points_mm)[0], two.arriving(0, points_mm)[0] + two.arriving(1, points_mm)[0]
    )


@pytest.mark.parametrize("exponential", [False, True])
def test_a_profile_is_1_on_the_axis_and_0_behind_the_tip(exponential: bool) -> None:
    lamp = Lamp(1, 3, 2, exponential)
    np.testing.assert_allclose(lamp.arriving(0, np.array([[0.0, 0, 10], [3, 0, -10]]))[0], [0.01, 0])


def test_white_lambert_reflects_all_that_arrives() -> None:
    directions, solid = hemisphere()
    assert (lambert(directions[:, 2]) / np.pi).sum() * solid == pytest.approx(1, abs=1e-4)


def test_burley_is_lambert_head_on() -> None:
    normal = UP[None]
    assert burley(normal, normal, normal, np.array([0.5]))[0] == pytest.approx(1)


@pytest.mark.parametrize("roughness", [0.2, 0.4, 0.7])
@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.1])
def test_a_mirror_of_facets_reflects_at_most_what_arrives(roughness: float, tilt: float) -> None:
    """White furnace: with f0 = 1 nothing is lost but what facets shade: nothing for a smooth one head on."""
    directions, solid = hemisphere(1200)
    normals, from_light = (
        np.broadcast_to(UP, directions.shape),
        unit(np.array([np.sin(tilt), 0, np.cos(tilt)])),
    )
    energy = (
        ggx(normals, directions, np.broadcast_to(from_light, directions.shape), roughness, 1) * solid
    ).sum()
    assert 0.6 < energy <= 1.003
    if roughness == 0.2 and tilt == 0:
        assert energy == pytest.approx(1, abs=0.01)


def test_lobes_are_reciprocal() -> None:
    rng = np.random.default_rng(1)
    a, b = (unit(rng.normal(size=(500, 3)) * [1, 1, 0.3] + UP) for _ in range(2))
    normals, roughness = np.broadcast_to(UP, a.shape), rng.uniform(0.2, 0.9, 500)
    kept = (a[:, 2] > 0.05) & (b[:, 2] > 0.05)
    for there, back in (
        (burley(normals, a, b, roughness), burley(normals, b, a, roughness)),
        (ggx(normals, a, b, roughness, 0.04), ggx(normals, b, a, roughness, 0.04)),
    ):
        np.testing.assert_allclose((there / dot(normals, a))[kept], (back / dot(normals, b))[kept], rtol=1e-6)


@pytest.mark.parametrize("roughness", [0.25, 0.5])
@pytest.mark.parametrize("tilt", [0.2, 1.2])
def test_the_table_of_gloss_is_the_lobes_integral(roughness: float, tilt: float) -> None:
    """R = ∫ f·cosθ dω over all directions that light may come from."""
    directions, solid = hemisphere(800)
    to_eye = np.array([np.sin(tilt), 0, np.cos(tilt)])
    normals, to_eye = (np.broadcast_to(v, directions.shape) for v in (UP, to_eye))
    whole = (ggx(normals, directions, to_eye, roughness, 0.03) * solid).sum()
    table = Gloss(0.03).at(np.array([np.cos(tilt)]), np.array([roughness]))[0]
    assert table == pytest.approx(whole, rel=0.02)
