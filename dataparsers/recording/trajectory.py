"""Camera poses at any time: slerp for rotation, a cubic spline for translation, batched in torch."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from torch import Tensor

GAP_RATIO = 10
"""Least length of a gap between poses, as a multiple of the median interval. Poses within a gap are guesses."""

MIN_GAP = 100_000_000
"""Shortest gap between poses, ns. A hand turns the camera by many degrees within a gap of this length."""


def evenly_spaced(start: int, end: int, number: int) -> Int64[np.ndarray, " number"]:
    """Returns instants from `start` to `end` (ns), both included, each rounded down; `np.linspace` is not exact.

    Args:
        start, end: Nanoseconds from any zero; start + i * (end - start) / (number - 1) is computed in integers.
        number: Number of instants, at least 2.
    """
    whole, rest = divmod(int(end) - int(start), number - 1)
    steps = np.arange(number, dtype=np.int64)
    return int(start) + whole * steps + rest * steps // (number - 1)


class Trajectory:
    """Camera-to-world poses at given times, and between them.

    Rotation is spherical linear interpolation along the shorter arc (Shoemake, SIGGRAPH 1985), equal to
    `scipy.spatial.transform.Slerp`; translation is the cubic spline through all positions with not-a-knot ends, equal
    to `scipy.interpolate.CubicSpline` (a line through two positions, a parabola through three). E-NeRF uses the same.

    Args:
        times: Nanoseconds, strictly increasing, at least two.
        positions: Camera centres in the world, metres.
        quaternions: Camera-to-world rotations, xyzw; they are normalised here.

    Raises:
        ValueError: Fewer than two poses, times that do not increase, positions that are not finite, a quaternion of
            norm zero, or arrays whose lengths differ.
    """

    def __init__(
        self,
        times: Int64[np.ndarray, " poses"],
        positions: Float64[np.ndarray, "poses 3"],
        quaternions: Float64[np.ndarray, "poses 4"],
    ):
        self.times, self.positions, self.quaternions = times, positions, quaternions
        self.body: tuple[Trajectory, Float64[np.ndarray, "4 4"]] | None = None
        """The body of this camera, and the camera's pose there, if `of_mounted` made this trajectory."""
        if not len(times) == len(positions) == len(quaternions):
            raise ValueError(
                f"A trajectory needs one position and one quaternion for each time, but got {len(times)} times, "
                f"{len(positions)} positions and {len(quaternions)} quaternions."
            )
        rotations = Rotation.from_quat(quaternions)
        spline = CubicSpline((times - times[:1]) * 1e-9, positions)
        self.start, self.end = int(times[0]), int(times[-1])

        steps = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
        angles = np.linalg.norm(steps, axis=-1)
        x, y, z = (steps / np.where(angles > 0, angles, 1.0)[:, None]).T
        zero = np.zeros_like(x)
        cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
        first = rotations[:-1].as_matrix()
        segments = np.stack([first, first @ cross, first @ cross @ cross], axis=1)
        self._knots = {
            torch.device("cpu"): (
                torch.tensor(times),
                torch.from_numpy(angles),
                torch.from_numpy(segments),
                torch.tensor(spline.c.transpose(1, 0, 2)),
            )
        }

    def of_mounted(self, body_from_camera: Float64[np.ndarray, "4 4"]) -> Trajectory:
        """Returns the trajectory of a camera that is fixed to this body.

        Args:
            body_from_camera: The extrinsics: pose of the camera in the axes of the body, metres.
        """
        bodies, mount = Rotation.from_quat(self.quaternions), Rotation.from_matrix(body_from_camera[:3, :3])
        mounted = Trajectory(
            self.times, self.positions + bodies.apply(body_from_camera[:3, 3]), (bodies * mount).as_quat()
        )
        mounted.body = self, body_from_camera
        return mounted

    def covers(self, times: Int64[Tensor | np.ndarray, "*batch"]) -> Bool[Tensor | np.ndarray, "*batch"]:
        """Returns which times (ns) lie between the first and the last pose, both included."""
        return (times >= self.start) & (times <= self.end)

    @property
    def longest_step(self) -> int:
        """Longest time (ns) between two poses that is not a gap."""
        return max(int(GAP_RATIO * np.median(np.diff(self.times))), MIN_GAP)

    @cached_property
    def gaps(self) -> Int64[np.ndarray, "gaps 2"]:
        """Times (ns) of the poses at both ends of each gap that is longer than `longest_step`."""
        before = np.flatnonzero(np.diff(self.times) > self.longest_step)
        return np.stack([self.times[before], self.times[before + 1]], axis=1)

    def in_gaps(
        self, times: Int64[np.ndarray, "*batch"], ends: Int64[np.ndarray, "*batch"] | None = None
    ) -> Bool[np.ndarray, "*batch"]:
        """Returns which times (ns), or intervals from times to ends (ns), overlap one of the `gaps`.

        The poses at the ends of a gap are known, so they are not in it.
        """
        ends = times if ends is None else ends
        return np.searchsorted(self.gaps[:, 0], ends) > np.searchsorted(self.gaps[:, 1], times, "right")

    def poses(
        self, times: Int64[Tensor, "*batch"], delays: Float64[Tensor, "*batch"] | None = None
    ) -> Float64[Tensor, "*batch 3 4"]:
        """Returns camera-to-world matrices [R | t] (OpenCV axes, metres) at the given times, on their device.

        With segment i from t_i to t_{i+1}, its rotation axis k (camera axes) and angle, and phi the part of the angle
        passed at time t, Rodrigues' formula gives R(t) = R_i (1 + sin(phi) [k]x + (1 - cos(phi)) [k]x^2).

        Args:
            times: Nanoseconds.
            delays: Nanoseconds, of any sign, that are added to the times; the poses are differentiable in them.
                Default: no delays.

        Raises:
            ValueError: A time is outside [start, end]. On a GPU the pose is NaN instead, since a check would wait for
                the GPU.
        """
        fraction = None
        if delays is not None:
            whole = delays.detach().round()
            times, fraction = times + whole.long(), (delays - whole).flatten()
        if times.numel() and times.device.type == "cpu" and not self.covers(times).all():
            raise ValueError(
                f"Poses were asked for times from {times.min().item() * 1e-9:.6f} s to {times.max().item() * 1e-9:.6f} "
                f"s, but the trajectory covers only {self.start * 1e-9:.6f} s to {self.end * 1e-9:.6f} s."
            )
        knots, angles, rotations, spline = self._knots_on(times.device)
        flat = times.flatten().contiguous()
        segment = torch.searchsorted(knots, flat, right=True).sub_(1).clamp_(max=len(angles) - 1)
        passed = (flat - knots[segment]).double()
        if flat.device.type != "cpu":
            passed = passed.where((flat >= self.start) & (flat <= self.end), torch.nan)
        if fraction is not None:
            passed = passed + fraction
        duration = (knots[1:] - knots[:-1])[segment]
        phi = (angles[segment] * passed / duration)[:, None, None]
        poses = flat.new_empty((len(flat), 3, 4), dtype=torch.float64)
        fixed, sine, cosine = rotations[segment].unbind(1)
        poses[..., :3] = fixed.addcmul(phi.sin(), sine).addcmul(2.0 * (0.5 * phi).sin() ** 2, cosine)
        cubic, square, linear, constant = spline[segment].unbind(1)
        seconds = (passed * 1e-9)[:, None]
        poses[..., 3] = constant.addcmul(seconds, linear.addcmul(seconds, square.addcmul(seconds, cubic)))
        return poses.reshape(*times.shape, 3, 4)

    def _knots_on(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if device not in self._knots:
            on_cpu = self._knots[torch.device("cpu")]
            times, angles, rotations, spline = (tensor.to(device) for tensor in on_cpu)
            self._knots[device] = times, angles, rotations, spline
        return self._knots[device]
