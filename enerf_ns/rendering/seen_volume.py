"""Which part of the scene the event camera saw, and where the events came from, by the depth that a field renders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from nerfstudio.models.base_model import Model
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.poses.posed_camera import PosedCamera

VOXELS = 64
"""Voxels along the longest side of the box."""

NUM_RAYS = 60_000
"""Rays, spread over the picture and the trajectory, that find out what was seen: 20 for each voxel of a side of the
box."""

NUM_EVENTS = 20_000
"""Events, at most, that find out where events come from."""

FEW_EVENTS = 0.02
"""As many events as make a place half known, as a share of `SeenVolume.mean_events`."""

STEPS_A_VOXEL = 2
"""Places on a ray, for each voxel that it could pass, of which is noted which voxel they are in."""


@dataclass(frozen=True)
class SeenVolume:
    """Voxels over the scene box: which of them the camera's rays passed, and how many events came from each.

    A voxel is seen where a ray passes it between where the field's samples begin and one voxel behind the surface that
    the ray shows. What lies beyond the box, as with contraction, counts as not seen, and its events are not counted.
    """

    aabb: Float[Tensor, "2 3"]
    """Lowest and highest corner of the box, scene units."""
    is_seen: Bool[Tensor, "x y z"]
    """Which voxels were seen."""
    num_events: Float[Tensor, "x y z"]
    """Events of the whole recording whose rays end in a voxel or in one of the 26 around it."""
    mean_events: float
    """Mean of these numbers over what the camera sees, each pixel alike."""

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model, recording: EventRecording, index: EventIndex, camera: PosedCamera) -> SeenVolume:
        """What the events' camera saw of a trained field; takes a second on two cores.

        Args:
            model: Whose depth is taken, as in evaluation. It is left as it was.
            recording: That it learnt from. Instants that are held out or in gaps of the poses that are kept count too;
                those in gaps that are left out do not.
            index: Of the recording's events.
            camera: Of the events, along the trajectory of the recording.
        """
        aabb = model.scene_box.aabb
        width, height, device = camera.camera.width, camera.camera.height, aabb.device
        # a sequence that fills the picture evenly at any part of the time: M. Roberts, "The unreasonable effectiveness
        # of quasirandom sequences", 2018
        places = torch.arange(NUM_RAYS, dtype=torch.float64)[:, None] * torch.tensor([0.7548776662, 0.5698402910])
        x, y = (places % 1.0 * torch.tensor([width, height])).long().unbind(-1)
        times = torch.from_numpy(recording.instants(NUM_RAYS))
        events = index.events(at_most=NUM_EVENTS)
        share = len(events) / len(index)
        posed = torch.from_numpy(~recording.in_left_out_gaps(events.t))
        event_pixels = torch.from_numpy(events.y.astype(int) * width + events.x)[posed]
        pixels = torch.cat([y * width + x, event_pixels]).to(device)
        rays = camera.rays(pixels, torch.cat([times, torch.from_numpy(events.t)[posed]]).to(device))

        was_training = model.training
        model.train(False)
        assert model.collider is not None
        rays = model.collider(rays)
        depths = model.get_outputs_for_camera_ray_bundle(rays.reshape((1, len(rays))))["depth"].view(-1, 1).to(device)
        model.train(was_training)

        shape = voxels_of(aabb)
        voxel = float((aabb[1] - aabb[0]).max()) / VOXELS
        looks, ends = rays[:NUM_RAYS], rays.origins + rays.directions * depths
        assert looks.nears is not None
        is_seen = passed(aabb, shape, looks.origins, looks.directions, looks.nears, depths[:NUM_RAYS] + voxel)
        volume = cls(aabb, is_seen, around(counts(aabb, shape, ends[NUM_RAYS:])) / share, 0.0)
        return replace(volume, mean_events=float(volume.events(ends[:NUM_RAYS]).mean()))

    def seen(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether points (scene units) lie in voxels that were seen."""
        voxels, inside = numbers_of(self.aabb, self.is_seen.shape, points)
        return self.is_seen.flatten()[voxels] & inside

    def events(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """How many events of the whole recording came from the voxels that points (scene units) lie in, or from one
        beside it."""
        voxels, inside = numbers_of(self.aabb, self.num_events.shape, points)
        return self.num_events.flatten()[voxels] * inside

    def evidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """How well events tell of what is at points (scene units), from 0, without any, to 1, with beyond number:
        n / (n + few) for n `events`, where few is `FEW_EVENTS` of their mean."""
        events = self.events(points)
        return events / (events + max(FEW_EVENTS * self.mean_events, 1e-6))


def voxels_of(aabb: Float[Tensor, "2 3"]) -> torch.Size:
    """Voxels along each side of a box, which are about cubes."""
    sides = aabb[1] - aabb[0]
    return torch.Size((VOXELS * sides / sides.max()).round().long().clamp(min=1).tolist())


def numbers_of(aabb: Float[Tensor, "2 3"], shape: torch.Size, points: Float[Tensor, "*batch 3"]):
    """The number of the voxel of each point, 0 beyond the box; and which are within.

    Args:
        aabb: Lowest and highest corner of the box.
        shape: Voxels along each side.
        points: Anywhere.
    """
    places = (points - aabb[0]) / (aabb[1] - aabb[0])
    inside = ((places >= 0.0) & (places < 1.0)).all(-1)
    x, y, z = (places.nan_to_num().clamp(0.0, 1.0 - 1e-6) * places.new_tensor(shape)).long().unbind(-1)
    return torch.where(inside, (x * shape[1] + y) * shape[2] + z, 0), inside


def passed(
    aabb: Float[Tensor, "2 3"],
    shape: torch.Size,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    begins: Float[Tensor, "rays 1"],
    ends: Float[Tensor, "rays 1"],
) -> Bool[Tensor, "x y z"]:
    """Which voxels of a box rays pass, but for corners of them that they cut off.

    Args:
        aabb: Lowest and highest corner of the box.
        shape: Voxels along each side.
        origins, directions: Of the rays; directions of length 1.
        begins, ends: Distances along each ray between which it counts.
    """
    found = torch.zeros(shape.numel(), dtype=torch.bool, device=aabb.device)
    step = float((aabb[1] - aabb[0]).max()) / max(shape) / STEPS_A_VOXEL
    diagonal = float((aabb[1] - aabb[0]).norm())
    to_corners = (aabb[:, None] - origins) / directions.where(directions.abs() > 1e-12, 1e-12)
    begins = torch.maximum(begins, to_corners.amin(0).amax(-1, keepdim=True))  # where the box begins
    for number in range(int(diagonal / step) + 2):
        distances = begins + number * step
        left = (distances < ends)[:, 0]
        if not left.any():
            break
        origins, directions, begins, ends = (column[left] for column in (origins, directions, begins, ends))
        voxels, inside = numbers_of(aabb, shape, origins + directions * distances[left])
        found[voxels[inside]] = True
    return found.view(shape)


def counts(aabb: Float[Tensor, "2 3"], shape: torch.Size, points: Float[Tensor, "points 3"]) -> Float[Tensor, "x y z"]:
    """How many points lie in each voxel of a box."""
    voxels, inside = numbers_of(aabb, shape, points)
    return torch.bincount(voxels[inside], minlength=shape.numel()).float().view(shape)


def around(values: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """The sum over each voxel and those beside it, corners included."""
    padded = torch.nn.functional.pad(values[None, None], (1,) * 6)
    return 27.0 * torch.nn.functional.avg_pool3d(padded, 3, stride=1)[0, 0]
