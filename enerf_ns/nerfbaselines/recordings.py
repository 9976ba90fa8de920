"""Recordings of event cameras as data sets of nerfbaselines: frames with cameras, and the folder of the events."""

from __future__ import annotations

import hashlib
import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, split_frames
from enerf_ns.dataparsers.index.index_cache import cache_folder
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import in_colour, write_whole
from enerf_ns.dataparsers.recording.picture_depth import brightness
from enerf_ns.evaluation.views import png


def load_recording(path: str, split: str, *, features: Any = None, **options: Any) -> Any:
    """The frames of a recording for nerfbaselines.

    Args:
        path: Folder of a recording in any format that this package reads.
        split: "train" or "test". Training takes sharp frames for methods that need frames; the method of this package
            reads the events of the folder in metadata["events"].
        features: Not used.
        options: Not used.

    Returns:
        An unloaded data set: cameras without distortion in OpenCV axes, metres; and pictures of 8 bits with the
        values of the frames, which are linear brightness.

    Raises:
        RecordingError: The folder is no recording, or holds no frames.
    """
    nerfbaselines = import_module("nerfbaselines")
    parser = EventDataParserConfig(data=Path(path), picture_files=False, train_frames="sharp")
    recording = parser.setup().recording()
    if not recording.has_frames:
        raise RecordingError(f"{path} holds no frames, but nerfbaselines scores frames; record or simulate some.")
    frames, _ = split_frames(recording, parser, held_out=split != "train")
    camera, number = frames.picture_camera, len(frames.times)
    poses = frames.trajectory.poses(torch.from_numpy(frames.times)).numpy().astype(np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5], np.float32)
    folder = cache_folder() / "nerfbaselines" / hashlib.sha256(str(recording.path.resolve()).encode()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for place in range(number):
        picture = in_colour(brightness(frames.camera.undistort(frames.image(place))))
        files.append(folder / f"{frames.numbers[place]:06d}.png")
        write_whole(files[-1], png(torch.from_numpy(picture)))
    return nerfbaselines.new_dataset(
        cameras=nerfbaselines.new_cameras(
            poses=poses,
            intrinsics=np.tile(lens, (number, 1)),
            camera_models=np.full(number, nerfbaselines.camera_model_to_int("pinhole"), np.int32),
            image_sizes=np.tile(np.array([camera.width, camera.height], np.int32), (number, 1)),
        ),
        image_paths=[str(file) for file in files],
        image_paths_root=str(folder),
        metadata={
            "id": None,
            "scene": recording.path.name,
            "color_space": "srgb",  # nerfbaselines 1.2 renders no other while it trains; values stay as they are
            "evaluation_protocol": "log-affine-set",
            "events": str(recording.path),
        },
    )


def simulate_scene(path: str, output: str) -> None:
    """Simulates a scene as a recording, and marks the folder for nerfbaselines.

    Args:
        path: enerf-simulated/SCENE.
        output: New folder.

    Raises:
        RecordingError: There is no such scene.
    """
    from enerf_ns.simulator.engine import simulate
    from enerf_ns.simulator.settings import SimulationSettings

    scene = path.rpartition("/")[2]
    simulate(SimulationSettings(scene), Path(output))
    about = {"loader": "enerf-recording", "id": "enerf-simulated", "scene": scene}
    write_whole(Path(output) / "nb-info.json", json.dumps(about, indent=2))
