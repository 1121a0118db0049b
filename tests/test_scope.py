"""The view through the scope: what it shows, and what knobs, switches and moves do to it."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.offset import Offset
from endotwin.errors import OptionError
from endotwin.evaluation.metrics import psnr
from endotwin.look import inspector
from endotwin.look.scope import QUICK_PX, Scope
from endotwin.look.scopepane import SWITCH_PX
from endotwin.pipeline import synthesize
from endotwin.render import Renderer
from endotwin.sequence.poses import read_poses
from endotwin.twin import Light, Source, Twin


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """A fitted twin whose photos are its own renderings, every eighth held out."""
    folder = tmp_path_factory.mktemp("scope") / "photos"
    made = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    synthesize(made, np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.6, 10)]), folder)
    return replace(made, source=Source(str(folder), "c3vd"))


def test_the_scope_shows_the_twins_own_view_and_the_photo_beside_it(twin):
    scope = Scope(twin)
    scope.go_to(3)
    np.testing.assert_array_equal(scope.view().color, Renderer(twin).view(scope.pose).color)
    photo = scope.photo()
    assert psnr(photo / 255, scope.view().color, scope.view().mask) > 45
    scope.move(ahead_mm=0.5)
    assert scope.photo() is None


def test_the_picture_has_the_view_above_photo_render_and_error(twin):
    scope = Scope(twin)
    scope.go_to(8)
    size = (480, 640)
    picture = scope.picture(size).astype(float)
    assert picture.shape == (640, 480, 3)
    top, left, tall, wide = scope.place(size)
    whole = cv2.resize(scope.view().color * 255, (wide, tall))
    assert np.abs(picture[top : top + tall, left : left + wide] - whole).mean() < 1
    strip = picture[top + tall + 26 :]
    (third,) = {480 // 3}
    tiles = [strip[5:80, column * third + 5 : (column + 1) * third - 5] for column in range(3)]
    assert np.abs(tiles[0] - tiles[1]).mean() < 2 < tiles[0].std()
    assert tiles[2].mean() < 10
    scope.turn_knob("exposure", 2.0)
    brighter = scope.picture(size).astype(float)[top + tall + 26 :]
    assert brighter[5:80, 2 * third + 5 : -5].mean() > 35


def test_knobs_do_to_the_view_what_the_model_says(twin):
    scope = Scope(twin)
    scope.go_to(2)
    before = scope.view()
    scope.turn_knob("exposure", 1.5)
    np.testing.assert_allclose(scope.view().radiance, 1.5 * before.radiance, rtol=1e-5)
    scope.turn_knob("exposure", 1.0)
    scope.turn_knob("intensity", 0.5)
    scope.turn_knob("n", 3.0)
    expected = replace(twin, light=Light(0.5 * twin.light.L0, 3.0, twin.light.q))
    np.testing.assert_allclose(scope.view().radiance, Renderer(expected).view(scope.pose).radiance, rtol=1e-5)
    for name, knob in scope.knobs.items():
        scope.turn_knob(name, knob.value)
    np.testing.assert_allclose(scope.view().radiance, before.radiance, rtol=1e-5)
    scope.turn_knob("q", 2.4)
    ratio = scope.view().radiance[before.mask] / before.radiance[before.mask]
    assert ratio.min() < 1 < ratio.max()
    assert np.median(ratio) == pytest.approx(1, abs=0.3)


def test_effects_are_switched_off_and_on_and_have_a_price(twin):
    wet = replace(twin, effects=Effects([Offset(((3.0, 0.0, 0.0),)), Coat(3.0, 0.1)]))
    scope = Scope(wet)
    whole = scope.view().color
    scope.switch("coat", False)
    dry = replace(twin, effects=Effects([Offset(((3.0, 0.0, 0.0),))]))
    np.testing.assert_array_equal(scope.view().color, Renderer(dry).view(scope.pose).color)
    scope.switch("offset", False)
    np.testing.assert_array_equal(scope.view().color, Renderer(twin).view(scope.pose).color)
    scope.switch("coat", True)
    scope.switch("offset", True)
    np.testing.assert_array_equal(scope.view().color, whole)
    prices = scope.prices()
    assert set(prices) == {"offset", "coat"} and all(price >= 0 for price in prices.values())
    with pytest.raises(OptionError, match="offset, coat"):
        scope.switch("shadows", True)


def test_moves_and_turns_are_along_the_scopes_own_axes(twin):
    scope = Scope(twin)
    scope.go_to(4)
    start = scope.pose
    scope.move(right_mm=1.0, down_mm=2.0, ahead_mm=3.0)
    np.testing.assert_allclose(start[:3, :3].T @ (scope.pose - start)[:3, 3], [1, 2, 3], atol=1e-9)
    scope.go_to(4)
    scope.turn(right=0.1)
    ahead = start[:3, :3].T @ scope.pose[:3, 2]
    np.testing.assert_allclose(ahead, [np.sin(0.1), 0, np.cos(0.1)], atol=1e-9)
    scope.go_to(4)
    scope.turn(down=0.1)
    np.testing.assert_allclose(start[:3, :3].T @ scope.pose[:3, 2], [0, np.sin(0.1), np.cos(0.1)], atol=1e-9)
    scope.go_to(1)
    scope.step(1, heldout=True)
    assert scope.frame == 8
    scope.step(2)
    assert scope.frame == 0


def test_a_view_while_the_scope_moves_is_small(twin):
    large = replace(twin, camera=twin.camera.scaled(10))
    large = replace(large, source=Source("nowhere", "c3vd"))
    scope = Scope(large)
    height, width, _ = scope.view(quick=True).color.shape
    assert 0.03 * QUICK_PX < height * width <= 1.05 * QUICK_PX
    assert scope.view().color.shape == (720, 960, 3)


def test_a_point_is_known_by_its_maps_and_by_every_photo_that_sees_it(twin):
    scope = Scope(twin)
    scope.go_to(5)
    view = scope.view()
    row, column = 20, 60
    probe = scope.probe((column + 0.5) / 96, (row + 0.5) / 72)
    np.testing.assert_allclose(probe.base_color, view.albedo[row, column], atol=1e-6)
    camera_point = twin.camera.pixel_directions[row, column] * probe.distance_mm
    np.testing.assert_allclose(camera_point[2], view.depth_mm[row, column], rtol=1e-5)
    world = scope.pose[:3, :3] @ camera_point + scope.pose[:3, 3]
    np.testing.assert_allclose(probe.point_mm, world, atol=1e-3)
    np.testing.assert_allclose(probe.normal @ scope.pose[:3, :3], view.normals[row, column], atol=1e-5)
    assert 5 in probe.frames and len(probe.frames) >= 4
    assert np.abs(probe.photos - probe.renders).max() < 0.02
    assert len(probe.lines()) == 4 + len(probe.frames)


def test_a_screenshot_shows_the_scopes_pane_without_a_display(twin, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    inspector.inspect(twin, tmp_path / "scope.png", map="scope")
    picture = cv2.imread(str(tmp_path / "scope.png"))
    assert picture.shape == (2 * inspector.TILE[1], inspector.TILE[0], 3)
    with pytest.raises(OptionError, match="not fitted"):
        inspector.inspect(tube_twin.unfitted(twin), tmp_path / "none.png", map="scope")


class Window:
    """The inspector's window on a screen of its own, and the hand that works it."""

    def __init__(self, twin_folder: Path, folder: Path, screen: str):
        self.folder = folder
        read, write = os.pipe()
        command = ["Xvfb", "-displayfd", str(write), "-noreset", "-screen", "0", f"{screen}x24"]
        self.server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as told:
            self.environment = {**os.environ, "DISPLAY": f":{told.readline().strip()}"}
        self.environment.pop("WAYLAND_DISPLAY", None)
        shown = "from endotwin.cli.start import main; main()"
        command = [sys.executable, "-c", shown, "inspect", twin_folder, "--keyframes", folder / "keys.txt"]
        self.inspector = subprocess.Popen(command, env=self.environment)
        self.id = self.until(lambda: self.tool("search", "--name", "^endotwin$", check=False).strip())
        time.sleep(5)  # until it listens

    def tool(self, *words, check=True) -> str:
        done = subprocess.run(
            ["xdotool", *map(str, words)], env=self.environment, capture_output=True, text=True, check=check
        )
        return done.stdout

    def until(self, found, seconds: float = 90):
        """What ``found`` returns as soon as that is something."""
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            if result := found():
                return result
            time.sleep(0.3)
        raise AssertionError("the window did not answer")

    def press(self, key: str) -> None:
        self.tool("key", "--window", self.id, key)

    def picture(self) -> np.ndarray:
        """What the key x saves."""
        before = set(self.folder.glob("scope-*.png"))
        self.press("x")
        self.until(lambda: set(self.folder.glob("scope-*.png")) - before)
        return cv2.imread(str(max(self.folder.glob("scope-*.png")))).astype(float)

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> None:
        middle = [(a + b) // 2 for a, b in zip(start, end, strict=True)]
        for words in (
            ("mousemove", "--window", self.id, *start),
            ("mousedown", 1),
            ("mousemove", "--window", self.id, *middle),
            ("mousemove", "--window", self.id, *end),
            ("mouseup", 1),
        ):
            self.tool(*words)
            time.sleep(0.3)

    def click(self, place: tuple[int, int]) -> None:
        self.tool("mousemove", "--window", self.id, *place)
        time.sleep(0.3)
        self.tool("click", 1)
        time.sleep(0.3)

    def size(self) -> tuple[int, int]:
        told = self.tool("getwindowgeometry", "--shell", self.id)
        values = dict(line.split("=") for line in told.split())
        return int(values["WIDTH"]), int(values["HEIGHT"])

    def close(self) -> None:
        for process in (self.inspector, self.server):
            process.kill()
            process.wait(20)


needs_a_screen = pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="there is no Xvfb and xdotool"
)


