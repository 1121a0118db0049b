"""Effects as strong as another recording shows them."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_sequence
import tube_twin

import endotwin
from endotwin.effects import Effects, parse_states
from endotwin.effects.codec import Codec
from endotwin.effects.interlacing import Interlacing
from endotwin.effects.noise import Noise
from endotwin.effects.overlay import Overlay
from endotwin.errors import OptionError, SequenceError
from endotwin.synth import equipped

SIGMA = 4 / 255


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A sequence whose photos have noise of 4 levels."""
    folder = tube_sequence.write(tmp_path_factory.mktemp("noisy") / "tube", 6, 160, 120)
    rng = np.random.default_rng(0)
    for file in folder.glob("*color.png"):
        photo = cv2.imread(str(file)).astype(float)
        cv2.imwrite(
            str(file), np.clip(photo + 255 * SIGMA * rng.standard_normal(photo.shape), 0, 255).round()
        )
    return folder


@pytest.fixture(scope="module")
def twin():
    return tube_twin.fitted(tube_twin.seen(tube_twin.surface()))


def test_noise_is_on_and_as_strong_as_in_the_other_recording(twin, noisy, caplog):
    effects = equipped(twin, {"like": str(noisy)}, "").effects
    assert effects["noise"].sigma(0.5) == pytest.approx(SIGMA, rel=0.2)
    assert "codec" not in effects
    (told,) = caplog.messages
    assert "tell of noise; of" in told and "codec, " in told.split("; of")[1]
    assert "noise" not in equipped(twin, {"like": str(noisy), "noise": "off"}, "").effects


def test_a_recording_of_jpeg_files_is_coded_as_they_are(twin, noisy, tmp_path):
    folder = tmp_path / "coded"
    shutil.copytree(noisy, folder)
    for file in folder.glob("*color.png"):
        photo = cv2.imread(str(file))
        file.unlink()
        cv2.imwrite(str(file.with_suffix(".jpg")), photo, [cv2.IMWRITE_JPEG_QUALITY, 40])
    assert equipped(twin, {"like": str(folder)}, "").effects["codec"] == Codec(40)


def test_jpeg_photos_kept_as_png_are_coded_as_they_were(twin, noisy, tmp_path):
    folder = shutil.copytree(noisy, tmp_path / "kept")
    for file in folder.glob("*color.png"):
        options = [cv2.IMWRITE_JPEG_QUALITY, 40]
        coded = cv2.imencode(".jpg", cv2.imread(str(file)), options)[1]
        cv2.imwrite(str(file), cv2.imdecode(coded, cv2.IMREAD_COLOR))
    assert equipped(twin, {"like": str(folder)}, "").effects["codec"].quality == pytest.approx(40, abs=1)


def test_corners_are_as_in_the_other_recording(twin, noisy, tmp_path):
    folder = shutil.copytree(noisy, tmp_path / "cornered")
    for file in folder.glob("*color.png"):
        photo = cv2.imread(str(file)).astype(np.float32) / 255
        cv2.imwrite(str(file), 255 * Overlay(0.25, letters=0.0).recorded(photo))
    effects = equipped(twin, {"like": str(folder)}, "").effects
    assert effects["overlay"].corner == pytest.approx(0.25, abs=1 / 120) and effects["overlay"].letters == 0
    assert "lens" not in effects and "processor" not in effects


def test_what_needs_a_velocity_is_left_out_of_poses_that_have_none(twin, noisy, monkeypatch):
    monkeypatch.setattr(Interlacing, "evidence", classmethod(lambda cls, sequence: (cls(), "combed")))
    assert "interlacing" in equipped(twin, {"like": str(noisy)}, "path.txt").effects
    assert "interlacing" not in equipped(twin, {"like": str(noisy)}, "jitter:frames=2").effects


def test_it_takes_the_place_of_the_twins_own(twin, noisy):
    loud = replace(twin, effects=Effects([Noise(0.1)]))
    assert equipped(loud, {"like": str(noisy)}, "").effects["noise"].sigma(0.5) < 0.03
    assert equipped(loud, {}, "").effects["noise"] == Noise(0.1)


def test_the_dataset_has_it_and_names_no_path(twin, noisy, tmp_path):
    states = parse_states(f"like={noisy}", like=True)
    poses = np.stack([tube_twin.pose(0.5)])
    endotwin.synthesize(twin, poses, tmp_path / "d", effects=states)
    text = (tmp_path / "d" / "dataset.json").read_text()
    assert '"noise"' in text and str(noisy) not in text


def test_it_is_for_synth_alone_and_needs_a_sequence(twin, tmp_path):
    with pytest.raises(OptionError, match="like=x"):
        parse_states("like=x")
    with pytest.raises(SequenceError, match="nowhere"):
        equipped(twin, {"like": str(tmp_path / "nowhere")}, "")
