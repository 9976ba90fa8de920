"""What the layouts of folders ask of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from enerf_ns.dataparsers.camera import Camera
from enerf_ns.dataparsers.formats import eds, tum_vie
from enerf_ns.simulator.writers import FEWEST_ESIM_FRAMES


@dataclass(frozen=True)
class Layout:
    """What a recording has to have, or has unless the user says otherwise."""

    published_rig: tuple[Camera, Camera, np.ndarray] | None = None
    """Cameras of events and of frames, and the pose [4, 4] of the latter in the axes of the former (metres), that the
    data set was recorded with; None if the layout is no data set's."""
    fewest_frames: int = 1
    poses_per_second: int | None = None
    """As many as the data set has; None: as many as the trajectory has."""
    ends_before_last_frame: bool = False
    """Whether events from a microsecond before the last frame on are left out."""


LAYOUTS = {
    "esim": Layout(fewest_frames=FEWEST_ESIM_FRAMES),
    "eds": Layout(
        published_rig=(eds.PUBLISHED_EVENT_CAMERA, eds.PUBLISHED_RGB_CAMERA, eds.PUBLISHED_EXTRINSICS),
        ends_before_last_frame=True,  # since E-NeRF's loader wants a frame that is later than the last event
    ),
    "tum_vie": Layout(
        published_rig=(tum_vie.PUBLISHED_EVENT_CAMERA, tum_vie.PUBLISHED_FRAME_CAMERA, tum_vie.PUBLISHED_EXTRINSICS),
        poses_per_second=tum_vie.POSES_PER_SECOND,
    ),
    "event_recording": Layout(),
}
