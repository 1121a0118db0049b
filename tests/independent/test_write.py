"""A written scene is what endotwin reads, and its cameras see what the truth says."""

import json
from dataclasses import replace

import numpy as np
import pytest

import endotwin
from endotwin.cameras import CALIBRATIONS, camera_from_dict
from independent.lens import Lens
from independent.scene import Scene
from independent.write import MADE, make

SMALL = Lens.pinhole(64, 48, 95)


@pytest.mark.parametrize("lens", [Lens.pinhole(320, 240, 100), Lens.omni(240)], ids=["pinhole", "omni"])
def test_rays_are_those_of_the_camera_that_is_written(lens: Lens, tmp_path) -> None:
    camera = camera_from_dict(lens.to_dict(), tmp_path)
    v, u = np.mgrid[: lens.height : 7, : lens.width : 7]
    got, expected = lens.rays(u, v), camera.directions(np.stack([u, v], axis=-1).astype(float))
    inside = lens.lit(u, v)
    np.testing.assert_allclose(got[inside], expected[inside], atol=1e-9)


def test_the_omnidirectional_lens_is_that_of_c3vd() -> None:
    lens, c3vd = Lens.omni(1080), CALIBRATIONS["c3vd-v1"]
    assert lens.to_dict() == pytest.approx(c3vd.to_dict())


def test_depth_maps_of_two_frames_show_one_wall(tmp_path) -> None:
    """Points of one depth map, seen from the next frame, lie at the depth that is written there."""
    scene = replace(Scene.draw(4, only=()), lens=SMALL, frames=2)
    make(scene, tmp_path)
    sequence = endotwin.open_sequence(tmp_path)
    first, second = (sequence.frame(index) for index in (0, 1))
    directions = sequence.camera.pixel_directions.astype(np.float64)
    points = directions / directions[..., 2:] * first.depth_mm[..., None]
    world = points[np.isfinite(first.depth_mm)] @ first.T_world_camera[:3, :3].T + first.T_world_camera[:3, 3]
    there = (world - second.T_world_camera[:3, 3]) @ second.T_world_camera[:3, :3]
    u, v = np.rint(sequence.camera.project(there)).astype(int).T
    inside = (u >= 0) & (u < 64) & (v >= 0) & (v < 48) & (there[:, 2] > 1)
    error = np.abs(second.depth_mm[v[inside], u[inside]] / there[inside, 2] - 1)
    assert np.median(error) < 0.01


@pytest.mark.slow
def test_a_scene_is_made_once_and_its_seed_tells_all_of_it(tmp_path) -> None:
    scene = replace(Scene.draw(0), lens=SMALL, frames=2).having(frozenset({"gain", "coat"}))
    made = make(scene, tmp_path / "a")
    written = (tmp_path / "a" / MADE).stat().st_mtime_ns
    assert make(scene, tmp_path / "a") == made
    assert (tmp_path / "a" / MADE).stat().st_mtime_ns == written
    make(replace(scene, gamma=0.4), tmp_path / "b")
    make(scene, tmp_path / "b")
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert MADE in files
    assert all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes() for name in files)
    assert json.loads((tmp_path / "a" / MADE).read_text())["effects"] == ["gain", "coat"]


def test_effects_change_nothing_else_that_is_drawn() -> None:
    every, none = Scene.draw(3), Scene.draw(3, only=())
    assert every.effects and not none.effects
    assert every.having(none.effects) == none
