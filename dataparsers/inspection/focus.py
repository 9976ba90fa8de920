"""Sharpness of motion-compensated events, under different hypotheses about poses and calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.pose_files import FROM_OPENCV
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced
from enerf_ns.dataparsers.scene.depth_range import (
    TILE,
    grid_focal_length,
    grid_scale,
    rays_in_view,
    sweep_planes,
)

LONGEST_DELAY = 50_000_000
"""Longest delay of a clock that is searched, ns. In a short recording it is a quarter of the recording."""

PATH_OF_WINDOW = 0.09
"""Distance that the picture moves within a window of time, as a share of the picture's width."""

LONGEST_WINDOW = 1_000_000_000
"""Longest window, ns, for a camera that hardly moves."""

NUM_WINDOWS = 8
"""Most windows. Half of them are spread evenly over the recording, half lie where the motion changes most."""

EVENTS_PER_WINDOW = 25_000
"""Most events of a window by which hypotheses are compared, evenly taken."""

EVENTS_PER_PICTURE = 60_000
"""Most events that are drawn into a picture, evenly taken."""

FEWEST_EVENTS = 2_000
"""Fewest events of a window."""

FEWEST_TILES = 4
"""Smallest sensor, in tiles."""

TILES_OF_CHANCE = 12
"""Smallest sensor, in tiles, on which right poses are always clearly sharper than others. On smaller ones, a few tiles
can be as sharp by chance."""

EVENTS_OF_CHANCE = 7.0
"""Number of events that a passing edge fires at a pixel in the mean, above which a few strong edges alone decide how
sharp the events are. Before a black background it is 9; on textured scenes with usual thresholds it is 1 to 6."""

PLANES = np.arange(0.0, 65.0)
"""Planes of the sweep, as disparities: grid pixels by which a point on the plane moves while the camera moves through
the window."""

FREE_DIRECTIONS, FREE_STEPS = 12, np.arange(0.0, 25.0)
"""Number of directions of motions without poses, and their distances from the middle of a window to its ends, grid
pixels."""

NEAREST_PLANE = 2.0
"""Smallest depth of a plane, as a multiple of the largest distance of the camera from its place in mid-window."""

STEPS_OF_WINDOW = 512
"""Instants of a window at which its poses are taken."""


@dataclass(frozen=True)
class Reading:
    """A convention in which the poses of a file may be written."""

    words: str
    """Name of the convention. It can follow "read as"."""
    of: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory
    """Function from the trajectory as it was read to the trajectory in this convention."""
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Signs of the camera's axes. An odd number of negative signs mirrors the picture, or puts the scene behind the
    camera."""
    exchanges: bool = False
    """Whether x and y of the sensor are exchanged, before the signs count."""
    fault_of_events: str = ""
    """Fault of the events that has the same effect, and what to do. It can follow "if the poses are right,"."""

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Axes of the camera, as columns, in the axes in which they were read."""
        columns = np.diag(self.signs)
        return columns[:, [1, 0, 2]] if self.exchanges else columns

    @property
    def is_rotation(self) -> bool:
        """Whether the axes of the camera are no mirror image of those in which they were read."""
        return bool(np.linalg.det(self.axes) > 0)


def _inverse(trajectory: Trajectory) -> Trajectory:
    turned = Rotation.from_quat(trajectory.quaternions).inv()
    return Trajectory(trajectory.times, -turned.apply(trajectory.positions), turned.as_quat())


def _reordered(order: tuple[int, int, int, int]) -> Callable[[Trajectory], Trajectory]:
    return lambda read: Trajectory(read.times, read.positions, read.quaternions[:, order])


def _from_ros(trajectory: Trajectory) -> Trajectory:
    turned = Rotation.from_quat(trajectory.quaternions) * Rotation.from_matrix(FROM_OPENCV["ros"])
    return Trajectory(trajectory.times, trajectory.positions, turned.as_quat())


