"""Held-out renders of the bundled example have no dots: single pixels much darker than all about them."""

import cv2
import numpy as np
import pytest

import endotwin

pytestmark = pytest.mark.slow


def test_no_dots_remain_along_rims_in_the_held_out_renders_of_the_example(example):
    twin = endotwin.fit_twin(endotwin.fuse_twin(example))
    sequence, renderer = twin.sequence(), endotwin.Renderer(twin)
    for index in twin.source.heldout(len(sequence)):
        brightness = renderer.view(sequence.T_world_camera[index]).color.max(axis=2)
        usual = cv2.medianBlur(brightness, 5)
        assert not ((brightness < usual / 2) & (usual > 0.05)).any()
        assert np.count_nonzero(brightness == 0) == 0
