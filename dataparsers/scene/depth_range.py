"""Depth range of a scene, from events and poses alone, by a plane sweep."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float64
from rich import get_console
from rich.progress import track

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, quoted
from enerf_ns.dataparsers.recording.recording import DEPTH_LIMITS, EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced

GRID_WIDTH = 240
"""Largest width of the grid that rays cast their votes into, pixels: coarse enough for the number of events."""

TILE = 16
"""Side of a tile, grid pixels."""

EVENTS_PER_SWEEP = 20_000
"""Most events of one plane sweep."""

DISPARITIES = np.concatenate([np.arange(0.0, 8.0, 0.5), np.arange(8.0, 65.0)])
"""Disparities of the planes, grid pixels."""

SMALLEST_DISPARITY, LARGEST_DISPARITY = 2.0, 60.0
"""Limits of the disparity of a peak, grid pixels, inside the range of the planes."""

MIN_PEAK = 2.5
"""Smallest dispersion of the votes at a peak, relative to the median over the planes."""

MIN_GAIN = 1.5
"""Smallest dispersion of the votes at a peak, relative to the plane at infinity."""

MIN_VOTES = 0.1
"""Fewest votes per grid pixel at a peak."""

FARTHEST_DISPARITY = 8.0
"""Disparity (grid pixels) at which the sweep for `measure_share_beyond` places the farthest depth, so that it differs
clearly from infinity."""

MIN_TILES = 20
"""Fewest tiles with a depth that show parallax. If a camera only turns, about a dozen have one by chance."""

MIN_CHANCE_RATIO = 3.0
"""Smallest ratio of tiles with a depth to those by chance. If a camera only turns, it stays below 2."""

MIN_SHARE_AT_INFINITY = 0.5
"""Fewest tiles that rotation explains over the whole path, relative to the part of it that rotation explains best. If a
camera only turns, it is at least 0.7; if the scene moves by 3 to 6 pixels beside the rotation, it is 0.2
(`benchmarks/parallax.py`)."""

PANORAMA_DISTANCE = 1000.0
"""Distance of a scene before a camera that only turns, as a multiple of the extent of the camera's path."""

MIN_SHARE_IN_RANGE = 0.2
"""Share of the measured depths within a depth range, below which the range is taken for a wrong one."""

EVENTS_FOR_DEPTH = 4_000_000
"""Most events that measure the depth of the scene."""


class UnknownDepthError(RecordingError):
    """The events do not show how deep the scene is.

    Args:
        recording: Recording without a stated depth range.
        reason: Reason as a clause, which can follow "because".
    """

    def __init__(self, recording: EventRecording, reason: str):
        self.reason = reason
        super().__init__(
            f"{recording.path}: the depth range of the scene cannot be measured, because {reason}; look at it with "
            f"enerf inspect {quoted(recording.path)}, and if its poses are right, state the range with --depth-range "
            "NEAR FAR of the data parser (metres)."
        )


