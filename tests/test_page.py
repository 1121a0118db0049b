"""The exported page in a browser: sliders, fingers and mouse do to its picture what the model says."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin
from browser import PROGRAM, Page

from endotwin.cameras import Pinhole
from endotwin.evaluation.metrics import psnr
from endotwin.export import export
from endotwin.light import shading
from endotwin.synth.trajectories.recorded import path_or_flight

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium")]

DESK, PHONE = ((900, 700), None), ((390, 844), 2.0)


@pytest.fixture(scope="module")
def twin():
    made = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    bright = replace(made.light, L0=15 * made.light.L0)
    return replace(made, light=bright, camera=Pinhole(320, 240, 190.0, 190.0, 150.0, 125.0))


@pytest.fixture(params=[DESK, PHONE], ids=["desk", "phone"])
def page(request, twin, tmp_path):
    export(twin, tmp_path / "view.html")
    shown = Page(f"file://{tmp_path / 'view.html'}#along=1", tmp_path, *request.param)
    shown.run("document.getElementById('panel').open = true")
    yield shown
    shown.close()


def moved(page, words, value):
    """Drag, or swipe, a slider's knob to ``value``; what it says then."""
    (left, top), length, low, high = page.slider(words)
    name, now = page.run(
        f"""(() => {{
        const named = each => each[1].parentElement.innerText.includes("{words}");
        const [name] = Object.entries(outputs).find(named);
        return [name, state[name]]; }})()"""
    )
    hand = (lambda *way: page.swipe(way)) if page.phone else page.drag
    knob = 16  # px: its centre goes from half of it to the length less half of it
    at = [left + knob / 2 + (length - knob) * (each - low) / (high - low) for each in (now, value)]
    hand((at[0], top), (at[1], top))
    return page.run(f"state.{name}")


def linear(picture, gamma):
    return shading.radiance_of(picture, gamma)


def test_the_light_slider_multiplies_all_light(page, twin):
    before = page.canvas()
    factor = moved(page, "light ×", 0.5)
    assert 0.4 < factor < 0.6
    after = page.canvas()
    seen = (before > 0.3) & (before < 0.99)
    assert seen.mean() > 0.05
    ratio = linear(after, twin.response.gamma)[seen] / linear(before, twin.response.gamma)[seen]
    assert np.median(ratio) == pytest.approx(factor, rel=0.01)
    assert np.quantile(np.abs(ratio / factor - 1), 0.95) < 0.05


def test_the_roughness_slider_shows_what_the_twin_shows_with_that_roughness(page, twin):
    before = page.canvas()
    factor = moved(page, "roughness ×", 0.4)
    assert 0.3 < factor < 0.5
    after = page.canvas()
    rough = np.clip(factor * twin.materials.roughness, 0, 1)
    smooth = replace(twin, materials=replace(twin.materials, roughness=rough))
    pose, (height, width) = path_or_flight(twin)[1], after.shape[:2]
    scale = min(width / 320, height / 240)
    left, top = (width - 320 * scale) / 2, (height - 240 * scale) / 2
    lens = Pinhole(
        width, height, 190 * scale, 190 * scale, 150.5 * scale - 0.5 + left, 125.5 * scale - 0.5 + top
    )
    inside = np.zeros((height, width), bool)
    inside[int(top) + 2 : int(top + 240 * scale) - 2, int(left) + 2 : int(left + 320 * scale) - 2] = True
    for shown, expected in ((before, twin), (after, smooth)):
        view = expected.render(pose, lens)
        assert psnr(shown, view.color, view.mask & inside) > 34
    view = twin.render(pose, lens)
    assert psnr(after, view.color, view.mask & inside) < psnr(before, view.color, view.mask & inside) - 3


def test_a_finger_or_the_mouse_looks_about_and_two_fingers_go_ahead(page):
    before = page.run("camera.turn.slice()")
    width, height = page.run("[innerWidth, innerHeight]")
    start, end = (width * 0.5, height * 0.2), (width * 0.5 + 60, height * 0.2)
    page.swipe((start, end)) if page.phone else page.drag(start, end)
    after = page.run("camera.turn.slice()")
    angle = np.arccos(np.clip(np.dot(before[6:], after[6:]), -1, 1))
    assert angle == pytest.approx(0.004 * 60, rel=0.2)
    if page.phone:
        centre = np.array(page.run("camera.centre"))
        ahead = np.array(page.run("column(2)"))
        spread = ((width * 0.5 - 20, 200.0), (width * 0.5 - 60, 200.0))
        page.swipe(spread, ((width * 0.5 + 20, 200.0), (width * 0.5 + 60, 200.0)))
        step = np.array(page.run("camera.centre")) - centre
        assert step @ ahead == pytest.approx(0.05 * 80, rel=0.2)


def test_reset_brings_back_the_first_picture(page):
    before = page.canvas()
    moved(page, "light ×", 2.0)
    assert np.abs(page.canvas() - before).mean() > 0.01
    page.run("document.getElementById('reset').click()")
    page.run("set('along', 1); follow(); draw()")
    np.testing.assert_array_equal(page.canvas(), before)
