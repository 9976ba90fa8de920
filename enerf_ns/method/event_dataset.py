"""Pictures of a recording for Nerfstudio: its frames, or pictures of its events if it has no frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from enerf_ns.dataparsers.event_dataparser import scene_cameras
from enerf_ns.dataparsers.index.event_index import event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.picture_depth import brightness, in_8_bits
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.poses.corrections import Corrections


class EventDataset(InputDataset):
    """Frames, undistorted and as colour pictures; for recordings without frames, pictures of the events."""

    def __init__(self, dataparser_outputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        self.recording: EventRecording = self.metadata["recording"]
        frames: Frames = self.metadata["frames"]
        self.frames = replace(frames, downscale_factor=frames.downscale_factor / scale_factor)
        self._as_read, self._scale = (self.recording, self.frames), dataparser_outputs.dataparser_scale
        self.are_frames: bool = self.metadata["are_frames"]
        """Whether the pictures are frames; otherwise they show events."""

    def correct(self, corrections: Corrections) -> None:
        """Applies corrections of poses and lens to the recording and to the cameras of the pictures.

        They replace earlier corrections. Held-out views with a trajectory of their own are not corrected.
        """
        given, frames = self._as_read
        self.recording = corrections.recording(given)
        own = given.held_out_frames
        if own is None or frames.trajectory is not own.trajectory:
            self.frames = corrections.frames(frames, given)
        self.cameras = scene_cameras(self.frames, self.metadata["transform"], self._scale)

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """A picture of shape (height, width, 3): uint8, or float32 in [0, 1] for frames of more than 8 bits."""
        if not self.are_frames:
            time = int(self.frames.times[image_idx])
            return self.frames.downscaled(event_picture(index_events(self.recording), self.recording.camera, time))
        image = self.frames.picture(image_idx)
        return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image

    def get_image_float32(self, image_idx: int) -> Tensor:
        """A picture of shape (height, width, 3), float32 in [0, 1]."""
        return torch.from_numpy(brightness(self.get_numpy_image(image_idx)))

    def get_image_uint8(self, image_idx: int) -> Tensor:
        """A picture of shape (height, width, 3), uint8."""
        return torch.from_numpy(in_8_bits(self.get_numpy_image(image_idx)))

    def get_metadata(self, data: dict) -> dict:
        """`is_frame`, whether the picture is a frame, and `depth` if the recording has it: metres along the optical
        axis, shape (height, width, 1), 0 where unknown."""
        metadata: dict = {"is_frame": self.are_frames}
        depth = self.frames.depth(data["image_idx"])
        if depth is not None:
            metadata["depth"] = torch.from_numpy(depth)[..., None]
        return metadata