@dataclass(frozen=True, eq=False)
class Parallax:
    """Depths at which a moving camera saw events, with planes behind the camera as the control."""

    depths: Float64[np.ndarray, " tiles"]
    """Depths along the optical axis, metres, of all tiles whose votes have a clear peak at one plane."""
    num_by_chance: int
    """Number of tiles with a clear peak behind the camera, where nothing is seen. About as many of `depths` are
    wrong."""
    at_infinity: tuple[int, ...]
    """Number of tiles with a clear peak at infinity, which the camera's rotation alone explains: over the whole path,
    and over parts of it, each half as wide as the one before."""
    extent: float
    """Diagonal of the box around the camera's path, metres."""

    @property
    def is_shown(self) -> bool:
        """Whether there are more depths than chance explains."""
        return len(self.depths) > MIN_TILES + MIN_CHANCE_RATIO * self.num_by_chance

    @property
    def is_ruled_out(self) -> bool:
        """Whether the camera only turns, or the whole scene is too far away for the camera's motion.

        Its rotation explains the events then, over its whole path about as well as over a short part of it.
        """
        if self.is_shown or not self.extent:
            return not self.is_shown
        of_path = self.at_infinity[0]
        others = len(self.depths) + self.num_by_chance
        return of_path > max(MIN_TILES, others, MIN_SHARE_AT_INFINITY * max(self.at_infinity))

    @property
    def depth_range(self) -> tuple[float, float]:
        """0.7 times the 2nd and 1.4 times the 98th percentile of the depths, metres."""
        near, far = np.percentile(self.depths, [2, 98])
        return 0.7 * float(near), 1.4 * float(far)

    @property
    def why_ruled_out(self) -> str:
        """The evidence for `is_ruled_out` as a clause."""
        if not self.extent:
            return "all its positions are the same"
        return (
            f"its path spans {self.extent:.2g} m, over which its rotation alone explains {self.at_infinity[0]:,} parts "
            f"of the views, depths explain {len(self.depths):,}, and depths behind the camera, which are chance, "
            f"explain {self.num_by_chance:,}"
        )

    @property
    def panorama_range(self) -> tuple[float, float]:
        """A range, metres, so far away that the camera's motion moves no point of it; for a camera that only turns."""
        near = min(max(1.0, PANORAMA_DISTANCE * self.extent), DEPTH_LIMITS[1] / 2.0)
        return near, 2.0 * near

    def contradicts(self, depth_range: tuple[float, float]) -> bool:
        """Whether hardly any of the depths lie within a range (nearest, farthest; metres)."""
        near, far = depth_range
        within = (self.depths > near) & (self.depths < far)
        return self.is_shown and bool(np.mean(within) < MIN_SHARE_IN_RANGE)


def scene_depth_range(recording: EventRecording, stated: tuple[float, float] | None = None) -> tuple[float, float]:
    """Nearest and farthest depth of a scene, metres.

    If the camera only turns, the scene is taken to be far away, where the camera's motion moves no point of it.

    Args:
        recording: Its index is made if it is not there yet.
        stated: Range that is returned if it is given. Default: the recording's own range, else a measured one.

    Raises:
        FlagError: `stated` is no range.
        UnknownDepthError: The events do not show how deep the scene is.
        RecordingError: The events cannot be used.
    """
    if stated is None:
        return recording.depth_range or _measured_depth_range(recording)
    near, far = stated
    if not 0.0 < near < far < np.inf:
        raise FlagError(f"{recording.path}: the depth range is {near} to {far} m; expected 0 < near < far")
    return near, far


def _measured_depth_range(recording: EventRecording) -> tuple[float, float]:
    parallax = recording_parallax(recording)
    if parallax.is_ruled_out:
        return parallax.panorama_range
    if not parallax.is_shown:
        raise UnknownDepthError(
            recording,
            f"its path spans {parallax.extent:.3g} m, and its events show neither parallax nor that it only turns",
        )
    return parallax.depth_range


@cache
def recording_parallax(recording: EventRecording) -> Parallax:
    """The parallax of a recording's events. Takes seconds, once for each recording in a process."""
    return measure_parallax(_posed_events(recording), recording.camera, recording.trajectory)


@cache
def share_beyond(recording: EventRecording, depth_range: tuple[float, float]) -> float:
    """Share of a recording's events that come from beyond a depth range (nearest, farthest; metres), from 0 to 1.

    `measure_share_beyond` measures it. Takes a second, once for each recording and range in a process.
    """
    return measure_share_beyond(_posed_events(recording), recording.camera, recording.trajectory, depth_range)


def _posed_events(recording: EventRecording) -> Events:
    """At most `EVENTS_FOR_DEPTH` of the events, without those in gaps of the poses that are left out."""
    events = index_events(recording).events(at_most=EVENTS_FOR_DEPTH)
    posed = ~recording.in_left_out_gaps(events.t)
    return Events(events.x[posed], events.y[posed], events.t[posed], events.p[posed])


