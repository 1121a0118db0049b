"""Interlacing: which rows see which moment, and that a camera that is still shows no comb."""

from dataclasses import replace

import numpy as np
import torch
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.exposure import Shot
from endotwin.effects.interlacing import FIELDS, Interlacing
from endotwin.render import Renderer
from endotwin.synth.photograph import photographed

STEP_MM = np.array([0.0, 0.0, 1.0])


def shot_of(speed: float) -> Shot:
    there, later = np.eye(4), np.eye(4)
    later[:3, 3] = speed * STEP_MM
    camera = tube_twin.CAMERA
    return Shot(camera, there, later, np.full((camera.height, camera.width), 20.0))


def depth_of_pose(shot: Shot) -> torch.Tensor:
    """An image whose value is how far along the way its pose is."""
    return torch.full((shot.camera.height, shot.camera.width, 3), float(shot.T_world_camera[2, 3]))


def test_even_rows_are_a_quarter_of_a_frame_early_and_odd_ones_as_late():
    woven = Interlacing().woven(depth_of_pose, shot_of(1.0)).numpy()
    np.testing.assert_allclose(woven[0::2], FIELDS[0], atol=1e-6)
    np.testing.assert_allclose(woven[1::2], FIELDS[1], atol=1e-6)


def test_the_fields_move_with_the_velocity_of_the_shot():
    """Half a frame lies between them, and from a frame's odd rows to the next frame's even ones as much."""
    velocities = []

    def seen(shot: Shot) -> torch.Tensor:
        velocities.append(shot.T_world_next[2, 3] - shot.T_world_camera[2, 3])
        return depth_of_pose(shot)

    Interlacing().woven(seen, shot_of(3.0))
    np.testing.assert_allclose(velocities, 3.0, atol=1e-6)
    assert FIELDS[1] - FIELDS[0] == 1 + FIELDS[0] - FIELDS[1] == 0.5


def test_a_still_camera_has_no_comb_and_a_moving_one_has():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=1.5)))
    renderer = Renderer(replace(twin, effects=Effects([Interlacing()])))
    here, later, rng = tube_twin.pose(0.5), tube_twin.pose(0.54), np.random.default_rng(0)
    view = renderer.view(here)
    still = photographed(renderer, view, here, here, rng)[0]
    np.testing.assert_allclose(still, view.color, atol=1e-5)
    moving = photographed(renderer, view, here, later, rng)[0]
    combs = [np.abs(np.diff(image, n=2, axis=0)).mean() for image in (view.color, moving)]
    assert combs[1] > 1.5 * combs[0]
