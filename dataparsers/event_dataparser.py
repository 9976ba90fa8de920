"""A recording as Nerfstudio sees it: cameras, pictures, a box around the scene.

Nerfstudio imports this module while it is itself half imported: nothing here may import its data managers, pipelines,
trainer, models or methods.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from scipy.spatial.transform import Rotation
from tyro.conf import Suppress

from enerf_ns.dataparsers.depth_range import estimate_depth_range
from enerf_ns.dataparsers.errors import RecordingError, UserError
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.registry import formats, read_recording
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording, Frames

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Turns the camera axes x right, y down, z forward into Nerfstudio's x right, y up, z back, and back again."""

EVENTS_FOR_DEPTH = 4_000_000
"""Of more events, so many measure the depth of the scene."""

NUM_EVENT_PICTURES = 48
"""Cameras along the trajectory that stand in for frames where a recording has none."""


@dataclass
class EventDataParserConfig(DataParserConfig):
    """A recording of an event camera; finds out which format the folder has."""

    _target: Type = field(default_factory=lambda: EventDataParser)  # noqa: UP006
    data: Path = Path()
    """Folder of the recording. It is only ever read."""
    held_out_every: int = 4
    """Every so many frames one is kept from training, for evaluation. 1: all, for learning from events alone."""
    train_frames: Literal["blurred", "sharp"] = "blurred"
    """Which frames to train on, where the recording has both; evaluation is always on sharp ones."""
    depth_range: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """Nearest and farthest depth of the scene in metres. None: the recording's own, else measured from its events."""
    box: Optional[Tuple[float, float, float, float]] = None  # noqa: UP006, UP045
    """Cube around the scene: x y z of its middle and half its side, metres. None: all that the cameras see."""
    time_range: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """First and last second that is used, on the recording's clock. None: all."""
    keep_hot_pixels: bool = False
    """Use pixels that fire far more often than their neighbourhood."""
    train_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the frames to train on, from 0. None: all that are not held out."""
    held_out_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the frames kept for evaluation, from 0. None: by held-out-every."""
    format: Suppress[str] = "auto"
    """Name of a registered format, or auto to find out; what a sub-command stands for."""
    options: Annotated[FormatOptions, tyro.conf.arg(name="")] = FormatOptions()  # noqa: RUF009 - frozen
    """Of the format. A default and no default_factory, so that runs of before there were any can be loaded."""


@dataclass
class EventDataParser(DataParser):
    """Turns a recording into cameras in a box of size 2 around the origin, z up."""

    config: EventDataParserConfig

    def recording(self) -> EventRecording:
        """The recording of this parser's folder, read once per process."""
        config = self.config
        selection = config.time_range and tuple(config.time_range), config.keep_hot_pixels
        return read_recording(config.data, config.format, *selection, **vars(config.options))

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        try:
            return self.outputs(self.recording(), split)
        except UserError as error:
            raise SystemExit(f"enerf: {error}") from error

    def outputs(self, recording: EventRecording, split: str) -> DataparserOutputs:
        """Cameras of one split, and the box, as Nerfstudio wants them.

        Args:
            recording: What was read.
            split: "train", or "val" and "test", which are the held-out frames.

        Raises:
            RecordingError: if the depth of the scene is neither known nor observable.
        """
        near, far = depth_range(recording, self.config)
        transform, scale, box = scene_normalisation(recording, near, far, self.config.box)
        frames, are_frames = split_frames(recording, self.config, held_out=split != "train")

        poses = frames.trajectory.poses(torch.from_numpy(frames.times)).numpy()
        camera_to_scene = np.einsum("ij,njk->nik", transform[:, :3], poses)
        camera_to_scene[..., 3] = scale * (camera_to_scene[..., 3] + transform[:, 3])
        camera_to_scene[..., :3] = camera_to_scene[..., :3] @ OPENGL_FROM_OPENCV

        camera = frames.camera.undistorted()
        cameras = Cameras(
            camera_to_worlds=torch.from_numpy(camera_to_scene).float(),
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx + 0.5,
            cy=camera.cy + 0.5,
            width=camera.width,
            height=camera.height,
            camera_type=CameraType.PERSPECTIVE,
            metadata={},
        )
        return DataparserOutputs(
            image_filenames=list(frames.filenames),
            cameras=cameras,
            scene_box=SceneBox(aabb=torch.from_numpy(box).float()),
            metadata={"recording": recording, "frames": frames, "are_frames": are_frames},
            dataparser_transform=torch.from_numpy(transform).float(),
            dataparser_scale=scale,
        )