def measure_parallax(events: Events, camera: Camera, trajectory: Trajectory) -> Parallax:
    """Depths at which the event camera saw the scene, and how many of them are chance.

    This is a plane sweep (Rebecq et al., "EMVS: Event-based Multi-View Stereo", IJCV 2018). The viewing rays of the
    events of an edge meet at the edge. Planes parallel to the image of a reference view, evenly spaced in disparity,
    cut the rays from within half a baseline of that view. Each cut is a vote in the grid of the view. The dispersion
    (variance over mean) of the votes in a tile peaks at the plane where the rays meet. The variance is the objective of
    Gallego et al., "A Unifying Contrast Maximization Framework", CVPR 2018. The unit of length has no influence:
    baselines are the extent of the camera's path and its halvings. The same planes behind the camera, where rays of a
    scene never meet, are the control. Without parallax, or with noise of the poses alone, there are as many peaks
    behind the camera as in front.

    Args:
        events: In time order, within the span of the trajectory.
        camera: Of the events.
        trajectory: Of that camera.
    """
    path = _path(events, trajectory)
    extent, depths, num_by_chance = _extent(path[1]), [np.empty(0)], 0
    is_file = not get_console().is_terminal  # in which a bar leaves an empty line
    of_parts = extent / 2.0 ** np.arange(6)
    at_infinity = dict.fromkeys(of_parts.tolist(), 0)
    baselines = track(of_parts, "Measuring the depth of the scene", transient=True, disable=is_file)
    planes = np.concatenate([DISPARITIES, -DISPARITIES])
    for baseline, sweep in _sweeps(events, camera, trajectory, path, baselines, planes):
        ahead, behind = np.split(sweep, 2, axis=1)
        depths.append(baseline * grid_focal_length(camera) / _clear_disparities(*ahead))
        num_by_chance += len(_clear_disparities(*behind))
        at_infinity[float(baseline)] += _num_at_infinity(*sweep)
    return Parallax(np.concatenate(depths), num_by_chance, tuple(at_infinity.values()), extent)


def measure_share_beyond(
    events: Events, camera: Camera, trajectory: Trajectory, depth_range: tuple[float, float]
) -> float:
    """Share of the events that come from beyond a depth range, from 0 to 1.

    This is the plane sweep of `measure_parallax`, at the baseline that places the farthest depth FARTHEST_DISPARITY
    from infinity. A tile's votes lie beyond if their dispersion is larger at some plane between the farthest depth and
    infinity than at all planes of the range. Noise favours the range, which has more planes.

    Args:
        events: In time order, within the span of the trajectory.
        camera: Of the events.
        trajectory: Of that camera.
        depth_range: Nearest and farthest depth, metres.

    Returns:
        0 also if the camera moves too little to distinguish the farthest depth from infinity.
    """
    near, far = depth_range
    path, focal = _path(events, trajectory), grid_focal_length(camera)
    baseline = min(_extent(path[1]), FARTHEST_DISPARITY * far / focal)
    farthest = baseline * focal / far
    if farthest < SMALLEST_DISPARITY:
        return 0.0
    nearest = min(baseline * focal / near, GRID_WIDTH)
    planes = np.append(np.arange(0.0, FARTHEST_DISPARITY, 0.5), np.arange(FARTHEST_DISPARITY, nearest + 1))
    votes_beyond = votes_of_all = 0.0
    for _, (dispersion, votes) in _sweeps(events, camera, trajectory, path, [baseline], planes):
        enough = votes[0] > MIN_VOTES
        beyond = dispersion[planes < farthest].max(0) > dispersion[planes >= farthest].max(0)
        votes_beyond += votes[0, enough & beyond].sum()
        votes_of_all += votes[0, enough].sum()
    return float(votes_beyond / votes_of_all) if votes_of_all else 0.0


