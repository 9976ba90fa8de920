"""Renders of any method as pictures in a folder, matched with the held-out frames of a recording."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from enerf_ns.dataparsers.event_dataparser import OPENGL_FROM_OPENCV
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import (
    by_numbers,
    check_is_folder,
    files_in,
    image_size,
    load_array,
    load_image,
)
from enerf_ns.dataparsers.recording.hdf5_files import is_deep_picture
from enerf_ns.dataparsers.recording.picture_depth import brightness, find_white_level
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.evaluation.views import HeldOutView

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp")
ARRAY = ".npy"
"""Suffix of files with linear brightness in floats, shape (height, width), (height, width, 1) or (height, width, 3)."""

DEEPEST = 2.0**16 - 1
"""Full brightness in renders of 16 bits of frames of 8 bits."""

THUMBNAIL = 32
"""Most pixels along a side of the pictures by which the order of renders is checked."""


def views_json(frames: Frames) -> str:
    """Camera, poses and instants of held-out frames, for another method to render, in Nerfstudio's transforms.json.

    Poses are camera to world in metres of the recording, with the axes x right, y up, z back. The camera has no
    distortion. The middle of the upper left pixel is (0.5, 0.5). `time` is in seconds on the recording's clock.
    """
    camera = frames.picture_camera
    poses = np.tile(np.eye(4), (len(frames.times), 1, 1))
    poses[:, :3] = frames.trajectory.poses(torch.from_numpy(frames.times)).numpy()
    poses[:, :3, :3] = poses[:, :3, :3] @ OPENGL_FROM_OPENCV
    views = [
        {"file_path": source.name, "transform_matrix": pose.tolist(), "time": 1e-9 * int(time)}
        for source, pose, time in zip(frames.filenames, poses, frames.times, strict=True)
    ]
    about = {
        "camera_model": "PINHOLE",
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{"cx": camera.cx + 0.5, "cy": camera.cy + 0.5},
        "frames": views,
    }
    return json.dumps(about, indent=1) + "\n"


def rendered_views(folder: Path, frames: Frames, colour_filter: bool) -> list[HeldOutView]:
    """Held-out frames, each with the render in a folder that belongs to it.

    A render has the name of its frame, whatever its suffix. If no render has the name of a frame and there are as many
    renders as frames, they are in the order of their names, in which numbers count as numbers. Pictures hold values on
    the scale of the frames, 8 or 16 bits; .npy files hold linear brightness.

    Args:
        folder: Folder of the renders.
        frames: Held-out frames.
        colour_filter: Whether the sensor has a colour filter.

    Raises:
        RecordingError: The renders do not belong to the frames by name or number, differ in size from them, or cannot
            be read.
    """
    files = _files(folder, frames)
    camera = frames.picture_camera
    pictures = [file for file in files if file.suffix.lower() != ARRAY]
    for file in pictures:
        found = image_size(file)
        if found != (camera.width, camera.height):
            raise RecordingError(
                f"{file} has {found[0]} x {found[1]} pixels, but its frame has {camera.width} x {camera.height}; "
                "render the size of the frames, or give the factor between both by --downscale-factor."
            )
    white = _white_level(tuple(pictures), frames)
    return [
        HeldOutView(
            recorded=_in_colour(brightness(frames.picture(number))),
            rendered=_render(file, camera.height, camera.width, white),
            depth=torch.full((camera.height, camera.width, 1), torch.nan),
            recorded_depth=None,
            time=int(frames.times[number]),
            colour_filter=colour_filter,
        )
        for number, file in enumerate(files)
    ]


def _white_level(pictures: tuple[Path, ...], frames: Frames) -> float:
    """The value of full brightness in renders of more than 8 bits. Dark renders do not show it by their largest value.

    Integers are on the scale of the frames, or have 16 bits if frames have 8, or more bits if the renders need them.
    Floats are on the scale of the frames if frames have more than 8 bits and some render exceeds 1, else linear.
    """
    found = find_white_level(pictures)
    of_frames = frames.white_level if is_deep_picture(frames.filenames[0]) else None
    deep = next((picture for picture in pictures if is_deep_picture(picture)), None)
    if deep is not None and load_image(deep).dtype == np.float32:
        return of_frames if of_frames and found > 1.0 else 1.0
    return max(found, of_frames or DEEPEST)


def better_fits(views: Sequence[HeldOutView]) -> list[tuple[int, int]]:
    """Renders that resemble another frame more than their own: numbers of the render and of that frame, from 0."""
    rendered, recorded = ([_thumbnail(picture) for picture in pictures] for pictures in _both(views))
    likeness = np.array(rendered) @ np.array(recorded).T
    best = likeness.argmax(axis=1)
    return [
        (number, int(frame)) for number, frame in enumerate(best) if likeness[number, frame] > likeness[number, number]
    ]


def _both(views: Sequence[HeldOutView]) -> tuple[list[Tensor], list[Tensor]]:
    return [view.rendered for view in views], [view.recorded for view in views if view.recorded is not None]


def _thumbnail(picture: Tensor) -> np.ndarray:
    """A small picture without mean and of norm 1, as one row; zeros if it is flat."""
    small = torch.nn.functional.interpolate(
        picture.nan_to_num().mean(dim=-1)[None, None].double(), (THUMBNAIL, THUMBNAIL), mode="area"
    ).flatten()
    small = small - small.mean()
    return (small / small.norm().clamp(min=1e-12)).numpy()


def _files(folder: Path, frames: Frames) -> list[Path]:
    check_is_folder(folder, "a folder of renders")
    renders = [file for file in files_in(folder, "*") if file.suffix.lower() in (*PICTURES, ARRAY) and file.is_file()]
    if not renders:
        raise RecordingError(f"{folder} holds no renders, but pictures ({', '.join(PICTURES)}) or .npy were expected.")
    names = [source.stem for source in frames.filenames]
    by_name: dict[str, Path] = {}
    for file in sorted(renders):
        if file.stem in by_name:
            raise RecordingError(
                f"{folder} holds both {by_name[file.stem].name} and {file.name}; leave one render a frame."
            )
        by_name[file.stem] = file
    missing = [name for name in names if name not in by_name]
    if not missing:
        return [by_name[name] for name in names]
    if len(missing) < len(names):
        raise RecordingError(
            f"{folder} holds no render of the held-out frame {missing[0]}, and {len(missing)} of {len(names)} are "
            "missing; render all of them, with the names of the frames."
        )
    if len(renders) != len(names):
        raise RecordingError(
            f"{folder} holds {len(renders)} renders that have the name of no held-out frame, but {len(names)} frames "
            f"are held out ({names[0]} and so on); render these, as --views FILE lists them."
        )
    return sorted(renders, key=by_numbers)


def _render(file: Path, height: int, width: int, white: float) -> Tensor:
    if file.suffix.lower() == ARRAY:
        array = load_array(file).astype(np.float32)
        array = array[..., None] if array.ndim == 2 else array
        if array.shape not in ((height, width, 1), (height, width, 3)):
            shape = " x ".join(map(str, array.shape))
            raise RecordingError(f"{file} has the shape {shape}, but {height} x {width} x 3 (or 1) was expected.")
        if (array < 0).any():
            raise RecordingError(f"{file} holds a brightness of {array.min():g}, but numbers from 0 on were expected.")
        return _in_colour(array)
    image = load_image(file)
    return _in_colour(brightness(image) if image.dtype == np.uint8 else image / np.float32(white))


def _in_colour(picture: np.ndarray) -> Tensor:
    return torch.from_numpy(np.repeat(picture, 3, axis=2) if picture.shape[2] == 1 else picture)
