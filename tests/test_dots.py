"""Held-out renders have no dots: single pixels much darker than all about them, where the photo is not."""

import os

import cv2
import numpy as np
import pytest

import endotwin

pytestmark = pytest.mark.slow

AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
DARKER, BLACK = 0.5, 0.08


def dots(render, photo):
    """Bool [H, W]: pixels of a render half as bright as the darkest of their eight neighbours or less, where
    the photo has no such dark pixel within one of them."""
    shown, seen = (np.float32(picture.max(axis=2)) for picture in (render, photo))
    darkest = cv2.erode(shown, AROUND)
    dark_in_photo = cv2.erode(seen, np.ones((3, 3), np.uint8)) < DARKER * cv2.medianBlur(seen, 5)
    return (shown < DARKER * darkest) & (darkest > BLACK) & ~dark_in_photo


def heldout(twin):
    """Renders and photos in [0, 1] of the held-out frames."""
    sequence, renderer = twin.sequence(), endotwin.Renderer(twin)
    for index in twin.source.heldout(len(sequence)):
        yield renderer.view(sequence.T_world_camera[index]).color, sequence.frame(index).color / 255


@pytest.mark.long
def test_no_dots_remain_along_rims_in_the_held_out_renders_of_the_example(fitted):
    for render, photo in heldout(fitted):
        assert not dots(render, photo).any()
        brightness = render.max(axis=2)
        usual = cv2.medianBlur(brightness, 5)
        assert not ((brightness < usual / 2) & (usual > 0.05)).any()
        assert np.count_nonzero(brightness == 0) == 0


@pytest.mark.skipif("ENDOTWIN_SLOW" not in os.environ, reason="ENDOTWIN_SLOW is not set: it takes minutes")
def test_shadows_of_rims_leave_no_dots_where_photos_have_none(data_root):
    twin = endotwin.fit_twin(endotwin.fuse_twin(data_root / "colon_offset"))
    assert "shadows" in twin.effects
    for render, photo in heldout(twin):
        assert not dots(render, photo).any()
        assert (render.max(axis=2) == 0).any()  # shadows are as black as they were


def test_a_dot_is_found():
    photo = np.full((20, 20, 3), 0.5)
    render = photo.copy()
    render[8, 8] = 0.1
    assert np.argwhere(dots(render, photo)).tolist() == [[8, 8]]
    assert not dots(render, render).any()
