"""Pictures of a trained run: held-out frames beside their renders, and a camera path past their poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.event_index import NO_EVENT, OFF_COLOUR, ON_COLOUR, event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.files import in_colour
from enerf_ns.dataparsers.recording.picture_depth import brightness
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced
from enerf_ns.evaluation.metrics import KNOWN, is_known
from enerf_ns.evaluation.views import HeldOutView

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from nerfstudio.cameras.cameras import Cameras

POLARITIES = {"brighter (on)": ON_COLOUR, "darker (off)": OFF_COLOUR, "no event": NO_EVENT}
"""Colours of an `event_picture` by meaning."""
EVENTS = "events"
"""Title of the column of events."""
UNKNOWN = "#c9ced8"
"""Colour of unknown values, grey."""
FAINTEST = 0.15
"""Opacity of depth whose confidence is 0."""
KEY_POSES = 7
"""Number of held-out cameras that the video flies past."""
VIDEO_SECONDS, VIDEO_FPS = 5.0, 20
VIDEO_PIXELS = 320 * 240
"""Most pixels of a frame of the video, so that it takes a minute on two CPU cores. Larger cameras are reduced."""


@dataclass(frozen=True)
class Column:
    """One column of the picture, with a cell for each view."""

    title: str
    pictures: Sequence[np.ndarray | None]
    """For each view, colours in [0, 1] (height, width, 3), or values (height, width), which are NaN if unknown."""
    bar: str = ""
    """Label of the values with their unit; empty if the pictures are colours."""
    colours: str = ""
    limits: tuple[float, float] = (0.0, 1.0)
    """Values at both ends of the colour scale."""
    opacities: Sequence[np.ndarray] | None = None
    """Opacity of each picture over grey, 0 to 1 (height, width). None: 1."""
    is_main: bool = True
    """Whether the column is shown first on the page."""

    def coloured(self, number: int) -> UInt8[np.ndarray, "height width 3"] | None:
        """The picture of a view in colours, 0 to 255; None if the view has none."""
        from matplotlib import colormaps
        from matplotlib.colors import to_rgb

        picture = self.pictures[number]
        if picture is None:
            return None
        colours = picture / 255.0 if picture.dtype == np.uint8 else picture
        if self.bar:
            low, high = self.limits
            grey, opacity = np.array(to_rgb(UNKNOWN)), np.isfinite(picture).astype(float)
            share = (np.where(np.isfinite(picture), picture, low) - low) / max(high - low, 1e-12)
            if self.opacities is not None:
                opacity = opacity * self.opacities[number]
            colours = grey + opacity[..., None] * (colormaps[self.colours](share.clip(0, 1))[..., :3] - grey)
        return np.rint(255.0 * colours.clip(0.0, 1.0)).astype(np.uint8)


def side_by_side(columns: Sequence[Column], views: Sequence[HeldOutView]) -> Figure:
    """Figure of the columns of views, with a row for each view.

    Args:
        columns: The `columns_of` the views.
        views: Views to show, at least one.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    height, width = views[0].rendered.shape[:2]
    sides = [*[height / width] * len(views), 0.28]  # the last row explains the colours
    figure = Figure(figsize=(2.35 * len(columns), 0.3 + 2.35 * sum(sides)), layout="constrained", dpi=110)
    axes = figure.subplots(len(views) + 1, len(columns), squeeze=False, height_ratios=sides)
    for column, below in zip(columns, axes.T, strict=True):
        below[0].set_title(column.title)
        opacities = column.opacities or [None] * len(views)
        for axis, picture, opacity in zip(below[:-1], column.pictures, opacities, strict=True):
            axis.set_xticks([])
            axis.set_yticks([])
            if picture is None:
                axis.text(0.5, 0.5, "none at this time", ha="center", va="center", transform=axis.transAxes)
                axis.spines[:].set_visible(False)
            elif column.bar:
                low, high = column.limits
                colours = colormaps[column.colours].with_extremes(bad=UNKNOWN)
                axis.set_facecolor(UNKNOWN)
                axis.imshow(picture, cmap=colours, vmin=low, vmax=high, alpha=opacity)
                shown = ScalarMappable(Normalize(low, high), colours)
            else:
                axis.imshow(picture)
        below[-1].axis("off")
        if column.bar:
            bar = below[-1].inset_axes((0.04, 0.72, 0.92, 0.22))
            figure.colorbar(shown, cax=bar, orientation="horizontal", label=column.bar)
        elif column.title == EVENTS:
            handles = [
                Patch(facecolor="#{:02x}{:02x}{:02x}".format(*colour), edgecolor="grey", label=what)
                for what, colour in POLARITIES.items()
            ]
            below[-1].legend(handles=handles, loc="upper center", frameon=False, fontsize=9, handlelength=1)
    if any(column.title == EVENTS for column in columns):
        for axis, view in zip(axes[:-1, 0], views, strict=True):
            axis.set_ylabel(f"{view.time * 1e-9:.2f} s")
    return figure


