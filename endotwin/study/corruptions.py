"""What goes wrong with endoscopic photos, in five severities: what depth networks are judged by.

The sixteen of *EndoscopyCorruptions* (Reyes-Amezcua et al. 2024), with which the benchmark EndoDepth makes
SCARED-C, and the codec of *imagecorruptions* (Michaelis et al. 2019, after Hendrycks & Dietterich 2019), from
which ten of the sixteen come. Strengths are theirs, for photos about 320 pixels wide. Written anew, without
global random numbers, with three differences: fog is a sum of octaves of noise instead of diamonds and
squares; the pixels of a glass blur are displaced at once instead of one after the other; and the lens
distortion is about the image's centre, where theirs mistakes rows for columns. Depth stays as it is, lens
distortion included.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

SEVERITIES = (1, 2, 3, 4, 5)

Corruption = Callable[[np.ndarray, int, np.random.Generator], np.ndarray]


def corrupted(photo: np.ndarray, name: str, severity: int, seed: int) -> np.ndarray:
    """The photo uint8 [H, W, 3] with a corruption of ``CORRUPTIONS``, severity 1 … 5, uint8 [H, W, 3].

    The same for the same seed, which is that of noise, directions and places.
    """
    image = CORRUPTIONS[name](photo.astype(np.float32) / 255, severity - 1, np.random.default_rng(seed))
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


# Each takes an image float32 [H, W, 3] in [0, 1], the severity from 0, and a generator.


def brightness(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """More value (of hue, saturation, value) everywhere."""
    return _value_added(image, (0.1, 0.2, 0.3, 0.4, 0.5)[level])


def darkness(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Less value (of hue, saturation, value) everywhere."""
    return _value_added(image, (-0.1, -0.2, -0.3, -0.4, -0.5)[level])


