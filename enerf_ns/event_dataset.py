"""Pictures of a recording for Nerfstudio: its frames, or its events where it has none."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from enerf_ns.dataparsers.recording import EventRecording, Frames, load_array, load_image

EVENTS_IN_PICTURE = 0.2
"""Events drawn into one picture, as a share of the sensor's pixels."""


class EventDataset(InputDataset):
    """Frames, undistorted and as colour pictures; for recordings without frames, pictures of the events."""

    def __init__(self, dataparser_outputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        self.recording: EventRecording = self.metadata["recording"]
        self.frames: Frames = self.metadata["frames"]

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Picture of shape (height, width, 3), uint8."""
        if not self.recording.has_frames:
            return event_picture(self.recording, int(self.frames.times[image_idx]))
        image = self.frames.camera.undistort(load_image(self.frames.filenames[image_idx]))
        return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image

    def get_metadata(self, data: dict) -> dict:
        """is_frame: whether the picture is a frame. depth, where the recording has it: metres along the optical axis
        (height, width, 1), 0 where unknown."""
        metadata: dict = {"is_frame": self.recording.has_frames}
        if self.frames.depth_filenames is not None:
            depth = load_array(self.frames.depth_filenames[data["image_idx"]])
            metadata["depth"] = torch.from_numpy(depth)[..., None].float()
        return metadata


def event_picture(recording: EventRecording, time: int) -> np.ndarray:
    """The latest events before an instant on white: positive ones red, negative ones blue.

    Args:
        recording: Events and camera.
        time: Instant in ns.

    Returns:
        Undistorted picture (height, width, 3), uint8.
    """
    events, camera = recording.events, recording.camera
    last = int(np.searchsorted(events.t, time, side="right"))
    first = max(0, last - int(EVENTS_IN_PICTURE * camera.width * camera.height))
    picture = np.full((camera.height, camera.width, 3), 255, dtype=np.uint8)
    on = events.p[first:last, None] > 0
    picture[events.y[first:last], events.x[first:last]] = np.where(on, (205, 50, 50), (50, 70, 205))
    return camera.undistort(picture)
