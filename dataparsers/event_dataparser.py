"""A recording as Nerfstudio sees it: cameras, pictures, a box around the scene.

Nerfstudio imports this module while it is itself half imported: nothing here may import its data managers, pipelines,
trainer, models or methods.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float64
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from tyro.conf import Suppress

from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.registry import formats, read_recording
from enerf_ns.dataparsers.index.picture_files import write_pictures
from enerf_ns.dataparsers.inspection.causes import depth_range_or_cause
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, exit_with_a_sentence, quoted, shortened
from enerf_ns.dataparsers.recording.ffmpeg import make_ffmpeg_available
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.dataparsers.recording.ranges import check_reading, shown
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, seconds
from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation

with warnings.catch_warnings(), suppress(ImportError):  # hides two warnings that Nerfstudio would show at each start
    warnings.filterwarnings("ignore", r"`torch\.cuda\.amp\.custom_", FutureWarning)
    import_module("nerfstudio.field_components.activations")

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Rotation from the camera axes x right, y down, z forward to Nerfstudio's x right, y up, z back. It is its own
inverse."""

DEFAULT_HELD_OUT_EVERY = 4
"""One frame in so many is held out by default."""

NUM_EVENT_PICTURES = 48
"""Number of cameras along the trajectory that stand in for frames if a recording has none."""


@dataclass
class EventDataParserConfig(DataParserConfig):
    """A recording of an event camera, in any format that enerf-ns reads."""

    _target: Type = field(default_factory=lambda: EventDataParser)  # noqa: UP006
    data: Path = Path()
    """Folder of the recording. It is only ever read."""
    held_out_every: Optional[int] = None  # noqa: UP045
    """One frame in so many is held out for evaluation. 1: all frames, to learn from events alone. Default: 4, unless a
    preset selects frames."""
    train_frames: Optional[Literal["blurred", "sharp"]] = None  # noqa: UP045
    """Frames to train on, if the recording has both. Evaluation always uses sharp frames. Default: blurred frames for
    the methods of enerf-ns; for other methods sharp frames, or frames that were reconstructed from events."""
    exposure_ms: Optional[float] = None  # noqa: UP045
    """Exposure time of the frames to train on, milliseconds. Half of it lies before the frame's stamp, half after.
    0: an instant. Default: the recording's own exposure."""
    depth_range: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """Nearest and farthest depth of the scene, metres. Default: the recording's own range, else measured from
    events."""
    box: Optional[Tuple[float, float, float, float]] = None  # noqa: UP006, UP045
    """Cube around the scene: x y z of its middle and half its side, metres. Default: the box of all that the cameras
    see."""
    contraction_depth: Optional[float] = None  # noqa: UP045
    """Depth from which methods that contract space do so, metres: up to it, cells of a field are of even size.
    Default: with enerf, four times the nearest depth, if the farthest is beyond; else the farthest."""
    time_range: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """First and last second to use, on the recording's clock. Default: the whole recording."""
    keep_hot_pixels: bool = False
    """Use pixels that fire far more often than their neighbourhood."""
    keep_pose_gaps: bool = False
    """Use events and frames in gaps of the poses, with interpolated poses."""
    downscale_factor: Optional[float] = None  # noqa: UP045
    """Factor by which pictures are smaller than the frames. Events stay as they are. Default: 1."""
    smooth_poses: Optional[bool] = None  # noqa: UP045
    """Smooth noise of the poses that is independent from pose to pose. Default: if it moves the picture by more than a
    tenth of a pixel."""
    undistort: bool = True
    """Undo the lens distortion that the calibration states. False: ignore it, as if the lens had none."""
    train_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the frames to train on, from 0. Default: all frames that are not held out."""
    held_out_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the frames to hold out for evaluation, from 0. Default: those that held-out-every selects."""
    format: Suppress[str] = "auto"
    """Name of a registered format, or auto to detect it. Each sub-command sets its format."""
    picture_files: Suppress[bool] = True
    """Write picture files that any method reads. The methods of enerf-ns read the recording itself."""
    options: Annotated[FormatOptions, tyro.conf.arg(name="")] = field(default_factory=FormatOptions)
    """Options of the format."""