def depth_range(recording: EventRecording, config: EventDataParserConfig) -> tuple[float, float]:
    """Nearest and farthest depth in metres: from the flag, the recording, or its events, in this order.

    Raises:
        RecordingError: if the flag is no range, or the events do not show how deep the scene is.
    """
    chosen = config.depth_range or recording.depth_range
    if chosen is None:
        try:
            events = index_events(recording).events(at_most=EVENTS_FOR_DEPTH)
            chosen = estimate_depth_range(events, recording.camera, recording.trajectory)
        except ValueError as error:
            raise RecordingError(
                f"{recording.path}: {str(error).rstrip('.')}, with --depth-range NEAR FAR of the data parser (metres)."
            ) from error
    near, far = chosen
    if not 0.0 < near < far < np.inf:
        raise RecordingError(f"{recording.path}: the depth range is {near} to {far} m; expected 0 < near < far")
    return near, far


def scene_normalisation(
    recording: EventRecording, near: float, far: float, cube: tuple[float, float, float, float] | None = None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Where the scene lies, seen from every pose of the event camera between the nearest and the farthest depth.

    Args:
        recording: Trajectory and camera.
        near: Nearest depth in metres.
        far: Farthest depth in metres.
        cube: Middle and half side in metres of a cube along the axes of the world, where the scene is known to be.

    Returns:
        transform (3, 4) and scale, so that a world point p becomes scale * (transform @ [p, 1]): the mean up direction
        of the cameras turned to +z, the middle of what they see moved to the origin; and the box (2, 3) of what they
        see, in scene units, whose longest side is 2. Of a cube, the world is not turned.
    """
    if cube is not None:
        return np.column_stack([np.eye(3), -np.array(cube[:3])]), 1.0 / cube[3], np.array([[-1.0] * 3, [1.0] * 3])
    trajectory, camera = recording.trajectory, recording.camera
    times = np.linspace(*recording.span, 100).astype(np.int64)
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    up = -poses[:, :, 1].mean(axis=0)
    rotation = np.eye(3)
    if np.linalg.norm(up) > 0.1:
        rotation = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()

    rows = np.linspace(0, camera.height - 1, 5).astype(int)
    columns = np.linspace(0, camera.width - 1, 5).astype(int)
    directions = camera.pixel_directions()[np.ix_(rows, columns)].reshape(-1, 3)
    points = np.concatenate([directions * near, directions * far])
    seen = np.einsum("nij,mj->nmi", poses[:, :, :3], points) + poses[:, None, :, 3]
    seen = seen.reshape(-1, 3) @ rotation.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    scale = 1.0 / half.max()
    transform = np.concatenate([rotation, -middle[:, None]], axis=1)
    return transform, float(scale), np.stack([-half, half]) * scale


def split_frames(recording: EventRecording, config: EventDataParserConfig, held_out: bool) -> tuple[Frames, bool]:
    """The frames of one split; where the recording has none, instants along its trajectory to picture events at.

    Returns:
        The frames, and whether they are some: otherwise, their file names stand for no files.
    """
    if held_out and recording.held_out_frames:
        return recording.held_out_frames, True
    frames = recording.frames or recording.blurred_frames or event_pictures(recording)
    if not held_out and config.train_frames == "blurred" and recording.blurred_frames:
        frames = recording.blurred_frames
    start, end = recording.span
    used = (frames.times >= start) & (frames.times <= end)
    if not used.any():
        used[:] = True
    if config.held_out_frame_indices is not None:
        evaluated = np.isin(frames.numbers, config.held_out_frame_indices)
    elif recording.held_out_frames:
        evaluated = np.zeros_like(used)
    else:
        evaluated = used & ((np.cumsum(used) - 1) % config.held_out_every == config.held_out_every // 2)
    if held_out:
        chosen = evaluated
    elif config.train_frame_indices is not None:
        chosen = np.isin(frames.numbers, config.train_frame_indices)
    else:
        chosen = used & ~evaluated
    return frames.subset(np.flatnonzero(chosen if chosen.any() else used)), recording.has_frames


def event_pictures(recording: EventRecording) -> Frames:
    """Instants along the trajectory, for a recording without frames; their file names stand for no file."""
    times = np.linspace(*recording.span, NUM_EVENT_PICTURES + 2)[1:-1].astype(np.int64)
    names = tuple(recording.path / f"events_{i:05d}.png" for i in range(len(times)))
    return Frames(filenames=names, times=times, camera=recording.camera, trajectory=recording.trajectory)


def specification(format: Format) -> DataParserSpecification:
    """The sub-command of a format, to be named as an entry point in the group nerfstudio.dataparser_configs."""
    config = EventDataParserConfig(format=format.name, options=format.options())
    return DataParserSpecification(config=config, description=format.description)


event_data = DataParserSpecification(
    config=EventDataParserConfig(), description="A recording of an event camera, in any format that enerf-ns reads."
)


def __getattr__(name: str) -> DataParserSpecification:
    """The specification of a registered format by its sub-command, such as `eds_events` for eds-events."""
    for format in formats():
        if format.command.replace("-", "_") == name:
            return specification(format)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
