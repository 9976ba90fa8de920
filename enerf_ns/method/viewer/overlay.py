"""What the viewer draws over a render: events where surfaces saw them, brightness for the eye, depth in metres."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR, EventIndex
from enerf_ns.dataparsers.recording.camera import Camera

EVENT_OPACITY = 0.75
"""Share of an event's colour in that of the pixel it is drawn on."""

MOSTLY_EVENT = 96
"""Of 255, how much of a pixel without distortion an event covers that is drawn there."""


def for_the_eye(
    brightness: Float[Tensor, "*batch 3"], stops: float, gamma: float, share: Float[Tensor, "*batch 1"], behind: Tensor
) -> Float[Tensor, "*batch 3"]:
    """Brightness as a display shows it: doubled by each stop, to the power 1 / gamma, clipped to [0, 1].

    Args:
        brightness: Rendered, from 0 on.
        stops: Of exposure, of any sign.
        gamma: Above 0; 1 leaves brightness linear.
        share: Of each ray that surfaces stop, in [0, 1].
        behind: Colour, shape (3,), of what is behind them.
    """
    seen = (brightness * 2.0**stops).clamp(0.0, 1.0) ** (1.0 / gamma)
    return (seen + (1.0 - share) * behind).clamp(max=1.0)


def recent_events(index: EventIndex, camera: Camera, first: int, last: int) -> UInt8[np.ndarray, "height width 2"]:
    """Where a sensor's pixels became brighter, and where darker, after a time and until another (ns).

    Returns:
        255 at pixels whose events are more often positive than negative, and at those where it is the other way round
        or even; 0 elsewhere. As the camera without distortion sees it, where values between are edges.
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
    """Colours of points, with those of the events of a camera that sees them, whether something lies between or not.

    Args:
        rgb: In [0, 1].
        points: In the scene.
        events: As of `recent_events`.
        camera: Without distortion.
        scene_from_camera: Its pose in the scene, OpenCV axes.
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
