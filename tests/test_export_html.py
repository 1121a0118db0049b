"""The page that shows a twin in a browser: what it draws, drawn by a browser."""

import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_twin

from endotwin.cameras import Pinhole
from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.offset import Offset
from endotwin.effects.profile import Profile
from endotwin.effects.tone import Tone
from endotwin.effects.vignetting import Vignetting
from endotwin.evaluation.metrics import psnr
from endotwin.export import export
from endotwin.synth.trajectories.recorded import path_or_flight

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
SIZE = (320, 240)
GUIDES = ((3.24, 0.55, 0.0), (-2.77, 2.66, 0.0), (-1.27, -3.14, 0.0))
QUIET = [
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--force-device-scale-factor=1", "--virtual-time-budget=10000", "--timeout=60000",
]  # fmt: skip


@pytest.fixture(scope="module")
def twin():
    made = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    return replace(made, camera=Pinhole(*SIZE, 190.0, 190.0, 150.0, 125.0))


def drawn(page, address, folder):
    """What the browser shows of a page, RGB in [0, 1]."""
    command = [
        BROWSER,
        *QUIET,
        f"--user-data-dir={folder / 'browser'}",
        f"--screenshot={folder / 'seen.png'}",
    ]
    command += [f"--window-size={SIZE[0]},{SIZE[1]}", f"file://{page}{address}"]
    subprocess.run(command, capture_output=True, check=True, timeout=120)
    return cv2.imread(str(folder / "seen.png"))[..., ::-1] / 255


def test_a_page_needs_nothing_but_itself(twin, tmp_path):
    export(twin, tmp_path / "view.html")
    text = (tmp_path / "view.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|\bsrc=|\bhref=|@import|\bimport\b.*from", text)
    assert len(text) < 15e6


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium")
@pytest.mark.parametrize(
    "effects",
    [(), (Offset(GUIDES), Coat(2.0, 0.15)), (Vignetting(-0.4, 0.1), Profile(1.0), Tone(0.4))],
    ids=["plain", "guides and coat", "vignetting, profile and tone"],
)
def test_a_browser_shows_what_the_twin_shows_at_the_lens(twin, tmp_path, effects):
    twin = replace(twin, effects=Effects(effects))
    export(twin, tmp_path / "view.html")
    pose = path_or_flight(twin)[1]
    view = twin.render(pose)
    assert psnr(drawn(tmp_path / "view.html", "#along=1&bare", tmp_path), view.color, view.mask) > 36
    other = replace(twin, materials=replace(twin.materials, diffuse="lambert"))
    export(other, tmp_path / "other.html")
    seen = drawn(tmp_path / "other.html", "#along=1&bare", tmp_path)
    assert psnr(seen, other.render(pose).color, view.mask) > 36
    assert np.abs(seen - view.color)[view.mask].mean() > 0.001
