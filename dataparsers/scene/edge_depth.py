"""Depth of the edges that events show, from events and poses alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced
from enerf_ns.dataparsers.scene.depth_range import grid_focal_length, grid_scale, rays_in_view, stretch_around

NUM_VIEWS = 12
"""Number of reference views, spread evenly over the events."""

BASELINE = 1.0
"""Extent of the camera's path around a view from which its rays come, as a multiple of the nearest depth."""

EVENTS_PER_VIEW = 300_000
"""Most events of a view, evenly taken. More of them do not make depth more accurate."""

MOST_EVENTS = 10_000_000
"""Most events of a recording, evenly taken, which bounds memory."""

INSTANTS = 1024
"""Instants of a span at which its poses are taken."""

RADIUS = 4
"""Contrast is measured in squares of 2 RADIUS + 1 pixels of the view."""

SMOOTHING = (0.12, 0.76, 0.12)
"""Weights by which votes are smoothed along each axis, since a vote falls on one whole pixel."""

MIN_RIDGE = 0.7
"""Fewest votes of the pixel of an edge, in standard deviations above the mean of its square."""

MIN_CONFIDENCE = 3.0
"""Smallest contrast at the best plane, as a multiple of the mean over all planes."""

NUM_NEIGHBOURS = 3
"""Number of views before, and of views after, that may confirm the depth of an edge."""

MIN_CONFIRMATIONS = 2
"""Smallest number of neighbours that confirm a depth."""

AGREEMENT = 0.02
"""Largest difference of a confirming depth, as a share of the depth."""


@dataclass(frozen=True, eq=False)
class EdgeView:
    """A reference view with the depth of the edges in it: a pinhole camera with square pixels."""

    time: int
    """Time of the view, ns."""
    pose: Float64[np.ndarray, "3 4"]
    """Camera to world (OpenCV axes, metres)."""
    focal_length: float
    """Focal length, pixels of the view."""
    principal_point: tuple[float, float]
    """Column and row of the principal point, pixels of the view."""
    depth: Float32[np.ndarray, "rows columns"]
    """Depth along the optical axis, metres; 0 where no edge has a depth that is known."""
    confidence: Float32[np.ndarray, "rows columns"]
    """Contrast of the votes at this depth, as a multiple of the mean over all depths; 0 where the depth is 0."""

    @property
    def points(self) -> Float64[np.ndarray, "edges 3"]:
        """Points of the edges in the world, metres, row by row."""
        rows, columns = np.nonzero(self.depth)
        depth = self.depth[rows, columns].astype(np.float64)[:, None]
        rays = np.stack([columns, rows], axis=1) - np.array(self.principal_point)
        ahead = depth * np.append(rays / self.focal_length, np.ones_like(depth), axis=1)
        return ahead @ self.pose[:, :3].T + self.pose[:, 3]

    def _keep(self, kept: Bool[np.ndarray, "rows columns"]) -> EdgeView:
        return replace(self, depth=np.where(kept, self.depth, 0), confidence=np.where(kept, self.confidence, 0))


@cache
def edge_depth(
    recording: EventRecording, depth_range: tuple[float, float], num_views: int = NUM_VIEWS
) -> list[EdgeView]:
    """Depth of the edges in reference views along the trajectory. It takes about 0.2 s of one core for each view, once
    for each recording and range in a process.

    This is event-based multi-view stereo (Rebecq et al., "EMVS", IJCV 2018): planes of a reference view collect votes
    from the viewing rays of events, which meet at the edges. The depth of a pixel is that of the plane where the
    contrast (variance) of the votes around it is largest, which tells textured surfaces apart from chance, where a
    maximum of the number of votes does not. A depth counts where the contrast is a multiple of its mean over all
    planes, where votes form a ridge, and where neighbouring views confirm it.

    Args:
        recording: Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth, metres.
        num_views: Number of views, at least 1.

    Returns:
        The views in time order. There is none at an instant where the camera does not move, or without poses.

    Raises:
        RecordingError: The events cannot be used.
    """
    near, far = depth_range
    index, trajectory = index_events(recording), recording.trajectory
    first, last = max(index.span[0], trajectory.start), min(index.span[1], trajectory.end)
    if first >= last:
        return []
    instants = evenly_spaced(first, last, 4 * INSTANTS)
    path = trajectory.poses(torch.from_numpy(instants))[:, :, 3].numpy()
    apart = trajectory.in_gaps(instants)
    events = index.events(at_most=MOST_EVENTS)
    views = []
    for time in evenly_spaced(first, last, 2 * num_views + 1)[1::2]:
        span = np.searchsorted(events.t, _span_around(time, BASELINE / 2 * near, instants, path, apart))
        if view := _view_at(time, events, span, recording.camera, trajectory, near, far):
            views.append(view)
    return _confirmed(views)