def _axes(signs: tuple[float, float, float]) -> str:
    names = ("right", "left"), ("down", "up"), ("forward", "backward")
    x, y, z = (names[axis][sign < 0] for axis, sign in enumerate(signs))
    return f"axes with x {x}, y {y}, z {z}"


AS_READ = Reading("the convention in which they were read")
OPENGL = Reading(f"OpenGL's camera {_axes((1, -1, -1))}", signs=(1, -1, -1))
ROS = Reading("ROS's axes of a body with x forward, y left, z up", _from_ros)
INVERSE = Reading("world to camera, the inverse", _inverse)
SCALAR_FIRST = Reading("quaternions in the order w x y z", _reordered((1, 2, 3, 0)))
SCALAR_LAST = Reading("quaternions in the order x y z w", _reordered((3, 0, 1, 2)))
EXCHANGED = Reading(
    "axes of a sensor whose x and y are exchanged (x down, y right)",
    exchanges=True,
    fault_of_events="x and y of the events are exchanged: exchange both columns, and width and height if they are too",
)
FAULTS_OF_EVENTS = {
    (-1, 1, 1): "the events are mirrored: write width - 1 - x for x",
    (1, -1, 1): "the events are mirrored: write height - 1 - y for y",
    (-1, -1, 1): "the events are turned by half a turn: write width - 1 - x for x, and height - 1 - y for y",
}
"""Faults of the events that make the same picture as these signs of the camera's axes."""
READINGS = (
    INVERSE,
    SCALAR_FIRST,
    SCALAR_LAST,
    OPENGL,
    ROS,
    EXCHANGED,
    *(
        Reading(
            ("mirrored " if np.prod(signs) < 0 else "") + _axes(signs),
            signs=signs,
            fault_of_events=FAULTS_OF_EVENTS.get(signs, ""),
        )
        for signs in ((-1, 1, 1), (1, -1, 1), (-1, -1, 1), (-1, 1, -1), (1, 1, -1), (-1, -1, -1))
    ),
    *(
        Reading(
            f"axes of a sensor that is turned by a quarter of a turn ({axes})",
            signs=signs,
            exchanges=True,
            fault_of_events=f"the events are turned by a quarter of a turn: {mend}",
        )
        for signs, axes, mend in (
            ((-1, 1, 1), "x down, y left", "write height - 1 - y for x, and x for y"),
            ((1, -1, 1), "x up, y right", "write y for x, and width - 1 - x for y"),
        )
    ),
)
"""Other readings, the likeliest mistakes first."""


@dataclass(frozen=True)
class Hypothesis:
    """A possible error of poses and calibration."""

    delay: int = 0
    """Nanoseconds by which the poses are stamped later than events of the same instant."""
    focal_scale: float = 1.0
    """The focal length as a multiple of the stated one."""
    reading: Reading = AS_READ

    @property
    def words(self) -> str:
        """The changes of the poses' clock and of the focal length, or "as stated" if there are none."""
        changes = [f"poses {self.delay * 1e-6:+.3g} ms"] * (self.delay != 0)
        changes += [f"focal length {100 * (self.focal_scale - 1):+.0f} %"] * (self.focal_scale != 1)
        return ", ".join(changes) or "as stated"


AS_STATED = Hypothesis()


@dataclass(frozen=True, eq=False)
class Window:
    """A short part of a recording, whose events are compensated for the camera's motion together."""

    start: int
    """First time, ns."""
    end: int
    """Last time, ns."""
    speed: float
    """Speed of the picture, pixels per second."""
    events: Events

    @property
    def instant(self) -> int:
        """The time, ns, to which events are moved: the middle of the window."""
        return (self.start + self.end) // 2


