"""Rays of pixels at given times, in the axes and the unit of the scene."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.kernels.precision import full_precision


class PosedCamera:
    """A camera that moves along a trajectory, so that each ray starts at the camera's place at its own time.

    Args:
        camera: With its distortion.
        trajectory: Of this camera.
        transform: [R | t] of the scene, shape (3, 4): a point p of the recording's world lies at scale * (R p + t).
            It is float64, since the world's origin may be far away.
        scale: Scene units per metre.
        device: Of the rays.
    """

    def __init__(
        self,
        camera: Camera,
        trajectory: Trajectory,
        transform: Float64[Tensor, "3 4"],
        scale: float,
        device: torch.device | str = "cpu",
    ):
        self.camera, self.trajectory, self.scale = camera, trajectory, scale
        self._transform = transform.to(device)
        directions = camera.pixel_directions().reshape(-1, 3)
        norms = np.linalg.norm(directions, axis=-1, keepdims=True)
        self._directions = torch.from_numpy(directions / norms).float().to(device)
        self._norms = torch.from_numpy(norms).float().to(device)

    @full_precision
    def rays(
        self,
        pixels: Int64[Tensor, " rays"],
        times: Int64[Tensor, " rays"],
        delays: Float64[Tensor, " rays"] | None = None,
        corrections: Float[Tensor, "rays 6"] | None = None,
        places: Float[Tensor, "rays 2"] | None = None,
    ) -> RayBundle:
        """A ray bundle through pixels, differentiable with respect to `delays` and `corrections`.

        Args:
            pixels: Numbers of the pixels, y * width + x.
            times: Times (ns) within the trajectory.
            delays: Nanoseconds that are added to the times, for delays that are learned. Default: none.
            corrections: Corrections of the poses in the axes of the camera: a shift (metres), then a rotation vector
                (radians). Default: none.
            places: Position of each ray in its pixel, x and y from the pixel's centre, pixels. Default: the centre.

        Returns:
            origins (rays, 3) in scene units, directions (rays, 3) of length 1, pixel_area (rays, 1), and in the
            metadata directions_norm (rays, 1): the distance along a ray per unit of depth along the optical axis.

        Raises:
            ValueError: A time lies outside the trajectory.
        """
        poses = self.trajectory.poses(times, delays)
        rotation, position = poses[..., :3], poses[..., 3]
        if corrections is not None:
            correction = exp_map_SO3xR3(corrections.double())
            position = position + (rotation @ correction[..., 3:])[..., 0]
            rotation = rotation @ correction[..., :3]
        rotation = self._transform[:, :3] @ rotation
        origins = self.in_scene(position)
        towards, norms = self._directions[pixels], self._norms[pixels]
        if places is not None:
            right, down = self._steps
            aside = places[:, :1] * right[pixels] + places[:, 1:] * down[pixels]
            towards = towards * norms + torch.nn.functional.pad(aside, (0, 1))
            norms = torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
            towards = towards / norms
        directions = torch.einsum("nij,nj->ni", rotation.float(), towards)
        area = 1.0 / (self.camera.fx * self.camera.fy)
        return RayBundle(
            origins=origins.float(),
            directions=directions,
            pixel_area=torch.full_like(origins[:, :1], area, dtype=torch.float32),
            metadata={"directions_norm": norms},
        )

    def in_scene(self, points: Float64[Tensor, "points 3"]) -> Float64[Tensor, "points 3"]:
        """Points of the recording's world (metres), in scene units."""
        return self.scale * (points @ self._transform[:, :3].T + self._transform[:, 3])

    def axes(self, times: Int64[Tensor, " rays"]) -> Float[Tensor, "rays 3 3"]:
        """Rotations from the axes of the camera at some times (ns) to the axes of the scene."""
        return (self._transform[:, :3] @ self.trajectory.poses(times)[..., :3]).float()

    @cached_property
    def _steps(self) -> tuple[Tensor, Tensor]:
        """`Camera.pixel_steps` on the device, with one row for each pixel."""
        right, down = (torch.from_numpy(step).float().view(-1, 2) for step in self.camera.pixel_steps())
        return right.to(self._norms.device), down.to(self._norms.device)