@pytest.fixture
def window(twin, tmp_path):
    opened = []

    def open_window(screen: str, shown: Twin = twin) -> Window:
        shown.save(tmp_path / "twin")
        opened.append(Window(tmp_path / "twin", tmp_path, screen))
        return opened[-1]

    yield open_window
    for each in opened:
        each.close()


@pytest.mark.slow
@needs_a_screen
def test_keys_mouse_and_sliders_of_a_real_window_fly_and_light_the_scope(window, twin):
    shown = window("1600x1200")
    first = shown.picture()
    scope = Scope(twin)
    np.testing.assert_allclose(first[..., ::-1], scope.view().color * 255, atol=1)
    shown.press("period")
    scope.step(1)
    np.testing.assert_allclose(shown.picture()[..., ::-1], scope.view().color * 255, atol=1)
    shown.press("Up")
    shown.press("k")
    keys = shown.folder / "keys.txt"
    shown.until(keys.exists)
    (pose,), _ = read_poses(keys)
    flown = scope.pose[:3, :3].T @ (pose[:3, 3] - scope.pose[:3, 3])
    assert flown[2] > 0.1 and np.abs(flown[:2]).max() < 1e-6
    before = shown.picture()
    width, height = shown.size()
    knob = (int(0.4 * width * 0.152), int(height * 0.85))  # of the light: at 1
    shown.drag(knob, (knob[0] + width // 20, knob[1]))
    lit = shown.picture()
    assert lit.mean() > before.mean() + 10
    pane = (int(0.7 * width), int(0.3 * height))
    shown.drag(pane, (pane[0] + 60, pane[1]))
    assert np.abs(shown.picture() - lit).mean() > 3
    assert shown.inspector.poll() is None


@pytest.mark.slow
@needs_a_screen
def test_a_click_on_a_switch_of_a_real_window_takes_its_effect_from_the_view_and_gives_it_back(window, twin):
    offset, coat = Offset(((3.0, 0.0, 0.0),)), Coat(3.0, 0.1)
    shown = window("1600x1200", replace(twin, effects=Effects([offset, coat])))
    pose = Scope(twin).pose

    def agrees(*effects) -> None:
        expected = Renderer(replace(twin, effects=Effects(effects))).view(pose).color * 255
        np.testing.assert_allclose(shown.picture()[..., ::-1], expected, atol=1)

    _, height = shown.size()
    switches = {
        name: (12 + SWITCH_PX // 2, round(0.58 * height - (1.5 * row + 0.5) * SWITCH_PX))
        for row, name in enumerate(("offset", "coat"))
    }
    agrees(offset, coat)
    shown.click(switches["coat"])
    agrees(offset)
    shown.click(switches["offset"])
    agrees()
    shown.click(switches["coat"])
    agrees(coat)
    shown.click(switches["offset"])
    agrees(offset, coat)


@pytest.mark.slow
@needs_a_screen
@pytest.mark.parametrize("screen", ["800x600", "1366x768", "1080x1920"])
def test_a_real_window_fits_its_screen(window, screen):
    width, height = window(screen).size()
    room = [int(edge) for edge in screen.split("x")]
    assert 0.5 * min(room) < width <= room[0] and 0.5 * min(room) < height <= room[1]


@pytest.mark.slow
@needs_a_screen
def test_a_window_closes_on_ctrl_c(window):
    shown = window("800x600")
    shown.inspector.send_signal(signal.SIGINT)
    assert shown.inspector.wait(20) == 130
