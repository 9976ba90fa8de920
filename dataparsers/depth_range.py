"""How near and how far the scene lies, from events and poses alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from jaxtyping import Float64
from rich.progress import track

from enerf_ns.dataparsers.camera import Camera
from enerf_ns.dataparsers.errors import FlagError, RecordingError
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording, Events
from enerf_ns.dataparsers.trajectory import Trajectory, evenly_spaced

GRID_WIDTH = 240  # of the view that votes are cast into, coarse enough for the number of events
TILE = 16
EVENTS_PER_SWEEP = 20_000
DISPARITIES = np.concatenate([np.arange(0.0, 8.0, 0.5), np.arange(8.0, 65.0)])  # grid pixels
SMALLEST_DISPARITY, LARGEST_DISPARITY = 2.0, 60.0  # of a peak inside the swept range
MIN_PEAK = 2.5  # of the dispersion of votes, relative to its median over the planes
MIN_GAIN = 1.5  # relative to the plane at infinity
MIN_VOTES = 0.1  # a grid pixel

EVENTS_FOR_DEPTH = 4_000_000
"""Number of events that measure the depth of the scene, where there are more."""


def scene_depth_range(recording: EventRecording, stated: tuple[float, float] | None = None) -> tuple[float, float]:
    """Nearest and farthest depth in metres: the one stated, the recording's own, or measured from its events.

    Raises:
        FlagError: What is stated is no range.
        RecordingError: The events do not show how deep the scene is.
    """
    if stated is None:
        return recording.depth_range or _measured_depth_range(recording)
    near, far = stated
    if not 0.0 < near < far < np.inf:
        raise FlagError(f"{recording.path}: the depth range is {near} to {far} m; expected 0 < near < far")
    return near, far


@cache
def _measured_depth_range(recording: EventRecording) -> tuple[float, float]:
    """Depth range measured from a recording's events; takes seconds, and is done once for a recording in a process."""
    events = index_events(recording).events(at_most=EVENTS_FOR_DEPTH)
    posed = ~recording.in_left_out_gaps(events.t)
    events = Events(events.x[posed], events.y[posed], events.t[posed], events.p[posed])
    try:
        return estimate_depth_range(events, recording.camera, recording.trajectory)
    except ValueError as error:
        raise RecordingError(
            f"{recording.path}: {str(error).rstrip('.')}, with --depth-range NEAR FAR of the data parser (metres)."
        ) from error