class EventFocus:
    """Motion compensation of the events in some windows of a recording.

    Poses and a depth move each event of a window to the place where the camera saw its edge in mid-window. A plane
    sweep (`scene.depth_range`) finds the depth of each tile (16 grid pixels a side): the one at which the tile's events
    are sharpest. It is found anew for each hypothesis, so that each hypothesis has the depths that serve it best.
    Sharpness is the variance of the image of moved events (Gallego et al., "A Unifying Contrast Maximization
    Framework", CVPR 2018), summed over the pixels and divided by the number of events. All hypotheses are measured with
    the same events. Events that leave the view, or go behind the camera, add nothing. Magnification does not count as
    sharpness. A view without distortion is stretched towards the border of a wide lens, the less the longer its focal
    length. Events are weighted by this stretch, since a picture has the same sharpness then, however it is stretched.

    Args:
        recording: Its index is made if it is not there yet.
        distance: Usual depth of the scene, metres. It decides how long the windows are.
    """

    def __init__(self, recording: EventRecording, distance: float):
        self.recording = recording
        self.largest_delay = largest_delay(recording)
        """Longest delay, ns, for which there are poses around each event of the windows."""
        self.windows = []
        """Windows in time order. None if there are too few events or pixels."""
        camera = recording.camera
        tiles = camera.width * camera.height * grid_scale(camera) ** 2 / TILE**2
        self.is_small = tiles < TILES_OF_CHANCE
        """Whether a few tiles of the sensor can be sharp by chance."""
        if tiles >= FEWEST_TILES:
            start, end = _posed_span(recording)
            self.windows = _windows(recording, start + self.largest_delay, end - self.largest_delay, distance)
        self._trajectories = {AS_READ: recording.trajectory}
        self._cameras: dict[tuple[float, bool], Camera] = {}
        self._stretches: dict[tuple[float, bool], Float64[np.ndarray, "height width"]] = {}

    @property
    def speed(self) -> float:
        """Speed of the picture in fast windows (90th percentile), pixels per second."""
        return float(np.percentile([window.speed for window in self.windows], 90))

    @cached_property
    def events_an_edge(self) -> float:
        """Mean number of events that a passing edge fires at a pixel, median over the windows; 0 without windows."""
        camera = self.recording.camera
        return float(np.median([_events_an_edge(window, camera) for window in self.windows] or [0.0]))

    @property
    def has_strong_edges(self) -> bool:
        """Whether a few edges fire most events, so that other readings of the poses are about as sharp by chance."""
        return self.events_an_edge > EVENTS_OF_CHANCE

    @property
    def chance(self) -> str:
        """The reason why other readings of the poses may be about as sharp, as a clause; empty if there is none."""
        if self.is_small:
            return f"{self.recording.camera.width} x {self.recording.camera.height} pixels show too little"
        if self.has_strong_edges:
            return f"a few strong edges fire most events, {self.events_an_edge:.0f} at a time at each pixel"
        return ""

    @cached_property
    def turn(self) -> float:
        """Largest angle (radians, as its sine) between the line of sight and that in mid-window, over all windows."""
        turns = []
        for window in self.windows:
            times = np.append(evenly_spaced(window.start, window.end, 17), window.instant)
            sights = self.recording.trajectory.poses(torch.from_numpy(times)).numpy()[:, :, 2]
            turns.append(np.linalg.norm(np.cross(sights[:-1], sights[-1]), axis=1).max())
        return float(max(turns))

    def sharpness(self, hypothesis: Hypothesis = AS_STATED) -> Float64[np.ndarray, "windows*tiles"]:
        """Sharpness of each tile at its best depth, as a share of the sum over the tiles of a window."""
        sweeps = (self._sweep(window, _some(window.events, EVENTS_PER_WINDOW), hypothesis) for window in self.windows)
        return np.concatenate([sharpness.max(0) for sharpness, *_ in sweeps])

    @cached_property
    def free_sharpness(self) -> float:
        """Sum of the sharpness if each tile moves evenly, in that direction and as far as makes it sharpest.

        No poses are needed. Right poses nearly reach it, or exceed it where the camera turns or the motion changes.
        """
        total, camera, angles = 0.0, self._camera(AS_STATED), np.arange(FREE_DIRECTIONS) * 2.0 * np.pi / FREE_DIRECTIONS
        for window in self.windows:
            events = _some(window.events, EVENTS_PER_WINDOW)
            still = np.broadcast_to(np.eye(3, 4), (len(events), 3, 4))
            rays, _, ahead = rays_in_view(camera.pixel_directions()[events.y, events.x], still, still[0])
            stretch = self._stretch(AS_STATED)[events.y, events.x][ahead]
            when = 2.0 * (events.t[ahead] - window.instant) / (window.end - window.start)
            sharpest = np.zeros(1)
            for angle in angles:
                ways = when[:, None] * [np.cos(angle), np.sin(angle), 0.0]
                dispersion, votes = sweep_planes(rays, ways, camera, FREE_STEPS, stretch)
                sharpest = np.maximum(sharpest, (dispersion * votes).max(0))
            total += float(sharpest.sum()) * TILE**2 / len(events)
        return total

    def picture(
        self, window: Window, hypothesis: Hypothesis | None = AS_STATED
    ) -> tuple[Float64[np.ndarray, "rows columns"], float]:
        """Number of motion-compensated events at each grid pixel, each tile at its best depth; and the sharpness.

        Args:
            window: One of `windows`.
            hypothesis: Poses and calibration to compensate with; None counts events where they fired.
        """
        events = _some(window.events, EVENTS_PER_PICTURE)
        camera = self._camera(hypothesis or AS_STATED)
        scale, focal = grid_scale(camera), grid_focal_length(camera)
        columns, rows = (round(side * scale) // TILE * TILE for side in (camera.width, camera.height))
        if hypothesis is None:
            rays, planes = camera.pixel_directions()[events.y, events.x], np.zeros(1)
            centres, best = np.zeros_like(rays), np.zeros((rows, columns), int)
        else:
            variance, rays, centres, planes = self._sweep(window, events, hypothesis)
            best = variance.argmax(0).reshape(rows // TILE, columns // TILE).repeat(TILE, 0).repeat(TILE, 1)
        start = focal * rays[:, :2] + np.array([camera.cx, camera.cy]) * scale
        picture = np.zeros((rows, columns))
        for i in np.unique(best):
            x, y = np.rint(start + planes[i] * (centres[:, :2] - centres[:, 2:] * rays[:, :2])).astype(int).T
            seen = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            areas = (1 - planes[i] / focal * centres[seen, 2]) ** 2
            drawn = np.bincount(y[seen] * columns + x[seen], areas, rows * columns).reshape(rows, columns)
            picture = np.where(best == i, drawn, picture)
        tiles = picture.reshape(rows // TILE, TILE, columns // TILE, TILE)
        return picture, float(tiles.var((1, 3)).sum() * TILE**2 / len(events))

    def _sweep(
        self, window: Window, events: Events, hypothesis: Hypothesis
    ) -> tuple[
        Float64[np.ndarray, "planes tiles"],
        Float64[np.ndarray, "rays 3"],
        Float64[np.ndarray, "rays 3"],
        Float64[np.ndarray, " planes"],
    ]:
        """Sharpness of each tile at each plane; rays, their centres relative to the camera's way, and planes."""
        read = self._trajectory(hypothesis.reading)
        times = evenly_spaced(window.start, window.end, STEPS_OF_WINDOW)
        moments = np.append(times, window.instant) + hypothesis.delay
        poses = read.poses(torch.from_numpy(moments.clip(read.start, read.end))).numpy()
        poses[:, :, :3] = poses[:, :, :3] @ hypothesis.reading.axes
        reach = float(np.linalg.norm(poses[:, :, 3] - poses[-1, :, 3], axis=1).max())

        moment = np.rint((events.t - window.start) * ((len(times) - 1) / (window.end - window.start))).astype(int)
        camera = self._camera(hypothesis)
        directions = camera.pixel_directions()[events.y, events.x]
        rays, centres, ahead = rays_in_view(directions, poses[moment], poses[-1])
        planes = PLANES[grid_focal_length(camera) > NEAREST_PLANE * PLANES] if reach else PLANES[:1]
        centres = centres / (reach or 1.0)
        stretch = self._stretch(hypothesis)[events.y, events.x]
        dispersion, votes = sweep_planes(rays, centres, camera, planes, stretch[ahead])
        return dispersion * votes * TILE**2 / len(events), rays, centres, planes

    def _trajectory(self, reading: Reading) -> Trajectory:
        if reading not in self._trajectories:
            read = self.recording.trajectory
            body, mount = read.body or (read, None)
            meant = reading.of(body)
            self._trajectories[reading] = meant if mount is None else meant.of_mounted(mount)
        return self._trajectories[reading]

    @cached_property
    def _fits_exchanged(self) -> bool:
        """Whether events would also lie within the sensor if x and y were exchanged, and end where it would end."""
        camera = self.recording.camera
        index = index_events(self.recording)
        rows, columns = np.nonzero(index.offsets.diff().numpy().reshape(camera.height, camera.width))
        return camera.width != camera.height and columns.max() < camera.height and rows.max() < camera.width

    def allows(self, focal_scale: float) -> bool:
        """Whether the lens model can be inverted with this multiple of the stated focal length."""
        try:
            self._camera(Hypothesis(focal_scale=focal_scale)).pixel_directions()
        except ValueError:
            return False
        return True

    def _camera(self, hypothesis: Hypothesis) -> Camera:
        """The camera of a hypothesis. If x and y of the events alone are exchanged, so are fx, fy and cx, cy."""
        scale, stated = hypothesis.focal_scale, self.recording.camera
        turns = hypothesis.reading.exchanges and (stated.has_sides_swapped or self._fits_exchanged)
        if (scale, turns) not in self._cameras:
            directions = None if stated.directions is None else stated.directions / scale
            fx, fy, cx, cy = stated.fx * scale, stated.fy * scale, stated.cx, stated.cy
            if turns:
                fx, fy, cx, cy = fy, fx, cy, cx
            self._cameras[scale, turns] = replace(stated, fx=fx, fy=fy, cx=cx, cy=cy, directions=directions)
        return self._cameras[scale, turns]

    def _stretch(self, hypothesis: Hypothesis) -> Float64[np.ndarray, "height width"]:
        """The factor by which each pixel is wider and higher, in the mean, in the view without distortion."""
        key = hypothesis.focal_scale, hypothesis.reading.exchanges
        if key not in self._stretches:
            camera = self._camera(hypothesis)
            (right_x, right_y), (down_x, down_y) = (np.moveaxis(step, 2, 0) for step in camera.pixel_steps())
            self._stretches[key] = camera.fx * np.sqrt(np.abs(right_x * down_y - right_y * down_x))
        return self._stretches[key]


def largest_delay(recording: EventRecording) -> int:
    """Longest delay of a clock that is searched, ns."""
    start, end = _posed_span(recording)
    return min(LONGEST_DELAY, (end - start) // 4)


def _posed_span(recording: EventRecording) -> tuple[int, int]:
    """First and last time (ns) at which there are both events and poses."""
    start, end = index_events(recording).span
    return max(start, recording.trajectory.start), min(end, recording.trajectory.end)


def _some(events: Events, at_most: int) -> Events:
    """About `at_most` of the events, evenly taken."""
    step = max(round(len(events) / at_most), 1)
    return Events(events.x[::step], events.y[::step], events.t[::step], events.p[::step])


def _events_an_edge(window: Window, camera: Camera) -> float:
    """Mean number of events that an edge fires at a pixel while it passes: of one polarity, each later than the one
    before by no more than the picture takes to move by a pixel. The mean is over the events."""
    events, width = window.events, PATH_OF_WINDOW * camera.width
    pixels = events.y.astype(np.int64) * camera.width + events.x
    order = np.argsort(pixels, kind="stable")
    steps = [np.diff(values[order]) for values in (pixels, events.p, events.t)]
    same = (steps[0] == 0) & (steps[1] == 0) & (steps[2] <= (window.end - window.start) / width)
    counts = np.diff(np.concatenate([[0], np.flatnonzero(~same) + 1, [len(order)]]))
    return float((counts**2).sum() / counts.sum())


def _windows(recording: EventRecording, start: int, end: int, distance: float) -> list[Window]:
    """The windows within a span of time (ns), in order, outside gaps of the poses."""
    spans, speeds, changes = _spans_of_motion(recording, start, end, distance)
    if not len(spans):
        return []
    evenly = np.unique(np.linspace(0, len(spans) - 1, NUM_WINDOWS // 2).round().astype(int))
    others = np.setdiff1d(np.argsort(-changes), evenly, assume_unique=True)
    chosen = np.sort(np.append(evenly, others[: NUM_WINDOWS - len(evenly)]))
    events = index_events(recording).events_within(spans[chosen])
    windows = []
    for i in chosen:
        first, last = np.searchsorted(events.t, spans[i] + [0, 1])
        own = Events(events.x[first:last], events.y[first:last], events.t[first:last], events.p[first:last])
        if len(own) >= FEWEST_EVENTS:
            windows.append(Window(int(spans[i, 0]), int(spans[i, 1]), float(speeds[i]), own))
    return windows


def _spans_of_motion(
    recording: EventRecording, start: int, end: int, distance: float
) -> tuple[Int64[np.ndarray, "spans 2"], Float64[np.ndarray, " spans"], Float64[np.ndarray, " spans"]]:
    """Successive spans of time (ns) in which the picture moves by PATH_OF_WINDOW, the speed of the picture in each
    (pixels per second), and the mean deviation of its velocity within each (pixels per second)."""
    none = np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0)
    if end - start < 2:
        return none
    number = int(np.clip((end - start) // 1_000_000, 200, 200_000))
    times = evenly_spaced(start, end, number + 1)
    poses = recording.trajectory.poses(torch.from_numpy(times)).numpy()
    turned = poses[:-1, :, :3].transpose(0, 2, 1) @ poses[1:, :, :3]
    moved = np.einsum("nji,nj->ni", poses[:-1, :, :3], np.diff(poses[:, :, 3], axis=0))
    steps = recording.camera.fx * np.append(Rotation.from_matrix(turned).as_rotvec(), moved / distance, axis=1)
    path = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    spans, speeds, changes = [], [], []
    begin = 0
    while begin < number:
        far = np.searchsorted(path, path[begin] + PATH_OF_WINDOW * recording.camera.width)
        late = np.searchsorted(times, times[begin] + LONGEST_WINDOW)
        after = min(far, late)
        if after > number:  # too little is left for a window, so the last one ends with the recording
            after = number
            begin = int(max(np.searchsorted(path, path[-1] - PATH_OF_WINDOW * recording.camera.width, "right") - 1,
                            np.searchsorted(times, times[-1] - LONGEST_WINDOW), 0))  # fmt: skip
        span = times[[begin, after]]
        if not recording.trajectory.in_gaps(span[:1], span[1:]).any() or recording.keep_pose_gaps:
            seconds = np.diff(times[begin : after + 1]) * 1e-9
            velocity = steps[begin:after] / seconds[:, None]
            spans.append(span)
            speeds.append((path[after] - path[begin]) / seconds.sum())
            changes.append(np.linalg.norm(velocity - velocity.mean(0), axis=1).mean())
        begin = max(after, begin + 1)
    return (np.stack(spans), np.array(speeds), np.array(changes)) if spans else none
