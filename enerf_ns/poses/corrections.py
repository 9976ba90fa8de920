"""Corrections of clock, mount, lens and trajectory of a recording, and the corrected recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

MILLISECOND = 1_000_000


@dataclass(frozen=True)
class DriftBasis:
    """Smooth functions of time with mean 0: combinations of cubic B-splines with evenly spaced knots."""

    start: int
    """First time, ns. Before it, the functions are constant."""
    end: int
    """Last time, ns. After it, the functions are constant."""
    num_pieces: int
    """Number of equal intervals between the knots."""

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.num_pieces + 2

    def at(self, times: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, "times functions"]:
        """Values of the functions at some times, ns."""
        splines, without_mean = self._parts
        return splines((times - self.start).clip(0, self.end - self.start) / (self.end - self.start)) @ without_mean

    @cached_property
    def roughness(self) -> Float64[np.ndarray, "functions functions"]:
        """The sum of the squared second differences of the splines' coefficients, as a quadratic form of the functions'
        coefficients (P-splines, Eilers and Marx, Statistical Science 1996)."""
        bends = np.diff(self._parts[1], n=2, axis=0)
        return bends.T @ bends

    @cached_property
    def _parts(self) -> tuple[BSpline, Float64[np.ndarray, "splines functions"]]:
        """The splines, and the orthonormal combinations of them with mean 0, one in each column."""
        knots = np.pad(np.linspace(0.0, 1.0, self.num_pieces + 1), 3, mode="edge")
        splines = BSpline(knots, np.eye(self.num_pieces + 3), 3)
        means = (knots[4:] - knots[:-4]) / 4.0
        return splines, np.linalg.svd(means[None])[2][1:].T


@dataclass(frozen=True, eq=False)
class Drift:
    """Shifts and rotations of a camera in its own axes, as smooth functions of time."""

    basis: DriftBasis
    coefficients: Float64[np.ndarray, "functions 6"]
    """Coefficients of the shifts (metres) and of the rotation vectors (radians)."""

    def at(self, times: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, "times 6"]:
        """Shifts (metres) and rotation vectors at some times, ns."""
        return self.basis.at(times) @ self.coefficients


@dataclass(frozen=True, eq=False)
class Corrections:
    """Errors of clocks, poses and lens of a recording.

    With the given trajectory T, the event camera has the pose T(t + delay(t)) Exp(mount) Exp(drift(t)) Exp(noise(t)) at
    time t. Each Exp is a shift and a rotation in the axes of the camera, as in `PosedCamera.rays`.
    """

    delay: float = 0.0
    """Milliseconds by which the given poses are stamped later than events of the same instant, half-way through the
    poses."""
    frame_delay: float = 0.0
    """Milliseconds by which frames are stamped later than events of the same instant."""
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector of the camera against its stated mount, radians."""
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the camera against its stated mount, metres."""
    focal_scale: float = 1.0
    """The focal length as a multiple of the stated one."""
    distortion: float = 0.0
    """True less stated first coefficient of radial distortion."""
    delay_rate: float = 0.0
    """Growth of the delay of the poses, milliseconds per second."""
    drift: Drift | None = None
    """Slow drift of the poses. None: no drift."""
    noise: Drift | None = None
    """Noise of the poses that smoothing left. None: no noise."""
    _made: tuple[Trajectory, Trajectory] | None = field(default=None, init=False, repr=False)
    """A given trajectory and its correction, for the next call."""

    @property
    def moves_poses(self) -> bool:
        """Whether the corrections change the poses of the event camera."""
        clock = self.delay != 0.0 or self.delay_rate != 0.0
        mount = any(self.rotation) or any(self.translation)
        return clock or mount or self.drift is not None or self.noise is not None

    @property
    def words(self) -> list[str]:
        """Each correction in a few words. Empty if there is none."""
        found = [f"poses stamped {self.delay:+.2f} ms late"] * bool(self.delay)
        found += [f"clock rate of the poses {self.delay_rate:+.3f} ms per second off"] * bool(self.delay_rate)
        found += [f"frames stamped {self.frame_delay:+.2f} ms late"] * bool(self.frame_delay)
        turn, shift = (float(np.linalg.norm(part)) for part in (self.rotation, self.translation))
        found += [f"mount turned by {np.degrees(turn):.2f} degrees"] * bool(turn)
        found += [f"mount shifted by {1e3 * shift:.1f} mm"] * bool(shift)
        found += [f"focal length {self.focal_scale:.4f} of the stated one"] * (self.focal_scale != 1.0)
        found += [f"distortion {self.distortion:+.4f}"] * bool(self.distortion)
        found += ["a drift of the poses"] * (self.drift is not None)
        return [*found, *["noise of the poses"] * (self.noise is not None)]

    @property
    def changes_lens(self) -> bool:
        """Whether the corrections change the lens of the event camera."""
        return self.focal_scale != 1.0 or self.distortion != 0.0

    def camera(self, given: Camera) -> Camera:
        """The event camera with its lens corrected.

        Raises:
            ValueError: The corrected lens model cannot be inverted.
        """
        if not self.changes_lens:
            return given
        model, coefficients = given.model, given.distortion
        if self.distortion and model == "pinhole":
            model, coefficients = "radtan", (self.distortion, 0.0, 0.0, 0.0)
        elif self.distortion:
            coefficients = (coefficients[0] + self.distortion, *coefficients[1:])
        scale = self.focal_scale
        directions = None if given.directions is None else given.directions / scale
        return replace(
            given,
            fx=given.fx * scale,
            fy=given.fy * scale,
            model=model,
            distortion=coefficients,
            directions=directions,
        )

    def stamped(self, given: Trajectory, times: Int64[np.ndarray, " times"]) -> Int64[np.ndarray, " times"]:
        """Time on the clock of the given poses at some times (ns) on the clock of the events."""
        grown = 1e-3 * self.delay_rate * (times - _middle(given))
        return times + round(MILLISECOND * self.delay) + grown.round().astype(np.int64)

    def _knots(self, given: Trajectory, own: Trajectory, start: int, end: int) -> Int64[np.ndarray, " poses"]:
        """Times (ns) of a camera's own poses on the clock of the events, from a start to an end, and these two.

        Where its poses do not reach, times are as far apart as they are elsewhere, since splines swing in long gaps.
        """
        middle = _middle(given)
        since = (own.times - middle - round(MILLISECOND * self.delay)) / (1.0 + 1e-3 * self.delay_rate)
        times = np.unique(middle + since.round().astype(np.int64))
        step = int(np.median(np.diff(own.times)))
        times = np.concatenate([np.arange(times[0], start, -step)[:0:-1], times, np.arange(times[-1], end, step)[1:]])
        return np.concatenate([[start], times[(times > start) & (times < end)], [end]])

    def poses(self, given: Trajectory, times: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, "times 3 4"]:
        """Poses of the event camera at any times (ns). Beyond the given poses, it moves on at its last speed."""
        poses = poses_at(given, self.stamped(given, times))
        poses = _moved(poses, np.array([self.translation]), np.array([self.rotation]))
        for drift in (self.drift, self.noise):
            if drift is not None:
                values = drift.at(times)
                poses = _moved(poses, values[:, :3], values[:, 3:])
        return poses

    def trajectory(self, given: Trajectory) -> Trajectory:
        """The corrected trajectory of the event camera, with the same first and last time.

        The same given trajectory always gives the same object.
        """
        if not self.moves_poses:
            return given
        if self._made is None or self._made[0] is not given:
            times = self._knots(given, given, given.start, given.end)
            object.__setattr__(self, "_made", (given, _trajectory(times, self.poses(given, times))))
        assert self._made is not None
        return self._made[1]

    def frames(self, given: Frames, recording: EventRecording) -> Frames:
        """Corrected frames of a recording, on the clock of its events.

        If frames come from another camera, it keeps its lens and its pose relative to the event camera. The trajectory
        of frames whose exposures are corrected to beyond the poses reaches as far as they do.

        Args:
            given: Frames within the poses.
            recording: As it was read.
        """
        start, end = given.trajectory.start, given.trajectory.end
        if self.frame_delay:
            exposed = given.exposed - round(MILLISECOND * self.frame_delay)
            start, end = min(start, int(exposed.min())), max(end, int(exposed.max()))
        return self._frames(given, recording, start, end)

    def _frames(self, given: Frames, recording: EventRecording, start: int, end: int) -> Frames:
        """Corrected frames, as `frames` has them, with a trajectory from a start to an end (ns)."""
        of_events, of_frames = recording.trajectory, given.trajectory
        camera = self.camera(given.camera) if given.camera == recording.camera else given.camera
        found = replace(given, camera=camera, times=given.times - round(MILLISECOND * self.frame_delay))
        if (start, end) == (of_frames.start, of_frames.end):
            if not self.moves_poses:
                return found
            if of_frames is of_events:
                return replace(found, trajectory=self.trajectory(of_events))
        knots = self._knots(of_events, of_frames, start, end)
        poses, between = self.poses(of_events, knots), (of_frames.times[1:] + of_frames.times[:-1]) // 2
        nearest = of_frames.times[np.searchsorted(between, self.stamped(of_events, knots))]
        before, own = poses_at(of_events, nearest), poses_at(of_frames, nearest)
        back = before[:, :, :3].transpose(0, 2, 1)
        mount = back @ np.concatenate([own[:, :, :3], own[:, :, 3:] - before[:, :, 3:]], axis=2)
        moved = poses[:, :, :3] @ mount
        moved[:, :, 3] += poses[:, :, 3]
        return replace(found, trajectory=_trajectory(knots, moved))

    def recording(self, given: EventRecording) -> EventRecording:
        """The recording with corrected camera, poses and frames. Events and frames come from the same files.

        Frames that are corrected to beyond the poses are left out.
        """
        if not (self.moves_poses or self.changes_lens or self.frame_delay):
            return given
        frames, blurred = (
            None if kind is None else self._frames(kind, given, kind.trajectory.start, kind.trajectory.end)
            for kind in (given.frames, given.blurred_frames)
        )
        return replace(
            given,
            camera=self.camera(given.camera),
            trajectory=self.trajectory(given.trajectory),
            frames=frames,
            blurred_frames=blurred,
            as_read=given,
        )


def poses_at(trajectory: Trajectory, times: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, "times 3 4"]:
    """Camera-to-world matrices [R | t] at any times (ns).

    Before the first pose and after the last one, the camera moves on at the speed between the two nearest poses.
    """
    inside = times.clip(trajectory.start, trajectory.end)
    poses = trajectory.poses(torch.from_numpy(inside)).numpy()
    ends = (trajectory.times[:2], times < trajectory.start), (trajectory.times[:-3:-1], times > trajectory.end)
    for (last, other), beyond in ends:
        if beyond.any():
            first, second = trajectory.poses(torch.tensor([last, other])).numpy()
            steps = ((times[beyond] - last) / (other - last))[:, None]
            turn = Rotation.from_matrix(first[:, :3].T @ second[:, :3]).as_rotvec()
            poses[beyond, :, :3] = first[:, :3] @ Rotation.from_rotvec(steps * turn).as_matrix()
            poses[beyond, :, 3] = first[:, 3] + steps * (second[:, 3] - first[:, 3])
    return poses


def _moved(
    poses: Float64[np.ndarray, "poses 3 4"],
    shifts: Float64[np.ndarray, "#poses 3"],
    turns: Float64[np.ndarray, "#poses 3"],
) -> Float64[np.ndarray, "poses 3 4"]:
    """Poses after a shift (metres) and a turn (rotation vector) of each camera in its own axes."""
    rotation = poses[:, :, :3]
    position = poses[:, :, 3] + (rotation @ shifts[:, :, None])[..., 0]
    return np.concatenate([rotation @ Rotation.from_rotvec(turns).as_matrix(), position[..., None]], axis=-1)


def _middle(given: Trajectory) -> int:
    return (given.start + given.end) // 2


def _trajectory(times: Int64[np.ndarray, " poses"], poses: Float64[np.ndarray, "poses 3 4"]) -> Trajectory:
    return Trajectory(times, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat())