def _path(events: Events, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced times (ns) from the first event to the last, and the camera's places (metres) at these times."""
    if not len(events):
        return np.empty(0, np.int64), np.empty((0, 3))
    path_times = evenly_spaced(events.t[0], events.t[-1], 2000)
    path_times = path_times[trajectory.in_gaps(events.t).any() | ~trajectory.in_gaps(path_times)]
    return path_times, trajectory.poses(torch.from_numpy(path_times))[:, :, 3].numpy()


def _sweeps(
    events: Events,
    camera: Camera,
    trajectory: Trajectory,
    path: tuple[np.ndarray, np.ndarray],
    baselines: Iterable[float],
    disparities: Float64[np.ndarray, " planes"],
) -> Iterator[tuple[float, Float64[np.ndarray, "2 planes tiles"]]]:
    """Each baseline (metres) with the result of `sweep_planes` for each of its reference views. Nothing for a camera
    that stays in one place."""
    if not _extent(path[1]):
        return
    directions, generator = camera.pixel_directions(), np.random.default_rng(0)
    references = events.t[len(events) // 24 :: len(events) // 12 + 1]
    for baseline in baselines:
        for reference in references:
            chosen = _events_seen_within(baseline / 2, reference, events, *path)
            if len(chosen) > EVENTS_PER_SWEEP:
                chosen = generator.choice(chosen, EVENTS_PER_SWEEP, replace=False)
            rays, centres, _ = rays_in_view(
                directions[events.y[chosen], events.x[chosen]],
                trajectory.poses(torch.from_numpy(events.t[chosen])).numpy(),
                trajectory.poses(torch.as_tensor(reference)).numpy(),
            )
            yield baseline, sweep_planes(rays, centres / baseline, camera, disparities)


def _extent(path: np.ndarray) -> float:
    """Diagonal of the box around places, metres."""
    return float(np.linalg.norm(np.ptp(path, axis=0))) if len(path) else 0.0


def grid_focal_length(camera: Camera) -> float:
    """Focal length in grid pixels."""
    return camera.fx * grid_scale(camera)


def grid_scale(camera: Camera) -> float:
    """Grid pixels per pixel, at most 1: a finer grid would show the sensor's own pixels as a pattern."""
    return min(GRID_WIDTH / camera.width, 1.0)


def _events_seen_within(radius: float, reference: int, events: Events, path_times, path) -> np.ndarray:
    """Numbers of the events around a time (ns) while the camera is within a radius (metres) of its place at that
    time."""
    now = int(np.clip(np.searchsorted(path_times, reference), 1, len(path_times) - 1))
    ends = stretch_around(now, np.linalg.norm(path - path[now], axis=1) > radius)
    first, last = np.searchsorted(events.t, path_times[ends])
    return np.arange(first, last)


def stretch_around(now: int, is_outside: Bool[np.ndarray, " instants"]) -> list[int]:
    """Numbers of the nearest instants before and after instant number `now`, at least 1, that are outside; or of the
    first and the last instant."""
    limits = np.concatenate([[0], np.flatnonzero(is_outside), [len(is_outside) - 1]])
    after = np.searchsorted(limits, now)
    return limits[after - 1 : after + 1].tolist()


def rays_in_view(
    directions: Float64[np.ndarray, "rays 3"],
    poses: Float64[np.ndarray, "rays 3 4"],
    view: Float64[np.ndarray, "3 4"],
) -> tuple[Float64[np.ndarray, "ahead 3"], Float64[np.ndarray, "ahead 3"], Bool[np.ndarray, " rays"]]:
    """Directions (z = 1) and centres, in the axes of a view, of those rays that do not point away from it; and which
    rays these are."""
    rays = np.einsum("nij,nj->ni", poses[:, :, :3], directions) @ view[:, :3]
    centres = (poses[:, :, 3] - view[:, 3]) @ view[:, :3]
    ahead = rays[:, 2] > 0.1
    return rays[ahead] / rays[ahead, 2:], centres[ahead], ahead


def sweep_planes(
    rays: Float64[np.ndarray, "rays 3"],
    centres: Float64[np.ndarray, "rays 3"],
    camera: Camera,
    disparities: Float64[np.ndarray, " planes"],
    weights: Float64[np.ndarray, " rays"] | None = None,
) -> Float64[np.ndarray, "2 planes tiles"]:
    """Dispersion of the votes, and votes per grid pixel, of each tile of the view at each plane.

    The view sees the point c + (z - c_z) a, at which a ray of direction a (z = 1) from c cuts the plane of depth z, in
    the direction a + (c - c_z a) / z.

    Args:
        rays: Directions, z = 1, in the axes of the view.
        centres: Their origins, in units of the baseline.
        camera: Of the view.
        disparities: Of the planes, grid pixels: focal length times baseline over depth.
        weights: Of the votes. Default: 1.
    """
    scale, focal = grid_scale(camera), grid_focal_length(camera)
    columns, rows = (round(side * scale) // TILE for side in (camera.width, camera.height))
    start = focal * rays[:, :2] + np.array([camera.cx, camera.cy]) * scale
    drift = centres[:, :2] - centres[:, 2:] * rays[:, :2]
    votes, squares = np.zeros((2, len(disparities), rows * columns))
    approach, counts = np.ascontiguousarray(centres[:, 2]) / focal, np.empty((rows * TILE, columns * TILE))
    weights = np.ones(len(rays)) if weights is None else weights
    compiled(_vote)(start, drift, approach, weights, disparities, counts, votes, squares)
    votes, squares = votes / TILE**2, squares / TILE**2
    return np.stack([(squares - votes**2) / np.maximum(votes, 1e-9), votes])


def _vote(start, drift, approach, weights, disparities, counts, votes, squares):
    """Adds up, for each plane and tile, the votes of all rays and the squares of the counts of its grid pixels."""
    height, width = counts.shape
    for plane, disparity in enumerate(disparities):
        counts[:] = 0.0
        for ray in range(len(start)):
            x = start[ray, 0] + disparity * drift[ray, 0] + 0.5
            y = start[ray, 1] + disparity * drift[ray, 1] + 0.5
            if 0.0 <= x < width and 0.0 <= y < height:  # weighted by area, so that magnification is no sharpness
                counts[int(y), int(x)] += weights[ray] * (1.0 - disparity * approach[ray]) ** 2
        for row in range(height):
            for column in range(width // TILE):
                vote, square = 0.0, 0.0
                for x in range(column * TILE, (column + 1) * TILE):
                    count = counts[row, x]
                    vote += count
                    square += count * count
                tile = row // TILE * (width // TILE) + column
                votes[plane, tile] += vote
                squares[plane, tile] += square


def _clear_disparities(
    dispersion: Float64[np.ndarray, "planes tiles"], votes: Float64[np.ndarray, "planes tiles"]
) -> Float64[np.ndarray, " clear"]:
    """Disparities of the tiles whose votes have a clear peak at one plane."""
    peak = dispersion.argmax(0)[None]
    disparity = DISPARITIES[peak]
    clear = (
        (dispersion.max(0) > np.maximum(MIN_PEAK * np.median(dispersion, 0), MIN_GAIN * dispersion[0]))
        & (np.take_along_axis(votes, peak, 0) > MIN_VOTES)
        & (disparity >= SMALLEST_DISPARITY)
        & (disparity <= LARGEST_DISPARITY)
    )
    return disparity[clear]


def _num_at_infinity(
    dispersion: Float64[np.ndarray, "planes tiles"], votes: Float64[np.ndarray, "planes tiles"]
) -> int:
    """Number of tiles whose votes have a clear peak at infinity, among the planes in front and behind."""
    peak = dispersion.argmax(0)
    clear = (dispersion.max(0) > MIN_PEAK * np.median(dispersion, 0)) & (votes[0] > MIN_VOTES)
    return np.count_nonzero(clear & (DISPARITIES[peak % len(DISPARITIES)] < SMALLEST_DISPARITY))
