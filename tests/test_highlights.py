"""Highlights are found where they were drawn, and told apart from tissue, rims and each other."""

import cv2
import numpy as np
import pytest

from endotwin.evaluation.highlights import NEAR_PX, Alike, highlights

TISSUE = (0.55, 0.35, 0.3)
WHOLE = np.ones((240, 320), bool)


def picture(*spots: tuple[int, int, int], white: float = 0.6) -> np.ndarray:
    """Tissue that darkens downwards, with white disks (x, y, radius)."""
    image = np.linspace(1.1, 0.7, 240)[:, None, None] * np.ones((1, 320, 1)) * TISSUE
    for x, y, radius in spots:
        disk = cv2.circle(np.zeros((240, 320), np.uint8), (x, y), radius, 1, -1)
        image = image + white * disk[..., None]
    return np.clip(image, 0, 1).astype(np.float32)


def test_a_highlight_is_the_disk_that_was_drawn():
    drawn = picture((100, 80, 4), (200, 160, 2)).max(axis=2) > picture().max(axis=2) + 0.1
    np.testing.assert_array_equal(highlights(picture((100, 80, 4), (200, 160, 2)), WHOLE), drawn)


def test_bright_tissue_larger_than_any_highlight_and_faint_spots_are_none():
    patch = cv2.GaussianBlur(picture((160, 120, 60), white=0.3), (0, 0), 5)
    assert not highlights(patch, WHOLE).any()
    assert not highlights(picture((160, 120, 3), white=0.08), WHOLE).any()


def test_tissue_between_two_holes_is_none_and_a_highlight_there_is_one():
    valid = WHOLE.copy()
    valid[60:180, 100:140] = valid[60:180, 150:190] = False
    assert not highlights(picture(), valid).any()
    assert highlights(picture((145, 120, 2)), valid)[120, 145]


def test_a_red_vein_or_spot_is_none():
    red = picture()
    red[100:104, 50:250, 0] += 0.3
    assert not highlights(red, WHOLE).any()


def test_the_same_highlights_a_few_pixels_aside_are_alike_in_every_respect():
    spots = (100, 80, 4), (200, 160, 2)
    aside = [(x + NEAR_PX - 1, y, radius) for x, y, radius in spots]
    alike = Alike.of(picture(*spots), picture(*aside), WHOLE)
    assert (alike.precision, alike.recall, alike.sizes) == (1, 1, 0)


def test_precision_and_recall_are_shares_of_the_area():
    photo, render = picture((60, 80, 4), (200, 160, 4)), picture((60, 80, 4), (280, 40, 4), (120, 200, 4))
    alike = Alike.of(photo, render, WHOLE)
    assert alike.precision == pytest.approx(1 / 3) and alike.recall == pytest.approx(1 / 2)


def test_the_distance_of_sizes_is_in_doublings_of_the_area():
    one, other = picture((100, 80, 3)), picture((200, 160, 6))
    areas = [np.count_nonzero(highlights(each, WHOLE)) for each in (one, other)]
    assert Alike.of(one, other, WHOLE).sizes == pytest.approx(np.log2(areas[1] / areas[0]))


def test_without_highlights_there_is_nothing_to_compare_and_all_is_dull():
    alike = Alike.of(picture(), picture(), WHOLE)
    assert np.isnan([alike.precision, alike.recall, alike.sizes]).all() and alike.dull.all()


def test_dull_are_the_pixels_off_the_highlights_of_either():
    dull = Alike.of(picture((60, 80, 4)), picture((200, 160, 4)), WHOLE).dull
    assert not dull[80, 60] and not dull[160, 200] and not dull[80, 60 + 4 + NEAR_PX] and dull[80, 130]