def _value_added(image: np.ndarray, value: float) -> np.ndarray:
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 2] = np.clip(hsv[..., 2] + value, 0, 1)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def contrast(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Each channel nearer to its mean."""
    mean = image.mean(axis=(0, 1))
    return mean + (image - mean) * (0.4, 0.3, 0.2, 0.1, 0.05)[level]


def fog(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """White clouds of fractal noise, as smoke and steam."""
    density, decay = ((1.5, 2.0), (2.0, 2.0), (2.5, 1.7), (2.5, 1.5), (3.0, 1.4))[level]
    height, width = image.shape[:2]
    cells, clouds = 2, np.zeros((height, width), np.float32)
    while cells <= max(height, width):
        octave = generator.uniform(-1, 1, (cells + 1, cells + 1)).astype(np.float32)
        clouds += cv2.resize(octave, (width, height)) * np.float32(decay ** -np.log2(cells))
        cells *= 2
    clouds = (clouds - clouds.min()) / np.ptp(clouds)
    most = image.max()
    return (image + density * clouds[..., None]) * most / (most + density)


def defocus_blur(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """A disc instead of each point."""
    radius, soft = ((3, 0.1), (4, 0.5), (6, 0.5), (8, 0.5), (10, 0.5))[level]
    x, y = np.meshgrid(*[np.arange(-max(radius, 8), max(radius, 8) + 1)] * 2)
    disc = cv2.GaussianBlur((x**2 + y**2 <= radius**2).astype(np.float32), (3, 3), soft)
    return cv2.filter2D(image, -1, disc / disc.sum())


def glass_blur(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Each pixel is seen a little beside its place, as through drops and film on the lens."""
    sigma, reach, rounds = ((0.7, 1, 2), (0.9, 2, 1), (1.0, 2, 3), (1.1, 3, 2), (1.5, 4, 2))[level]
    image = cv2.GaussianBlur(image, (0, 0), sigma)
    height, width = image.shape[:2]
    rows, columns = np.indices((height, width))
    for _ in range(rounds):
        dy, dx = generator.integers(-reach, reach, (2, height, width))
        image = image[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
    return cv2.GaussianBlur(image, (0, 0), sigma)


def motion_blur(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """A trail that fades, in a direction within 45° of the horizontal."""
    radius, sigma = ((10, 3), (15, 5), (15, 8), (15, 12), (20, 15))[level]
    steps, angle = np.arange(2 * radius + 1), np.deg2rad(generator.uniform(-45, 45))
    trail = np.exp(-(steps**2) / (2 * sigma**2)).astype(np.float32)
    rows, columns = (np.rint(2 * radius + steps * f(angle)).astype(int) for f in (np.sin, np.cos))
    kernel = np.zeros((4 * radius + 1, 4 * radius + 1), np.float32)
    np.add.at(kernel, (rows, columns), trail / trail.sum())
    return cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)


def zoom_blur(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """The scope moves forwards while the shutter is open."""
    end, step = ((1.11, 0.01), (1.16, 0.01), (1.21, 0.02), (1.26, 0.02), (1.31, 0.03))[level]
    height, width = image.shape[:2]
    centre = ((width - 1) / 2, (height - 1) / 2)
    zooms = np.arange(1, end, step)
    layers = [
        cv2.warpAffine(image, cv2.getRotationMatrix2D(centre, 0, zoom), (width, height)) for zoom in zooms
    ]
    return (image + np.sum(layers, axis=0)) / (len(zooms) + 1)


def gaussian_noise(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Noise of one strength everywhere."""
    return image + generator.normal(scale=(0.08, 0.12, 0.18, 0.26, 0.38)[level], size=image.shape)


def impulse_noise(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Salt and pepper."""
    return _salted(image, (0.03, 0.06, 0.09, 0.17, 0.27)[level], generator)


def _salted(image: np.ndarray, share: float, generator: np.random.Generator) -> np.ndarray:
    """The share of the values that are 0 or 1 instead, as often the one as the other."""
    fate = generator.random(image.shape)
    return np.where(fate < share / 2, 0, np.where(fate < share, 1, image))


def shot_noise(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """So many photons at white."""
    photons = (60, 25, 12, 5, 3)[level]
    return generator.poisson(image * photons) / photons


def iso_noise(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Gaussian noise, and salt and pepper, as of a sensor at high gain."""
    share = (0.01, 0.02, 0.03, 0.04, 0.05)[level]  # of the impulses, and the variance of the noise
    return _salted(image + generator.normal(scale=share**0.5, size=image.shape), share, generator)


def lens_distortion(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Barrel distortion 1 + k·r², r in halves of the image."""
    k = (0.01, 0.02, 0.03, 0.04, 0.05)[level]
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    stretch = 1 + k * (x**2 + y**2)
    u, v = (stretch * x + 1) * (width - 1) / 2, (stretch * y + 1) * (height - 1) / 2
    return cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)


def resolution_change(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Fewer pixels, and as many as before again."""
    factor = (0.5, 0.4, 0.3, 0.2, 0.1)[level]
    height, width = image.shape[:2]
    few = (max(int(width * factor), 1), max(int(height * factor), 1))
    return cv2.resize(cv2.resize(image, few, interpolation=cv2.INTER_AREA), (width, height))


def specular_reflection(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """A brighter patch, a tenth of the image in height and width, somewhere."""
    height, width = (max(side // 10, 1) for side in image.shape[:2])
    row, column = (
        generator.integers(0, side - part + 1)
        for side, part in zip(image.shape[:2], (height, width), strict=True)
    )
    patched = image.copy()
    patched[row : row + height, column : column + width] += (0.1, 0.2, 0.3, 0.4, 0.5)[level]
    return patched


def color_changes(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """Another offset on each channel."""
    strength = (0.1, 0.2, 0.3, 0.4, 0.5)[level]
    return image + strength * (generator.random(3).astype(np.float32) - 0.5)


def jpeg(image: np.ndarray, level: int, generator: np.random.Generator) -> np.ndarray:
    """A lossy codec."""
    return as_jpeg(np.rint(image * 255).astype(np.uint8), (25, 18, 15, 10, 7)[level]) / np.float32(255)


def as_jpeg(photo: np.ndarray, quality: int) -> np.ndarray:
    """The photo uint8 [H, W, 3] after JPEG of the quality 1 … 100, chroma at half size."""
    coded = cv2.imencode(".jpg", photo[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    return cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1]


BENCHMARK: dict[str, Corruption] = {
    function.__name__: function
    for function in (
        brightness,
        darkness,
        contrast,
        fog,
        defocus_blur,
        glass_blur,
        motion_blur,
        zoom_blur,
        gaussian_noise,
        impulse_noise,
        shot_noise,
        iso_noise,
        lens_distortion,
        resolution_change,
        specular_reflection,
        color_changes,
    )
}
"""The sixteen of EndoscopyCorruptions."""

CORRUPTIONS: dict[str, Corruption] = {**BENCHMARK, "jpeg": jpeg}
