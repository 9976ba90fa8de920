from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from recordings import FRAME_TIMES, HEIGHT, WIDTH, image, write_davis, write_esim

from enerf_ns.dataparsers.event_dataparser import EventDataParser, EventDataParserConfig
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.event_index import event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.method.event_dataset import EventDataset


def dataset(folder: Path, split: str = "train") -> EventDataset:
    config = EventDataParserConfig(data=folder, depth_range=(0.5, 4.0), held_out_every=1)
    parser = EventDataParser(config)
    return EventDataset(parser.outputs(parser.recording(), split))


@pytest.mark.parametrize("channels", [1, 3])
def test_frames_are_pictures_of_three_channels(tmp_path: Path, channels: int):
    frames = dataset(write_esim(tmp_path / "esim", channels=channels), "test")
    assert frames.are_frames and len(frames) == len(FRAME_TIMES)
    for i in range(len(frames)):
        np.testing.assert_array_equal(frames.get_numpy_image(i), np.broadcast_to(image(i, channels), (18, 24, 3)))
        assert frames[i]["is_frame"]


def test_frames_are_without_distortion(tmp_path: Path):
    frames = dataset(write_davis(tmp_path / "davis"), "test")
    camera = read_recording(tmp_path / "davis").camera
    np.testing.assert_array_equal(frames.get_numpy_image(1)[..., :1], camera.undistort(image(1)))
    assert camera.model == "radtan"


def test_depth_comes_with_its_frame(tmp_path: Path):
    frames = dataset(write_esim(tmp_path / "esim", depth=True), "test")
    for i in range(len(frames)):
        torch.testing.assert_close(frames[i]["depth"], torch.full((HEIGHT, WIDTH, 1), 1.0 + i))


def test_without_frames_the_pictures_are_of_events(tmp_path: Path):
    folder = write_davis(tmp_path / "davis", frames=False)
    pictures, recording = dataset(folder), read_recording(folder)
    assert not pictures.are_frames and not pictures[0]["is_frame"] and "depth" not in pictures[0]
    time = int(pictures.frames.times[-1])
    expected = event_picture(index_events(recording), recording.camera, time)
    np.testing.assert_array_equal(pictures.get_numpy_image(len(pictures) - 1), expected)