@dataclass
class EventDataParser(DataParser):
    """Converts a recording to cameras in a box around the origin, with z up, and pictures for any method.

    The box has size 2; with a depth of contraction, its part up to that depth has."""

    config: EventDataParserConfig

    def recording(self) -> EventRecording:
        """The recording of this parser's folder, read once per process."""
        config = self.config
        check_reading(config, "event-data ")
        time_range = config.time_range and (config.time_range[0], config.time_range[1])  # YAML may give a list
        selection = (
            *(time_range, config.keep_hot_pixels, config.keep_pose_gaps, config.undistort),
            bool(config.smooth_poses),
        )
        return read_recording(config.data, config.format, *selection, **vars(config.options))

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        make_ffmpeg_available()
        allow_numpy_scalars_in_checkpoints()
        with exit_with_a_sentence():
            recording = self.recording()
            if not self.config.picture_files:
                return self.outputs(recording, split)
            if not recording.has_frames:
                raise RecordingError(
                    f"{recording.path} holds no frames to train on, but this method needs some; learn from its events "
                    f"with ns-train enerf --data {quoted(recording.path)}, or make frames from events with enerf "
                    f"reconstruct {quoted(recording.path)} --output-dir NEW and give that folder."
                )
            go_on_without_lpips()
            outputs = self.outputs(recording, split)
            if split == "train":
                check_trained_frames(recording, self.config, outputs.metadata["frames"])
            return with_picture_files(outputs)

    def outputs(self, recording: EventRecording, split: str) -> DataparserOutputs:
        """Nerfstudio's outputs for one split: its cameras, the scene box, and the recording's file names.

        The metadata hold the recording, the two results of `split_frames` as frames and are_frames, and transform, the
        float64 original of `dataparser_transform`. Float32 has a resolution of 0.25 m at 5e6 m from the world's origin.

        Args:
            recording: From `recording()`.
            split: "train", or "val" or "test" for the held-out frames.

        Raises:
            RecordingError: The depth range is neither stated nor measurable, or all frames lie in gaps of the poses.
            FlagError: The frames cannot be downscaled by this factor, or stated numbers choose no frame or leave none
                to hold out.
        """
        near, far = depth_range_or_cause(recording, self.config.depth_range)
        limits = self.config.box, self.config.contraction_depth
        transform, scale, box = scene_normalisation(recording, near, far, *limits)
        frames, are_frames = split_frames(recording, self.config, held_out=split != "train")

        return EventDataparserOutputs(
            image_filenames=list(frames.filenames),
            cameras=scene_cameras(frames, torch.from_numpy(transform), scale),
            scene_box=SceneBox(aabb=torch.from_numpy(box).float()),
            metadata={
                "recording": recording,
                "frames": frames,
                "are_frames": are_frames,
                "transform": torch.from_numpy(transform),
            },
            dataparser_transform=torch.from_numpy(transform).float(),
            dataparser_scale=scale,
        )


