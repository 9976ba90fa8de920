"""The part of the scene that the event camera saw, and the places that events came from, by rendered depth."""

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
"""Number of rays, spread over the picture and the trajectory, that find the voxels that were seen: about 15 for each
voxel of a face of a cubic box."""

NUM_EVENTS = 20_000
"""Largest number of events that find the places that events come from."""

FEW_EVENTS = 0.08
"""Number of events at which `SeenVolume.evidence` is 0.5, relative to their mean number. A field that contracts fog is
thin at untextured surfaces, too: only events tell where its depth is right."""

FEWEST_SAMPLED = 10
"""Least number of sampled events at which the evidence is 0.5. Some events come from outlines whose place is not exact,
and lie where no surface is."""

OUTLINE = 2
"""Distance in pixels up to which the ray of an event passes the outline of an object. There, events come from the
object, and not from what it hides."""

STEP = 0.1
"""Least share of the depth by which an outline stands before what it hides; smaller steps are those of curved
surfaces."""

STEPS_A_VOXEL = 2
"""Number of points on a ray, for each length of a voxel's side, whose voxels count as passed."""


@dataclass(frozen=True)
class SeenVolume:
    """Voxels over the scene box: whether the camera saw each of them, and how many events came from it.

    A voxel is seen if a ray of the camera passes it. The ray begins where the field's samples begin, and ends one voxel
    behind the surface that it renders. Space beyond the box, which exists with contraction, is never seen, and has no
    events.
    """

    aabb: Float[Tensor, "2 3"]
    """Lowest and highest corner of the box, in scene units."""
    is_seen: Bool[Tensor, "x y z"]
    """Whether each voxel was seen."""
    num_events: Float[Tensor, "x y z"]
    """Number of events of the whole recording that came from the voxel or one of its 26 neighbours. An event came from
    the end of its ray, or from as near as a surface `OUTLINE` pixels beside it."""
    few_events: float
    """The value of `num_events` at which the evidence is 0.5: `FEW_EVENTS` times the mean of `num_events` over the
    surfaces that the camera sees, with equal weight for each pixel, but at least `FEWEST_SAMPLED` sampled events."""

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model, recording: EventRecording, index: EventIndex, camera: PosedCamera) -> SeenVolume:
        """Returns what the event camera saw of a trained field. This takes about 1 s on two cores.

        Args:
            model: The model that renders depth, as in evaluation. Its mode is the same afterwards.
            recording: The recording that the model learns from. Held-out instants count. Instants in gaps of the
                trajectory count, too, unless the gap is left out.
            index: Index of the recording's events.
            camera: The event camera along the recording's trajectory.
        """
        aabb = model.scene_box.aabb
        width, height, device = camera.camera.width, camera.camera.height, aabb.device
        # a sequence that fills the picture evenly in any part of the time: M. Roberts, "The unreasonable effectiveness
        # of quasirandom sequences", 2018
        places = torch.arange(NUM_RAYS, dtype=torch.float64)[:, None] * torch.tensor([0.7548776662, 0.5698402910])
        x, y = (places % 1.0 * torch.tensor([width, height])).long().unbind(-1)
        times = torch.from_numpy(recording.instants(NUM_RAYS))
        events = index.events(at_most=NUM_EVENTS)
        share = len(events) / len(index)
        posed = torch.from_numpy(~recording.in_left_out_gaps(events.t))
        event_x, event_y, event_times = (
            torch.from_numpy(column.astype(int))[posed] for column in (events.x, events.y, events.t)
        )
        around = [
            (event_y + OUTLINE * down).clamp(0, height - 1) * width + (event_x + OUTLINE * right).clamp(0, width - 1)
            for right, down in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
        ]
        pixels = torch.cat([y * width + x, *around]).to(device)
        rays = camera.rays(pixels, torch.cat([times, event_times.repeat(len(around))]).to(device))

        was_training = model.training
        model.train(False)
        assert model.collider is not None
        rays = model.collider(rays)
        depths = model.get_outputs_for_camera_ray_bundle(rays.reshape((1, len(rays))))["depth"].view(-1, 1).to(device)
        model.train(was_training)

        shape = grid_shape(aabb)
        voxel = float((aabb[1] - aabb[0]).max()) / VOXELS
        looks, of_events = rays[:NUM_RAYS], rays[NUM_RAYS : NUM_RAYS + len(event_times)]
        assert looks.nears is not None
        is_seen = voxels_on_rays(aabb, shape, looks.origins, looks.directions, looks.nears, depths[:NUM_RAYS] + voxel)
        came_from = of_events.origins + of_events.directions * before_outlines(
            depths[NUM_RAYS:].view(len(around), -1, 1)
        )
        volume = cls(aabb, is_seen, sum_of_neighbours(points_per_voxel(aabb, shape, came_from)) / share, 0.0)
        seen_at = looks.origins + looks.directions * depths[:NUM_RAYS]
        few = FEW_EVENTS * float(volume.events(seen_at).mean())
        return replace(volume, few_events=max(few, FEWEST_SAMPLED / share))

    def seen(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Returns whether points, in scene units, lie in voxels that were seen."""
        voxels, inside = voxel_indices(self.aabb, self.is_seen.shape, points)
        return self.is_seen.flatten()[voxels] & inside

    def events(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Returns how many events came from the voxel of each point, in scene units, and from its neighbours."""
        voxels, inside = voxel_indices(self.aabb, self.num_events.shape, points)
        return self.num_events.flatten()[voxels] * inside

    def evidence(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Returns the evidence of events at points, in scene units: from 0 without events to 1 with very many.

        It is n / (n + few) for n `events`, where few is `few_events`.
        """
        events = self.events(points)
        return events / (events + self.few_events)


def before_outlines(depths: Float[Tensor, "5 events 1"]) -> Float[Tensor, "events 1"]:
    """Returns the depths that events came from: at an outline that of the object, elsewhere that of the event's ray.

    Inverse depth is linear over the picture of a plane. At an outline it has a step, so that the mean of two opposite
    neighbours is above the value between them on the side of what is hidden.

    Args:
        depths: Depth of the ray of each event and of its neighbours: right, left, below, above. 0 is that of a ray
            that meets nothing.
    """
    inverse = torch.where(depths > 0.0, 1.0 / depths, 0.0)
    own, right, left, below, above = inverse
    bends = torch.maximum(right + left, below + above) - 2.0 * own
    return torch.where(bends > STEP * own, 1.0 / inverse.amax(0), depths[0])


def is_rim(depth: Float[Tensor, "height width 1"]) -> Bool[Tensor, "height width 1"]:
    """Returns which pixels of a picture are the outermost of a surface that hides another.

    A surface is rendered up to a pixel too wide, since density falls off within a cell of the hash grid, so that the
    true depth of a rim may be that of what lies behind.

    Args:
        depth: Depth of pixels. 0 is that of a ray that meets nothing.
    """
    inverse = torch.where(depth > 0.0, 1.0 / depth, 0.0)[..., 0]
    padded = torch.nn.functional.pad(inverse[None, None], (1,) * 4, mode="replicate")[0, 0]
    right, left = padded[1:-1, 2:], padded[1:-1, :-2]
    below, above = padded[2:, 1:-1], padded[:-2, 1:-1]
    bends = torch.minimum(right + left, below + above) - 2.0 * inverse
    return (bends < -STEP * inverse)[..., None]


def grid_shape(aabb: Float[Tensor, "2 3"]) -> torch.Size:
    """Returns the number of voxels, which are almost cubes, along each side of a box."""
    sides = aabb[1] - aabb[0]
    return torch.Size((VOXELS * sides / sides.max()).round().long().clamp(min=1).tolist())


def voxel_indices(aabb: Float[Tensor, "2 3"], shape: torch.Size, points: Float[Tensor, "*batch 3"]):
    """Returns the index of each point's voxel in the flattened grid, and whether the point is inside the box.

    The index of a point outside the box is 0.

    Args:
        aabb: Lowest and highest corner of the box.
        shape: Number of voxels along each side.
        points: Points inside or outside the box.
    """
    places = (points - aabb[0]) / (aabb[1] - aabb[0])
    inside = ((places >= 0.0) & (places < 1.0)).all(-1)
    x, y, z = (places.nan_to_num().clamp(0.0, 1.0 - 1e-6) * places.new_tensor(shape)).long().unbind(-1)
    return torch.where(inside, (x * shape[1] + y) * shape[2] + z, 0), inside


def voxels_on_rays(
    aabb: Float[Tensor, "2 3"],
    shape: torch.Size,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    begins: Float[Tensor, "rays 1"],
    ends: Float[Tensor, "rays 1"],
) -> Bool[Tensor, "x y z"]:
    """Returns the voxels of a box that rays pass. A voxel of which a ray cuts only a corner may be missed.

    Args:
        aabb: Lowest and highest corner of the box.
        shape: Number of voxels along each side.
        origins, directions: Origins and directions of the rays; directions have length 1.
        begins, ends: Distances along each ray at which it begins and ends.
    """
    found = torch.zeros(shape.numel(), dtype=torch.bool, device=aabb.device)
    step = float((aabb[1] - aabb[0]).max()) / max(shape) / STEPS_A_VOXEL
    diagonal = float((aabb[1] - aabb[0]).norm())
    to_corners = (aabb[:, None] - origins) / directions.where(directions.abs() > 1e-12, 1e-12)
    begins = torch.maximum(begins, to_corners.amin(0).amax(-1, keepdim=True))  # the first point in the box
    for number in range(int(diagonal / step) + 2):
        distances = begins + number * step
        left = (distances < ends)[:, 0]
        if not left.any():
            break
        origins, directions, begins, ends = (column[left] for column in (origins, directions, begins, ends))
        voxels, inside = voxel_indices(aabb, shape, origins + directions * distances[left])
        found[voxels[inside]] = True
    return found.view(shape)


def points_per_voxel(
    aabb: Float[Tensor, "2 3"], shape: torch.Size, points: Float[Tensor, "points 3"]
) -> Float[Tensor, "x y z"]:
    """Returns the number of points in each voxel of a box."""
    voxels, inside = voxel_indices(aabb, shape, points)
    return torch.bincount(voxels[inside], minlength=shape.numel()).float().view(shape)


def sum_of_neighbours(values: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """Returns for each voxel the sum of its value and the values of its 26 neighbours."""
    padded = torch.nn.functional.pad(values[None, None], (1,) * 6)
    return 27.0 * torch.nn.functional.avg_pool3d(padded, 3, stride=1)[0, 0]