def _span_around(
    time: int, radius: float, instants: Int64[np.ndarray, " i"], path: np.ndarray, apart: np.ndarray
) -> Int64[np.ndarray, " 2"]:
    """First and last instant (ns) around a time while the camera stays within a radius (metres) of its place then."""
    now = int(np.clip(np.searchsorted(instants, time), 1, len(instants) - 2))
    left = (np.linalg.norm(path - path[now], axis=1) > radius) | apart
    return instants[stretch_around(now, left)]


def _view_at(
    time: int,
    events: Events,
    span: Int64[np.ndarray, " 2"],
    camera: Camera,
    trajectory: Trajectory,
    near: float,
    far: float,
) -> EdgeView | None:
    """The depth of all ridges with enough contrast, or None if the camera does not move.

    Args:
        span: Numbers of the first event that counts, and of the first after it that does not.
    """
    begin, end = span
    if end - begin < 2:
        return None
    chosen = slice(begin, end, -(-(end - begin) // EVENTS_PER_VIEW))
    x, y, t = events.x[chosen], events.y[chosen], events.t[chosen]
    instants = evenly_spaced(t[0], t[-1], INSTANTS)
    poses = trajectory.poses(torch.from_numpy(instants)).numpy()
    pose = trajectory.poses(torch.as_tensor(time)).numpy()
    baseline = float(np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)))
    if not baseline:
        return None
    nearest = np.searchsorted((instants[1:] + instants[:-1]) // 2, t)
    rays, centres, _ = rays_in_view(camera.pixel_directions()[y, x], poses[nearest], pose)
    scale, focal = grid_scale(camera), grid_focal_length(camera)
    principal_point = ((camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5)
    columns, rows = (round(side * scale) for side in (camera.width, camera.height))
    start = focal * rays[:, :2] + np.array(principal_point) + 0.5
    drift = (centres[:, :2] - centres[:, 2:] * rays[:, :2]) / baseline
    disparities = np.arange(focal * baseline / far, focal * baseline / near + 1)
    lines = np.concatenate([start, drift], axis=1).astype(np.float32)
    weights = np.array(SMOOTHING[1:], np.float32)
    plane, contrast, mean, ridge = compiled(_sweep, any_order=True)(
        lines, disparities.astype(np.float32), rows, columns, RADIUS, weights
    )
    confidence = contrast / (mean + 0.02 * mean.mean() + 1e-3)
    depth = (focal * baseline / (disparities[0] + plane)).astype(np.float32)
    view = EdgeView(int(time), pose, focal, principal_point, depth, confidence)
    return view._keep((ridge > MIN_RIDGE) & (confidence > MIN_CONFIDENCE))


def _sweep(lines, disparities, rows, columns, radius, weights):
    """Finds, for each pixel, the plane at which the contrast of the votes around it is largest.

    Returns:
        The plane, refined by a parabola; the contrast there; the mean contrast over the planes; and the votes there, in
        standard deviations above the mean of the square.
    """
    plane, total, best, ridge, before, last = np.zeros((6, rows, columns), np.float32)
    best[:] = -1.0
    margin, side = radius + 1, 2 * radius + 1
    votes, smooth = np.zeros((2, rows + 2 * margin, columns + 2 * margin), np.float32)
    in_row, squares_in_row = np.zeros((2, rows + 2 * margin, columns), np.float32)
    sums, squares = np.zeros((2, columns), np.float32)
    middle, outer = weights
    one, area, small = np.float32(1), np.float32(side * side), np.float32(1e-3)
    for p in range(len(disparities)):
        votes[:] = 0.0
        for i in range(len(lines)):
            x = lines[i, 0] + disparities[p] * lines[i, 2]
            y = lines[i, 1] + disparities[p] * lines[i, 3]
            if x >= 0 and y >= 0 and x < columns and y < rows:
                votes[int(y) + margin, int(x) + margin] += one
        for y in range(1, rows + 2 * margin - 1):
            for x in range(1, columns + 2 * margin - 1):
                beside = votes[y, x - 1] + votes[y, x + 1] + votes[y - 1, x] + votes[y + 1, x]
                across = votes[y - 1, x - 1] + votes[y - 1, x + 1] + votes[y + 1, x - 1] + votes[y + 1, x + 1]
                smooth[y, x] = middle * middle * votes[y, x] + middle * outer * beside + outer * outer * across
        for y in range(rows + 2 * margin):  # sums over a square are running sums along rows, then along columns
            vote, square = np.float32(0), np.float32(0)
            for x in range(1, side + 1):
                vote += smooth[y, x]
                square += smooth[y, x] ** 2
            for x in range(columns):
                in_row[y, x], squares_in_row[y, x] = vote, square
                new, old = smooth[y, x + side + 1], smooth[y, x + 1]
                vote += new - old
                square += new * new - old * old
        sums[:] = 0.0
        squares[:] = 0.0
        for y in range(1, side + 1):
            sums += in_row[y]
            squares += squares_in_row[y]
        for y in range(rows):
            for x in range(columns):
                mean = sums[x] / area
                contrast = max(squares[x] / area - mean * mean, np.float32(0))
                total[y, x] += contrast
                if contrast > best[y, x]:
                    best[y, x], before[y, x], plane[y, x] = contrast, last[y, x], p
                    ridge[y, x] = (smooth[y + margin, x + margin] - mean) / np.sqrt(contrast + small)
                elif plane[y, x] == p - 1 and p > 1:
                    bend = before[y, x] - 2 * best[y, x] + contrast
                    if bend < 0:
                        plane[y, x] += np.float32(0.5) * (before[y, x] - contrast) / bend
                last[y, x] = contrast
                sums[x] += in_row[y + side + 1, x] - in_row[y + 1, x]
                squares[x] += squares_in_row[y + side + 1, x] - squares_in_row[y + 1, x]
    return plane, best, total / np.float32(len(disparities)), ridge


def _confirmed(views: Sequence[EdgeView]) -> list[EdgeView]:
    """The views with those depths alone that enough neighbours confirm: all of them, where there are fewer views."""
    confirmed = []
    for i, view in enumerate(views):
        neighbours = [*views[max(i - NUM_NEIGHBOURS, 0) : i], *views[i + 1 : i + 1 + NUM_NEIGHBOURS]]
        confirmations = sum(
            (_confirmed_by(neighbour, view) for neighbour in neighbours), np.zeros(view.depth.shape, int)
        )
        confirmed.append(view._keep(confirmations >= min(MIN_CONFIRMATIONS, len(neighbours))))
    return confirmed


def _confirmed_by(neighbour: EdgeView, view: EdgeView) -> Bool[np.ndarray, "rows columns"]:
    """The pixels of a view whose points another view sees at the same depth, within a pixel."""
    seen = (view.points - neighbour.pose[:, 3]) @ neighbour.pose[:, :3]
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.inf)
    rows, columns = neighbour.depth.shape
    place = seen[:, :2] / depth[:, None] * neighbour.focal_length + np.array(neighbour.principal_point)
    around = np.pad(neighbour.depth, 2)
    x, y = (np.rint(place).clip(-1, (columns, rows)).astype(int) + 2).T
    agree = np.zeros(len(depth), bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            agree |= np.abs(around[y + down, x + right] - depth) < AGREEMENT * depth
    found = np.zeros(view.depth.shape, bool)
    found[np.nonzero(view.depth)] = agree
    return found
