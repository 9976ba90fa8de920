"""Pictures of the viewer: brightness encoded for a display, and events drawn on the surfaces that caused them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR, EventIndex
from enerf_ns.dataparsers.recording.camera import Camera

SQUARES, DARKER = 40, 0.8
"""Number of squares along the longer side of a picture where nothing is known, and brightness of the darker ones."""

EVENT_OPACITY = 0.75
"""Opacity of an event that is drawn on a pixel."""

MOSTLY_EVENT = 96
"""Least part of an undistorted pixel, of 255, that events must cover to be drawn there."""


def for_the_eye(brightness: Float[Tensor, "*batch 3"], stops: float, gamma: float) -> Float[Tensor, "*batch 3"]:
    """Brightness as a display shows it: doubled by each stop, to the power 1 / gamma, clipped to [0, 1].

    Args:
        brightness: Rendered brightness, 0 or more.
        stops: Stops of exposure, of any sign.
        gamma: Exponent above 0; with 1, brightness stays linear.
    """
    return (brightness * 2.0**stops).clamp(0.0, 1.0) ** (1.0 / gamma)


def unknown(size: Sequence[int], colour: tuple[int, int, int]) -> Float[Tensor, "height width 3"]:
    """A picture of squares in a colour and a darker one, shown where nothing is known: no scene looks like that.

    Args:
        size: Height and width in pixels.
        colour: Colour of the lighter squares, 0 to 255.
    """
    side = max(1, round(max(size) / SQUARES))
    rows, columns = (torch.arange(number) // side for number in size)
    is_dark = (rows[:, None] + columns) % 2 == 1
    return torch.tensor(colour) / 255.0 * torch.where(is_dark, DARKER, 1.0)[..., None]


def recent_events(index: EventIndex, camera: Camera, first: int, last: int) -> UInt8[np.ndarray, "height width 2"]:
    """The pixels with events between two times (ns), after the first and up to the last.

    Returns:
        Two undistorted pictures. The first is 255 at pixels with more positive than negative events, the second at all
        other pixels with events. Values between 0 and 255 are edges of pixels, from the undistortion.
    """
    pixels = torch.arange(camera.width * camera.height, device=index.times.device)
    begin, end = (index.offsets[pixels] + index.count_until(pixels, torch.full_like(pixels, t)) for t in (first, last))
    counted = torch.cat([index.positives.new_zeros(1), index.positives])
    positive, number = counted[end] - counted[begin], end - begin
    on = 2 * positive > number
    picture = torch.stack([on, (number > 0) & ~on], dim=-1).to(torch.uint8) * 255
    return camera.undistort(picture.reshape(camera.height, camera.width, 2).cpu().numpy())


def draw_events(
    rgb: Float[Tensor, "*batch 3"],
    points: Float[Tensor, "*batch 3"],
    events: UInt8[np.ndarray, "height width 2"],
    camera: Camera,
    scene_from_camera: Float64[np.ndarray, "3 4"],
) -> Float[Tensor, "*batch 3"]:
    """Colours of points, with the events of a camera drawn on them. Occlusion is ignored.

    Args:
        rgb: Colours of the points, in [0, 1].
        points: Points in the scene, scene units.
        events: Pictures of `recent_events`.
        camera: Camera of the events, without distortion.
        scene_from_camera: Pose of the camera in the scene, OpenCV axes.
    """
    pose = torch.from_numpy(scene_from_camera).to(points)
    x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).unbind(-1)
    columns = (camera.fx * x / z + camera.cx).round()
    rows = (camera.fy * y / z + camera.cy).round()
    inside = (z > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    pixels = (rows * camera.width + columns).where(inside, 0.0).long()
    fired = (torch.from_numpy(events).to(points.device).reshape(-1, 2)[pixels] >= MOSTLY_EVENT) & inside[..., None]
    for polarity, colour in enumerate((ON_COLOUR, OFF_COLOUR)):
        drawn = (1.0 - EVENT_OPACITY) * rgb + EVENT_OPACITY * rgb.new_tensor(colour) / 255.0
        rgb = torch.where(fired[..., polarity, None], drawn, rgb)
    return rgb