def scene_cameras(frames: Frames, transform: Float64[torch.Tensor, "3 4"], scale: float) -> Cameras:
    """Nerfstudio's cameras of frames.

    Args:
        frames: In the recording's world.
        transform, scale: From `scene_normalisation`.
    """
    rotation, shift = transform[:, :3].numpy(), transform[:, 3].numpy()
    poses = frames.trajectory.poses(torch.from_numpy(frames.times)).numpy()
    camera_to_scene = np.einsum("ij,njk->nik", rotation, poses)
    camera_to_scene[..., 3] = scale * (camera_to_scene[..., 3] + shift)
    camera_to_scene[..., :3] = camera_to_scene[..., :3] @ OPENGL_FROM_OPENCV
    camera = frames.picture_camera
    return Cameras(
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


class EventDataparserOutputs(DataparserOutputs):
    """Nerfstudio's outputs, which write their file as a whole or not at all."""

    def save_dataparser_transform(self, path: Path) -> None:
        """Writes the transform and the scale from world to scene coordinates, as JSON.

        Raises:
            OSError: The disk is full, or the folder cannot be written to. No file is left then.
        """
        values = {"transform": self.dataparser_transform.tolist(), "scale": float(self.dataparser_scale)}
        write_whole(path, json.dumps(values, indent=4))


@cache
def go_on_without_lpips() -> None:
    """Lets a method of Nerfstudio start where the weights of its LPIPS cannot be downloaded. The score is nan then.

    These methods make an LPIPS of AlexNet when they start, and torchvision downloads its weights at that time.
    """
    from torchvision.models import AlexNet_Weights, alexnet

    downloaded = AlexNet_Weights.get_state_dict

    def state(weights: AlexNet_Weights, *arguments: Any, **options: Any) -> Mapping[str, Any]:
        try:
            return downloaded(weights, *arguments, **options)
        except OSError:
            print("lpips is left out (nan): its weights cannot be downloaded; get them by enerf fetch-lpips alex.")
            with torch.device("meta"):
                layers = alexnet(weights=None).state_dict()
            return {name: torch.tensor(torch.nan).expand(layer.shape) for name, layer in layers.items()}

    AlexNet_Weights.get_state_dict = state  # type: ignore


def with_picture_files(outputs: DataparserOutputs) -> DataparserOutputs:
    """The outputs with files that any method reads: pictures, and depth maps, that fit the cameras.

    The pictures are written to the cache, undistorted and downscaled, with 8 bits and without transparency.
    Nerfstudio's data sets open files themselves, and not all of them undistort. Nerfstudio's cameras cannot state every
    lens. Some methods write files beside the pictures, which must not happen in the recording.

    Raises:
        RecordingError: A file cannot be read.
        OutputError: The pictures cannot be written.
    """
    frames = outputs.metadata["frames"]
    metadata = {"transform": outputs.metadata["transform"]}
    if frames.depth_filenames is not None and frames.camera.model == "pinhole":
        metadata |= {"depth_filenames": list(frames.depth_filenames), "depth_unit_scale_factor": 1.0}
    return replace(outputs, image_filenames=write_pictures(frames), metadata=metadata)


def split_frames(recording: EventRecording, config: EventDataParserConfig, held_out: bool) -> tuple[Frames, bool]:
    """The frames of one split, or instants along the trajectory if the recording has no frames.

    The held-out frames do not depend on whether sharp or blurred frames are for training, so that all methods are
    scored on the same frames. Only numbers that are stated for both splits may be in both.

    Returns:
        The frames, without those in gaps of the poses. Frames to train on are also without those whose exposures reach
        beyond the poses or into gaps. And whether the frames are files: otherwise, their file names stand for no files.

    Raises:
        RecordingError: No frame is left.
        FlagError: The exposure or the downscaling is impossible for the frames, or stated numbers choose no frame or
            leave none to hold out.
    """
    frames, are_frames = _split_frames(recording, config, held_out)
    if config.downscale_factor is None:
        return frames, are_frames
    try:
        frames = replace(frames, downscale_factor=config.downscale_factor)
        _ = frames.picture_camera
    except ValueError as error:
        raise FlagError(f"event-data --downscale-factor {config.downscale_factor:g} gives {error}") from error
    return frames, are_frames


def _split_frames(recording: EventRecording, config: EventDataParserConfig, held_out: bool) -> tuple[Frames, bool]:
    stated, others = config.train_frame_indices, config.held_out_frame_indices
    if held_out:
        stated, others = others, stated
    if held_out and recording.held_out_frames and (stated is None or not recording.has_frames):
        return recording.held_out_frames, True
    frames = recording.frames or recording.blurred_frames or event_pictures(recording)
    train_frames = config.train_frames or ("blurred" if recording.reconstructed_by else "sharp")
    if not held_out and train_frames == "blurred" and recording.blurred_frames:
        frames = recording.blurred_frames
    if not held_out and config.exposure_ms is not None and recording.has_frames:
        try:
            frames = frames.with_exposure(round(config.exposure_ms * 1e6))
        except ValueError as error:
            raise FlagError(
                f"event-data --exposure-ms {config.exposure_ms:g} gives {recording.path} {error}"
            ) from error
    posed = ~recording.in_left_out_gaps(frames.times)
    if not posed.any():
        raise RecordingError(
            f"All frames of {recording.path} lie in gaps of the poses; add the poses that are missing, or use the "
            "frames with --keep-pose-gaps True."
        )
    frames = frames.subset(np.flatnonzero(posed))
    if stated is None:
        chosen = _not_stated(recording, config, held_out, frames, others)
    else:
        chosen = np.isin(frames.numbers, stated)
        if not chosen.any():
            raise FlagError(
                f"event-data --{'held-out' if held_out else 'train'}-frame-indices {shortened(shown(stated))} chooses "
                f"none of the frames of {recording.path} with poses, which have numbers from {frames.numbers[0]} to "
                f"{frames.numbers[-1]}; give some of these."
            )
    frames = frames.subset(np.flatnonzero(chosen))
    if held_out or not recording.has_frames:
        return frames, recording.has_frames
    known = recording.knows_poses(frames)
    if not known.any():
        raise RecordingError(
            f"The exposures of all frames of {recording.path} to train on reach beyond the poses or into gaps of them; "
            "add the poses that are missing, or take the frames as instants with --exposure-ms 0."
        )
    return frames.subset(np.flatnonzero(known)), True


def _not_stated(
    recording: EventRecording,
    config: EventDataParserConfig,
    held_out: bool,
    frames: Frames,
    others: Sequence[int] | None,
) -> Bool[np.ndarray, " frames"]:
    """Returns which frames a split has whose numbers are not stated.

    Args:
        recording, config, held_out: As in `split_frames`.
        frames: The frames outside of gaps.
        others: Numbers that are stated for the other split.

    Raises:
        FlagError: All frames are stated to be for training.
    """
    used = _in_time_range(recording, frames)
    if not used.any():
        used[:] = True
    left = used & ~np.isin(frames.numbers, others or ())
    if held_out and not left.any():
        raise FlagError(
            f"event-data --train-frame-indices takes all frames of {recording.path}, so that none is held out; leave "
            "some out, or state those of --held-out-frame-indices as well."
        )
    if not held_out and (others is not None or recording.held_out_frames):
        chosen = left
    else:
        every = DEFAULT_HELD_OUT_EVERY if config.held_out_every is None else config.held_out_every
        evaluated = used & ((np.cumsum(used) - 1) % every == every // 2)
        chosen = left & (evaluated == held_out)
    if chosen.any():
        return chosen
    return left if held_out else used


def _in_time_range(recording: EventRecording, frames: Frames) -> Bool[np.ndarray, " frames"]:
    start, end = recording.span
    return (frames.times >= start) & (frames.times <= end)


def check_trained_frames(recording: EventRecording, config: EventDataParserConfig, frames: Frames) -> None:
    """Checks that frames of the train split may be trained on. Where events alone are, they only place cameras.

    Args:
        recording, config: Arguments of `split_frames`.
        frames: Its result.

    Raises:
        FlagError: The time range holds none of the frames, or all of them are stated to be held out.
    """
    if config.train_frame_indices is not None:
        return
    if not _in_time_range(recording, frames).any():
        first, last = seconds(frames.times[0]), seconds(frames.times[-1])
        raise FlagError(
            f"event-data --time-range holds none of the frames of {recording.path} to train on, which lie from {first} "
            f"to {last}; give a range that holds some."
        )
    if np.isin(frames.numbers, config.held_out_frame_indices or ()).all():
        raise FlagError(
            f"event-data --held-out-frame-indices takes all frames of {recording.path}, so that none is left to train "
            "on; leave some out, or state those of --train-frame-indices as well."
        )


def event_pictures(recording: EventRecording) -> Frames:
    """Instants along the trajectory, for a recording without frames. Their file names stand for no files.

    They are those of depth maps if the recording has some.
    """
    maps = recording.depth_maps
    if maps is not None:
        known = np.flatnonzero(maps.trajectory.covers(maps.times) & ~recording.in_left_out_gaps(maps.times))
        chosen = np.unique(np.linspace(0, len(known) - 1, NUM_EVENT_PICTURES).round().astype(int))
        if len(known):
            return maps.subset(known[chosen])
    times = recording.instants(NUM_EVENT_PICTURES + 2)[1:-1]
    names = tuple(recording.path / f"events_{i:05d}.png" for i in range(len(times)))
    return Frames(filenames=names, times=times, camera=recording.camera, trajectory=recording.trajectory)


def specification(format: Format) -> DataParserSpecification:
    """The sub-command of a format, for an entry point in the group nerfstudio.dataparser_configs."""
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