def columns_of(views: Sequence[HeldOutView], recording: EventRecording, exponent: float = 1.0) -> list[Column]:
    """Columns of views: frame, blurred frame, render, error, rendered, spread and true depth, and events.

    Columns that the recording has no data for are left out.

    Args:
        views: Views to show, at least one.
        recording: Recording of the events. Events are not shown for held-out frames with a clock of their own.
        exponent: Exponent of brightness for display.
    """
    rendered = [view.rendered.nan_to_num().clamp(0, 1).numpy() for view in views]
    recorded = [None if view.recorded is None else view.recorded.clamp(0, 1).numpy() for view in views]

    def shown(pictures: Sequence[np.ndarray | None]) -> list[np.ndarray | None]:
        return [None if picture is None else picture**exponent for picture in pictures]

    columns = []
    if any(picture is not None for picture in recorded):
        columns.append(Column("held-out frame", shown(recorded)))
    blurred = [_blurred_frame(recording, view.time) for view in views]
    if any(picture is not None for picture in blurred):
        columns.append(Column("blurred frame", shown(blurred), is_main=False))
    columns.append(Column("render", shown(rendered)))
    if any(picture is not None for picture in recorded):
        errors = [
            None if frame is None else view.rendered.mean(-1).numpy() - frame.mean(-1)
            for view, frame in zip(views, recorded, strict=True)
        ]
        most = max(_quantile([error for error in errors if error is not None], 0.99, absolute=True), 0.01)
        columns.append(Column("error", errors, "render minus frame", "PuOr_r", (-most, most)))
    depths = [view.depth[..., 0].numpy() for view in views if view.depth is not None]
    true = [_known_depth(view) for view in views]
    of_scene = [depth for depth in true if depth is not None] or depths or [np.zeros(0)]
    limits = _quantile(of_scene, 0.01), _quantile(of_scene, 0.99, otherwise=1.0)
    sure = [view.confidence[..., 0].numpy() for view in views if view.confidence is not None]
    spread = [view.spread_depth[..., 0].numpy() for view in views if view.spread_depth is not None]
    faded = [(confidence / KNOWN).clip(FAINTEST, 1.0) for confidence in sure] or None
    if depths:
        columns.append(
            Column("rendered depth", depths, "metres (pale: uncertain)" if sure else "metres", "viridis", limits, faded)
        )
    if spread:
        columns.append(Column("spread depth", spread, "metres", "viridis", limits, is_main=False))
    if any(depth is not None for depth in true):
        columns.append(Column("true depth", true, "metres (grey: unknown)", "viridis", limits, is_main=False))
    if recording.held_out_frames is None:
        index = index_events(recording)
        columns.append(Column(EVENTS, [event_picture(index, recording.camera, view.time) for view in views]))
    return columns


def _blurred_frame(recording: EventRecording, time: int) -> np.ndarray | None:
    """The blurred frame at an instant (ns), undistorted, in [0, 1] (height, width, 3); None if there is none."""
    frames = recording.blurred_frames
    if frames is None or recording.held_out_frames is not None or time not in frames.times:
        return None
    number = int(np.flatnonzero(frames.times == time)[0])
    return in_colour(brightness(frames.camera.undistort(frames.image(number))))


def _known_depth(view: HeldOutView) -> np.ndarray | None:
    """Recorded depth in metres, NaN where it is unknown (height, width)."""
    depth = view.recorded_depth
    return None if depth is None else torch.where(is_known(depth), depth, torch.nan)[..., 0].numpy()


def _quantile(pictures: Sequence[np.ndarray], share: float, absolute: bool = False, otherwise: float = 0.0) -> float:
    """Quantile of the finite values of all pictures; `otherwise` if there are none."""
    values = np.concatenate([picture[np.isfinite(picture)] for picture in pictures])
    return float(np.quantile(np.abs(values) if absolute else values, share)) if len(values) else otherwise


def camera_path(cameras: Cameras) -> dict:
    """A smooth flight past cameras, in the format that the viewer saves and `ns-render camera-path` reads.

    A cubic spline joins the positions of `KEY_POSES` cameras, and slerp their rotations. Pictures have at most
    `VIDEO_PIXELS` pixels, and an even width and height, which video players require.
    """
    chosen = np.unique(np.linspace(0, len(cameras) - 1, KEY_POSES).round().astype(int))
    poses = cameras.camera_to_worlds[chosen].double().cpu().numpy()
    if len(poses) == 1:
        poses = np.repeat(poses, 2, axis=0)
    flight = Trajectory(np.arange(len(poses)) * 10**9, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat())
    times = evenly_spaced(flight.start, flight.end, int(VIDEO_SECONDS * VIDEO_FPS))
    matrices = np.concatenate(
        [flight.poses(torch.from_numpy(times)).numpy(), np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(times), 1, 1))], axis=1
    )
    full = int(cameras.height[0]), int(cameras.width[0])
    scale = min(1.0, math.sqrt(VIDEO_PIXELS / (full[0] * full[1])))
    height, width = (max(2, int(scale * size) // 2 * 2) for size in full)
    fov = math.degrees(2.0 * math.atan(0.5 * height / (scale * float(cameras.fy[0]))))
    return {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "fps": VIDEO_FPS,
        "seconds": VIDEO_SECONDS,
        "camera_path": [
            {"camera_to_world": matrix.flatten().tolist(), "fov": fov, "aspect": width / height} for matrix in matrices
        ],
    }
