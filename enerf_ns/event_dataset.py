"""Pictures of a recording for Nerfstudio: its frames, or its events where it has none."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from enerf_ns.dataparsers.event_index import event_picture
from enerf_ns.dataparsers.files import load_array, load_image
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording, Frames


class EventDataset(InputDataset):
    """Frames, undistorted and as colour pictures; for recordings without frames, pictures of the events."""

    def __init__(self, dataparser_outputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        self.recording: EventRecording = self.metadata["recording"]
        self.frames: Frames = self.metadata["frames"]
        self.are_frames: bool = self.metadata["are_frames"]
        """Whether the pictures are frames; otherwise they show events."""

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Picture of shape (height, width, 3), uint8."""
        if not self.are_frames:
            return event_picture(index_events(self.recording), self.recording.camera, int(self.frames.times[image_idx]))
        image = self.frames.camera.undistort(load_image(self.frames.filenames[image_idx]))
        return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image

    def get_metadata(self, data: dict) -> dict:
        """is_frame: whether the picture is a frame. depth, where the recording has it: metres along the optical axis
        (height, width, 1), 0 where unknown."""
        metadata: dict = {"is_frame": self.are_frames}
        if self.frames.depth_filenames is not None:
            depth = load_array(self.frames.depth_filenames[data["image_idx"]])
            metadata["depth"] = torch.from_numpy(depth)[..., None].float()
        return metadata
