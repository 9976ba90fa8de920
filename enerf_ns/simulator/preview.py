"""Preview video of a simulation: frame, blurred frame, events and depth, side by side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.files import in_colour, partial_of
from enerf_ns.dataparsers.recording.recording import Events

OFF_COLOUR, NO_COLOUR, ON_COLOUR = (50, 70, 205), (255, 255, 255), (205, 50, 50)
"""Colours (R G B) of pixels whose latest event is an off event, of pixels without events, and of pixels whose latest
event is an on event."""


class Preview:
    """Writes one picture of the video for each frame of the recording; to be used in a `with` statement.

    From left to right: the sharp frame; the blurred frame, if there is one; the latest event of each pixel since the
    frame before; inverse depth, if there is depth, from near (red) to far (blue), and black where no surface is seen.
    All have the height of the frames. The video plays at 10 frames per second.

    Args:
        path: New .mp4 file. It appears, whole, when the block ends.
        width, height: Size of the event camera, pixels.
    """

    def __init__(self, path: Path, width: int, height: int):
        self.path = path
        self._partial = partial_of(path)
        self._events = np.full((height, width, 3), NO_COLOUR, np.uint8)
        self._inverse_depths: tuple[float, float] | None = None
        self._video = None

    def add_events(self, events: Events) -> None:
        """Adds events that are later than all events added before."""
        self._events[events.y, events.x] = np.where((events.p > 0)[:, None], ON_COLOUR, OFF_COLOUR)

    def add_frame(
        self,
        sharp: UInt8[np.ndarray, "height width *channels"],
        blurred: UInt8[np.ndarray, "height width *channels"] | None,
        depth: Float[np.ndarray, "height width"] | None,
    ) -> None:
        """Adds a picture with the events since the frame before.

        Every frame must have the same of `blurred` and `depth`.

        Args:
            sharp, blurred: Pictures of the frame camera, grey or R G B.
            depth: Metres, 0 where no surface is seen.

        Raises:
            OutputError: The video cannot be written.
        """
        height = sharp.shape[0]
        events_width = round(self._events.shape[1] * height / self._events.shape[0])
        events = cv2.resize(self._events, (events_width, height), interpolation=cv2.INTER_AREA)
        panels = [in_colour(sharp), None if blurred is None else in_colour(blurred), events]
        panels.append(None if depth is None else self._colour_depth(depth))
        picture = np.concatenate([panel for panel in panels if panel is not None], axis=1)
        odd_height, odd_width = height % 2, picture.shape[1] % 2  # since the format of the video needs even sizes
        picture = np.pad(picture, ((0, odd_height), (0, odd_width), (0, 0)), mode="edge")
        try:
            if self._video is None:
                self._video = self._open(picture.shape[1], picture.shape[0])
            self._video.send(picture.tobytes())
        except OSError as error:
            raise self._failure() from error
        self._events[:] = NO_COLOUR

    def __enter__(self) -> Preview:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        """Finishes the video."""
        if self._video is None:
            return
        try:
            self._video.close()
            if cv2.VideoCapture(str(self._partial)).isOpened():
                self._partial.replace(self.path)
            elif kind is None:
                raise self._failure()
        finally:
            self._partial.unlink(missing_ok=True)

    def _open(self, width: int, height: int):
        from imageio_ffmpeg import write_frames

        video = write_frames(
            str(self._partial),
            (width, height),
            fps=10,
            codec="libx264",
            quality=7,
            macro_block_size=2,
            ffmpeg_log_level="quiet",
        )
        video.send(None)
        return video

    def _colour_depth(self, depth: np.ndarray) -> np.ndarray:
        """Inverse depth in colours, scaled to the range of the first frame with depth."""
        seen = depth > 0
        inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=seen)
        if self._inverse_depths is None and seen.any():
            self._inverse_depths = inverse[seen].min(), inverse[seen].max()
        far, near = self._inverse_depths or (0.0, 1.0)
        share = (inverse - far) / max(near - far, 1e-9)
        levels = np.rint(255 * share.clip(0, 1)).astype(np.uint8)
        return np.where(seen[..., None], cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1], 0).astype(np.uint8)

    def _failure(self) -> OutputError:
        return OutputError(
            f"{self.path} could not be written as a video; make room on the disk or simulate without --preview."
        )
