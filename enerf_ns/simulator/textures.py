"""Grey procedural textures, made from a seed: float32 [SIZE, SIZE], 0 where they are darkest, 1 where brightest."""

from __future__ import annotations

import string

import cv2
import numpy as np

SIZE = 1024
"""Texels along one side of every texture."""
TEXELS_PER_METRE = 256


def plain() -> np.ndarray:
    """No texture at all."""
    return np.ones((SIZE, SIZE), np.float32)


def clouds(rng: np.random.Generator, coarsest: float = 1.0, finest: float = 0.1) -> np.ndarray:
    """Noise with a 1/f spectrum between two wavelengths in metres; all grey levels are equally frequent."""
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(SIZE) * TEXELS_PER_METRE]))
    band = np.where((frequency >= 1 / coarsest) & (frequency <= 1 / finest), 1.0, 0.0)
    spectrum = np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * band / np.maximum(frequency, 1e-6)
    noise = np.fft.ifft2(spectrum).real
    levels = np.empty(noise.size, np.float32)
    levels[np.argsort(noise, axis=None)] = np.linspace(0, 1, noise.size)
    return levels.reshape(noise.shape)


def mosaic(rng: np.random.Generator, cell: float = 0.2) -> np.ndarray:
    """Square tiles of `cell` metres, each with a random grey level."""
    texels = round(cell * TEXELS_PER_METRE)
    tiles = rng.uniform(size=2 * [-(-SIZE // texels)])
    return np.kron(tiles, np.ones((texels, texels)))[:SIZE, :SIZE].astype(np.float32)


def bricks(rng: np.random.Generator, width: float = 0.5, height: float = 0.25, joint: float = 0.03) -> np.ndarray:
    """Bricks of random grey levels with dark joints, every second row shifted by half a brick."""
    w, h, j = (round(x * TEXELS_PER_METRE) for x in (width, height, joint))
    image = np.zeros((SIZE, SIZE), np.float32)
    for row, top in enumerate(range(0, SIZE, h)):
        for left in range(-(row % 2) * w // 2, SIZE, w):
            image[top : top + h - j, max(left, 0) : max(left + w - j, 0)] = rng.uniform(0.3, 1)
    return image


def lines(rng: np.random.Generator, count: int = 30, background: float = 0.35) -> np.ndarray:
    """Straight bright and dark strokes of random width, as roads on a map."""
    image = np.full((SIZE, SIZE), background, np.float32)
    for _ in range(count):
        ends = rng.integers(-SIZE // 4, SIZE + SIZE // 4, (2, 2))
        grey, width = float(rng.choice([0.0, 0.7, 1.0])), int(rng.integers(8, 32))
        for shift in np.ndindex(3, 3):  # what leaves at one border comes in at the opposite one
            start, end = ends + SIZE * (np.array(shift) - 1)
            cv2.line(image, start.tolist(), end.tolist(), (grey,), width, cv2.LINE_AA)
    return image


def text(rng: np.random.Generator, line_height: float = 0.2, background: float = 1.0) -> np.ndarray:
    """Rows of random capital letters, dark on bright."""
    image = np.full((SIZE, SIZE), background, np.float32)
    step = round(line_height * TEXELS_PER_METRE)
    for baseline in range(step, SIZE + step, step):
        row = "".join(rng.choice(list(string.ascii_uppercase + "   "), 64))
        cv2.putText(image, row, (-8, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.028 * step, (0.0,), step // 8, cv2.LINE_AA)
    return image


def mip_pyramid(image: np.ndarray) -> np.ndarray:
    """All levels of a texture in one row, finest first, each the mean of 2 x 2 texels of the one before.

    Args:
        image: float32 [SIZE, SIZE].

    Returns:
        float32 [(4 * SIZE**2 - 1) / 3].
    """
    levels = [image.astype(np.float32)]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2).mean((1, 3)))
    return np.concatenate([level.ravel() for level in levels])
