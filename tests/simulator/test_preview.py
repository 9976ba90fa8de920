"""The preview, decoded again by OpenCV."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.simulator.preview import NO_COLOUR, OFF_COLOUR, ON_COLOUR, Preview

WIDTH, HEIGHT = 64, 48


def decode(path: Path) -> tuple[np.ndarray, float]:
    """All pictures as R G B, [pictures, height, width, 3], and how many are shown a second."""
    video = cv2.VideoCapture(str(path))
    pictures = []
    while True:
        read, picture = video.read()
        if not read:
            return np.array(pictures)[..., ::-1], video.get(cv2.CAP_PROP_FPS)
        pictures.append(picture)


def block(x: int, y: int, polarity: int) -> Events:
    """Events of 16 x 16 pixels."""
    rows, columns = np.mgrid[y : y + 16, x : x + 16].reshape(2, -1)
    return Events(columns, rows, np.zeros(256, np.int64), np.full(256, polarity))


def colour_at(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """Mean of the middle of the block that begins there."""
    return picture[int(y) + 4 : int(y) + 12, int(x) + 4 : int(x) + 12].reshape(-1, 3).mean(0)


def test_each_picture_shows_its_frame_blurred_frame_events_and_depth(tmp_path: Path):
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, 32:] = 4.0
    depth[32:, 32:] = 0
    with Preview(tmp_path / "preview.mp4", WIDTH, HEIGHT) as preview:
        for number in range(5):
            if number == 1:
                preview.add_events(block(16, 0, 1))
                preview.add_events(block(0, 16, 1))
                preview.add_events(block(0, 16, -1))
            grey = np.full((HEIGHT, WIDTH), 40 * number, np.uint8)
            preview.add_frame(grey, 255 - grey, depth)
    pictures, rate = decode(tmp_path / "preview.mp4")
    assert pictures.shape == (5, HEIGHT, 4 * WIDTH, 3) and rate == pytest.approx(10)
    for number, picture in enumerate(pictures):
        np.testing.assert_allclose(colour_at(picture, 16, 16), 40 * number, atol=6)
        np.testing.assert_allclose(colour_at(picture, WIDTH + 16, 16), 255 - 40 * number, atol=6)
        on, off = (ON_COLOUR, OFF_COLOUR) if number == 1 else (NO_COLOUR, NO_COLOUR)
        np.testing.assert_allclose(colour_at(picture, 2 * WIDTH + 16, 0), on, atol=12)
        np.testing.assert_allclose(colour_at(picture, 2 * WIDTH, 16), off, atol=12)
        np.testing.assert_allclose(colour_at(picture, 2 * WIDTH + 32, 32), NO_COLOUR, atol=6)
        near, far = colour_at(picture, 3 * WIDTH + 8, 0), colour_at(picture, 3 * WIDTH + 40, 0)
        assert near[0] > near[2] + 60 and far[2] > far[0]
        np.testing.assert_allclose(colour_at(picture, 3 * WIDTH + 40, 32), 0, atol=12)


def test_cameras_of_two_odd_sizes_in_colour_without_blur_and_depth(tmp_path: Path):
    colour = np.zeros((33, 51, 3), np.uint8)
    colour[...] = (200, 100, 20)
    with Preview(tmp_path / "preview.mp4", WIDTH, HEIGHT) as preview:
        preview.add_events(block(16, 16, -1))
        preview.add_frame(colour, None, None)
    pictures, _ = decode(tmp_path / "preview.mp4")
    assert pictures.shape == (1, 34, 51 + 44 + 1, 3)
    np.testing.assert_allclose(colour_at(pictures[0], 16, 16), (200, 100, 20), atol=12)
    scale = 33 / HEIGHT
    np.testing.assert_allclose(pictures[0, round(24 * scale), 51 + round(24 * scale)], OFF_COLOUR, atol=30)


def test_a_folder_that_is_missing_is_named(tmp_path: Path):
    path = tmp_path / "missing" / "preview.mp4"
    message = f"{re.escape(str(path))} could not be written as a video; .*without --preview\\.$"
    with pytest.raises(OutputError, match=message), Preview(path, WIDTH, HEIGHT) as preview:
        for _ in range(20):
            preview.add_frame(np.zeros((480, 640), np.uint8), None, None)
    with pytest.raises(OutputError, match=message), Preview(path, WIDTH, HEIGHT) as preview:
        preview.add_frame(np.zeros((HEIGHT, WIDTH), np.uint8), None, None)


def test_an_interrupted_video_can_be_seen(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), Preview(tmp_path / "preview.mp4", WIDTH, HEIGHT) as preview:
        for _ in range(3):
            preview.add_frame(np.zeros((HEIGHT, WIDTH), np.uint8), None, None)
        raise KeyboardInterrupt
    assert len(decode(tmp_path / "preview.mp4")[0]) == 3


def test_without_frames_there_is_no_video(tmp_path: Path):
    with Preview(tmp_path / "preview.mp4", WIDTH, HEIGHT):
        pass
    assert not list(tmp_path.iterdir())