def estimate_depth_range(events: Events, camera: Camera, trajectory: Trajectory) -> tuple[float, float]:
    """Near and far bound of the depth (along the optical axis) at which the event camera saw the scene, in metres.

    A space sweep (Rebecq et al., "EMVS: Event-based Multi-View Stereo", IJCV 2018): the viewing rays of the events of
    an edge meet where the edge is. Rays from within half a baseline of a reference view are cut by planes parallel to
    its image, evenly spaced in disparity. Where the cuts pile up is told, for each tile of the view, by the dispersion
    (variance over mean) of their counts; the variance is the objective of Gallego et al., "A Unifying Contrast
    Maximization Framework", CVPR 2018. Nothing depends on the unit of length: baselines are the extent of the camera's
    path and its halvings.

    Args:
        events: In time order, within the span of the trajectory.
        camera: Of the events.
        trajectory: Of that camera.

    Returns:
        0.7 times the 2nd and 1.4 times the 98th percentile of the depths of all tiles where the cuts pile up clearly.

    Raises:
        ValueError: There are no such tiles: the camera only turns, moves too little, or saw too few events.
    """
    depths = np.empty(0)
    extent = 0.0
    if len(events):
        directions = camera.pixel_directions()
        path_times = evenly_spaced(events.t[0], events.t[-1], 2000)
        path_times = path_times[trajectory.in_gaps(events.t).any() | ~trajectory.in_gaps(path_times)]
        path = trajectory.poses(torch.from_numpy(path_times))[:, :, 3].numpy()
        extent = float(np.linalg.norm(np.ptp(path, axis=0)))
        generator = np.random.default_rng(0)
        references = events.t[len(events) // 24 :: len(events) // 12 + 1]
    if extent > 0:
        sweeps = []
        for level in track(range(6), "Measuring the depth of the scene", transient=True):
            baseline = extent / 2**level
            for reference in references:
                chosen = _events_seen_within(baseline / 2, reference, events, path_times, path)
                if len(chosen) > EVENTS_PER_SWEEP:
                    chosen = generator.choice(chosen, EVENTS_PER_SWEEP, replace=False)
                rays, centres = _in_view(
                    directions[events.y[chosen], events.x[chosen]],
                    trajectory.poses(torch.from_numpy(events.t[chosen])).numpy(),
                    trajectory.poses(torch.as_tensor(reference)).numpy(),
                )
                sweeps.append(_sweep(rays, centres / baseline, camera) * baseline)
        depths = np.concatenate(sweeps)
    if not len(depths):
        raise ValueError(
            f"The depth range of the scene cannot be measured, because the camera's path spans {extent:.3g} m and its "
            f"{len(events)} events show no parallax: state the range."
        )
    near, far = np.percentile(depths, [2, 98])
    return 0.7 * float(near), 1.4 * float(far)


def _events_seen_within(radius: float, reference: int, events: Events, path_times, path) -> np.ndarray:
    """Indices of the events around a time, while the camera stays within a radius (metres) of its place then."""
    now = np.clip(np.searchsorted(path_times, reference), 1, len(path_times) - 1)
    outside = np.flatnonzero(np.linalg.norm(path - path[now], axis=1) > radius)
    limits = np.concatenate([[0], outside, [len(path_times) - 1]])
    after = np.searchsorted(limits, now)
    first, last = np.searchsorted(events.t, path_times[limits[after - 1 : after + 1]])
    return np.arange(first, last)


def _in_view(
    directions: Float64[np.ndarray, "rays 3"],
    poses: Float64[np.ndarray, "rays 3 4"],
    view: Float64[np.ndarray, "3 4"],
) -> tuple[Float64[np.ndarray, "rays 3"], Float64[np.ndarray, "rays 3"]]:
    """Directions (z = 1) and centres of rays in the axes of a view; rays that hardly go its way are left out."""
    rays = np.einsum("nij,nj->ni", poses[:, :, :3], directions) @ view[:, :3]
    centres = (poses[:, :, 3] - view[:, 3]) @ view[:, :3]
    ahead = rays[:, 2] > 0.1
    return rays[ahead] / rays[ahead, 2:], centres[ahead]


def _sweep(
    rays: Float64[np.ndarray, "rays 3"],
    centres: Float64[np.ndarray, "rays 3"],
    camera: Camera,
) -> Float64[np.ndarray, " tiles"]:
    """Depths, in baselines, of the tiles of the view whose votes pile up clearly at one plane.

    A ray a (z = 1) from c meets the plane of depth z at c + (z - c_z) a, which the view sees at a + (c - c_z a) / z.
    """
    scale = GRID_WIDTH / camera.width
    focal, columns, rows = camera.fx * scale, GRID_WIDTH // TILE, round(camera.height * scale) // TILE
    start = focal * rays[:, :2] + np.array([camera.cx, camera.cy]) * scale
    drift = centres[:, :2] - centres[:, 2:] * rays[:, :2]
    dispersion = np.zeros((len(DISPARITIES), rows, columns))
    votes = np.zeros_like(dispersion)
    for plane, disparity in enumerate(DISPARITIES):
        x, y = np.rint(start + disparity * drift).astype(np.int64).T
        inside = (x >= 0) & (x < columns * TILE) & (y >= 0) & (y < rows * TILE)
        area = (1 - disparity / focal * centres[inside, 2]) ** 2  # so that magnification does not look like focus
        counts = np.bincount(y[inside] * columns * TILE + x[inside], area, rows * columns * TILE**2)
        tiles = counts.reshape(rows, TILE, columns, TILE)
        votes[plane] = tiles.mean((1, 3))
        dispersion[plane] = tiles.var((1, 3)) / np.maximum(votes[plane], 1e-9)
    peak = dispersion.argmax(0)[None]
    disparity = DISPARITIES[peak]
    clear = (
        (dispersion.max(0) > np.maximum(MIN_PEAK * np.median(dispersion, 0), MIN_GAIN * dispersion[0]))
        & (np.take_along_axis(votes, peak, 0) > MIN_VOTES)
        & (disparity >= SMALLEST_DISPARITY)
        & (disparity <= LARGEST_DISPARITY)
    )
    return focal / disparity[clear]
