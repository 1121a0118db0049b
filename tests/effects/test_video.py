"""The recorder of clips: what H.264 keeps at a bitrate; labels, workers and pauses know nothing of it."""

import sys
from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
import tube_twin
from recording import change_of_rgb_alone

import endotwin
import endotwin.synth
from endotwin.effects import Effects
from endotwin.effects.video import CLIP_FRAMES, Clip, Video, _av, _encoder
from endotwin.errors import OptionError
from endotwin.synth.trajectories.trajectory import Trajectory

needs_av = pytest.mark.skipif(find_spec("av") is None, reason="PyAV is not installed")


def pictures(count: int, width: int = 128, height: int = 96) -> np.ndarray:
    """Blurred noise that moves 2 px a frame, float32 [count, H, W, 3]."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.random((height, width + 2 * count, 3)), (0, 0), 3)
    wide = cv2.normalize(wide, None, 0.05, 0.95, cv2.NORM_MINMAX).astype(np.float32)
    return np.stack([wide[:, 2 * k : 2 * k + width] for k in range(count)])


def played(images: np.ndarray, bitrate: float) -> np.ndarray:
    clip = Clip()
    return np.stack([clip.recorded(image, Video(bitrate)) for image in images])


@needs_av
def test_more_bits_are_less_error_and_no_picture_comes_late():
    images = pictures(30)
    shown = {bitrate: played(images, bitrate) for bitrate in (0.05, 0.1, 20.0)}
    grey = {bitrate: (found - images).mean(axis=3) for bitrate, found in shown.items()}
    errors = [np.sqrt(np.mean(grey[bitrate] ** 2)) for bitrate in shown]
    assert errors[0] > 1.15 * errors[1] > 1.15**2 * errors[2]
    assert errors[2] < 0.01
    off = [np.abs(shown[20.0][k] - images[10]).mean() for k in (9, 10, 11)]
    assert np.argmin(off) == 1


@needs_av
def test_a_clip_has_the_bits_that_it_was_given():
    av, video = _av(), Video(0.5)
    rng = np.random.default_rng(0)
    encoder, sizes = _encoder(av, video, (96, 128, 3)), []
    for k in range(CLIP_FRAMES):
        noisy = rng.integers(0, 255, (96, 128, 3), np.uint8)
        picture = av.VideoFrame.from_ndarray(noisy, format="rgb24").reformat(format="yuv420p")
        picture.pts = k
        (packet,) = encoder.encode(picture)
        sizes.append(8e-6 * packet.size)
    assert sum(sizes) / (CLIP_FRAMES / 30) == pytest.approx(video.bitrate, rel=0.25)


@needs_av
def test_a_picture_is_made_from_those_before_it_and_the_same_clip_is_the_same_twice():
    images = pictures(4)
    np.testing.assert_array_equal(played(images, 0.2), played(images, 0.2))
    assert np.abs(played(images, 0.2)[3] - played(images[3:], 0.2)[0]).max() > 1 / 255


@needs_av
def test_a_picture_of_odd_size_keeps_its_size_and_its_edge():
    images = pictures(2, 67, 55)
    shown = played(images, 20.0)
    assert shown.shape == images.shape
    assert np.abs(shown[:, -1] - images[:, -1]).mean() < 0.05


@needs_av
def test_rgb_alone_is_recorded_and_the_labels_hold(tmp_path):
    assert 0.3 < change_of_rgb_alone(tmp_path, [Video(0.2)]) < 40


@needs_av
@pytest.mark.slow
def test_workers_and_a_pause_between_clips_change_no_byte(tmp_path, monkeypatch):
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    twin = replace(twin, effects=Effects([Video(0.2)]))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.4, 0.6, CLIP_FRAMES + 5)])
    trajectory = Trajectory(poses, np.arange(len(poses)) / 30, "a way")

    def files(name: str, workers: int) -> dict[str, bytes]:
        endotwin.synth.synthesize(twin, trajectory, tmp_path / name, labels=("rgb",), workers=workers)
        return {file.name: file.read_bytes() for file in (tmp_path / name).glob("*color.png")}

    def stop(label: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        endotwin.synth.synthesize(twin, trajectory, tmp_path / "paused", labels=("rgb",), progress=stop)
    one = files("one", 1)
    assert one == files("two", 2) == files("paused", 1)


def test_without_pyav_one_sentence_says_what_to_install_and_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    twin = replace(twin, effects=Effects([Video()]))
    with pytest.raises(OptionError, match=r"pip install 'endotwin\[video\]'"):
        endotwin.synthesize(twin, tube_twin.pose(0.5)[None], tmp_path / "dataset")
    assert not list(tmp_path.iterdir())
