"""Seen voxels and the places of events, against slow loops and in front of a wall."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.scene_colliders import NearFarCollider
from small_runs import set_up, small_config

from enerf_ns.method.model import BoxCollider
from enerf_ns.rendering import seen_volume
from enerf_ns.rendering.seen_volume import (
    FEW_EVENTS,
    NUM_EVENTS,
    OUTLINE,
    STEP,
    STEPS_A_VOXEL,
    SeenVolume,
    before_outlines,
    grid_shape,
    is_rim,
    points_per_voxel,
    sum_of_neighbours,
    voxel_indices,
    voxels_on_rays,
)

WALL = 0.3


class WallModel:
    """A model of an infinite wall at y = 0.3 of the scene. All rays that look towards it hit it."""

    def __init__(self, aabb: torch.Tensor, collider: Any):
        self.scene_box, self.collider, self.training = SceneBox(aabb), collider, True

    def train(self, mode: bool = True) -> None:
        self.training = mode

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> dict[str, torch.Tensor]:
        assert not self.training
        rays = camera_ray_bundle
        assert rays.fars is not None
        depth = (WALL - rays.origins[..., 1:2]) / rays.directions[..., 1:2]
        return {"depth": torch.where(depth > 0, depth, rays.fars)}


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return set_up(small_config(recording, tmp_path_factory.mktemp("outputs"))).pipeline


@pytest.mark.parametrize("contraction", [False, True])
def test_behind_a_wall_nothing_is_seen_and_before_it_all_that_the_camera_looks_at(pipeline: Any, contraction: bool):
    box, manager = pipeline.model.scene_box, pipeline.datamanager
    near = pipeline.model.config.near_plane
    collider = NearFarCollider(near, 1000.0, reset_near_plane=False) if contraction else BoxCollider(box, near)
    model: Any = WallModel(box.aabb, collider)
    volume = SeenVolume.of(model, manager.recording, manager.index, manager.event_camera)
    assert model.training  # as it was

    voxel = 2.0 / 64
    camera, recording = manager.event_camera, manager.recording
    middle = camera.camera.height // 2 * camera.camera.width + camera.camera.width // 2
    rays = camera.rays(torch.tensor([middle]), torch.from_numpy(recording.instants(3)[1:2]))
    origin, direction = rays.origins[0], rays.directions[0]
    assert direction[1] > 0.5  # the camera looks along y
    hit = float((WALL - origin[1]) / direction[1])
    looked_through = origin + direction * torch.linspace(near, hit, 50)[:, None]
    looked_through = looked_through[(looked_through > box.aabb[0]).all(-1)]
    assert volume.seen(looked_through).all()

    aabb = volume.aabb
    points = aabb[0] + torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * (aabb[1] - aabb[0])
    behind = points[:, 1] > WALL + 3 * voxel
    assert behind.sum() > 1000
    assert not volume.seen(points[behind]).any()
    assert not volume.events(points[behind]).any()
    assert not volume.seen(2.0 * aabb).any() and not volume.events(2.0 * aabb).any()
    everywhere = (points[:, 1] - WALL).abs() > 3 * voxel
    assert not volume.events(points[everywhere]).any()

    events = manager.index.events()
    pixels = torch.from_numpy(events.y.astype(int) * camera.camera.width + events.x)
    rays = camera.rays(pixels, torch.from_numpy(events.t))
    ends = rays.origins + rays.directions * ((WALL - rays.origins[:, 1:2]) / rays.directions[:, 1:2])
    for end in ends[:: len(ends) // 5]:
        distance = ((ends - end).abs() / voxel).amax(-1)
        assert (distance < 0.9).sum() * 0.7 <= volume.events(end) <= (distance < 2.1).sum() * 1.3


def test_voxels_passed_are_those_that_a_loop_over_exact_chords_finds():
    generator = np.random.default_rng(0)
    aabb = torch.tensor([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.25]])
    shape, number = torch.Size((16, 8, 4)), 60
    origins = generator.uniform(-1.5, 1.5, (number, 3))
    directions = generator.normal(size=(number, 3))
    directions[0] = [1.0, 0.0, 0.0]  # along an axis
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    begins, ends = generator.uniform(0, 0.5, (number, 1)), generator.uniform(0.5, 2.5, (number, 1))
    tensors = [torch.from_numpy(column).float() for column in (origins, directions, begins, ends)]
    found = voxels_on_rays(aabb, shape, *tensors).numpy()

    longest, voxel = np.zeros(tuple(shape)), 2.0 / 16
    low = aabb[0].numpy()
    for origin, direction, begin, end in zip(origins, directions, begins[:, 0], ends[:, 0], strict=True):
        for place in np.ndindex(*shape):
            corner = low + voxel * np.array(place)
            with np.errstate(divide="ignore"):
                cuts = np.sort(np.stack([corner - origin, corner + voxel - origin]) / direction, axis=0)
            chord = min(cuts[1].min(), end) - max(cuts[0].max(), begin)
            longest[place] = max(longest[place], chord)
    assert found.any() and not found.all()
    assert found[longest > voxel / STEPS_A_VOXEL + 1e-4].all()
    assert not found[longest < -1e-4].any()


def test_counts_and_their_surroundings_are_those_of_a_loop():
    aabb = torch.tensor([[0.0, 0.0, 0.0], [4.0, 2.0, 3.0]])
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 6.0 - 1.0
    shape = torch.Size((4, 2, 3))
    expected = np.zeros(tuple(shape))
    for point in points.numpy():
        if (point >= 0).all() and (point < [4, 2, 3]).all():
            expected[tuple(point.astype(int))] += 1
    found = points_per_voxel(aabb, shape, points)
    np.testing.assert_array_equal(found.numpy(), expected)
    smoothed = sum_of_neighbours(found).numpy()
    for x, y, z in np.ndindex(*shape):
        near = expected[max(x - 1, 0) : x + 2, max(y - 1, 0) : y + 2, max(z - 1, 0) : z + 2]
        assert smoothed[x, y, z] == pytest.approx(near.sum(), rel=1e-5)


def test_voxels_are_about_cubes_and_what_is_no_number_lies_in_none():
    aabb = torch.tensor([[-1.0, -0.5, -0.01], [1.0, 0.5, 0.01]])
    assert grid_shape(aabb) == (64, 32, 1)
    _, inside = voxel_indices(
        aabb, grid_shape(aabb), torch.tensor([[torch.nan, 0.0, 0.0], [torch.inf, 0.0, 0.0], [0, 0, 0]])
    )
    assert inside.tolist() == [False, False, True]


def test_evidence_is_half_at_few_events_and_grows_with_their_number():
    aabb = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    numbers = torch.tensor([0.0, 4.0, 50.0, 5000.0])
    volume = SeenVolume(aabb, torch.ones(4, 1, 1, dtype=torch.bool), numbers.reshape(4, 1, 1), 4.0)
    centres = torch.tensor([[0.125 + 0.25 * voxel, 0.5, 0.5] for voxel in range(4)])
    evidence = volume.evidence(centres).tolist()
    assert evidence[:2] == pytest.approx([0.0, 0.5])
    assert evidence[2] == pytest.approx(50.0 / 54.0) and evidence[2] < evidence[3] < 1.0


@pytest.mark.parametrize("fewest", [0.1, 10])
def test_few_events_are_a_share_of_the_mean_but_no_fewer_than_some_samples(
    pipeline: Any, monkeypatch: pytest.MonkeyPatch, fewest: float
):
    monkeypatch.setattr(seen_volume, "FEWEST_SAMPLED", fewest)
    box, manager = pipeline.model.scene_box, pipeline.datamanager
    model: Any = WallModel(box.aabb, BoxCollider(box, pipeline.model.config.near_plane))
    volume = SeenVolume.of(model, manager.recording, manager.index, manager.event_camera)
    camera, instants = manager.event_camera, torch.from_numpy(manager.recording.instants(40))
    pixels = torch.arange(0, camera.camera.width * camera.camera.height, 7)
    rays = camera.rays(pixels.repeat(len(instants)), instants.repeat_interleave(len(pixels)))
    walls = rays.origins + rays.directions * ((WALL - rays.origins[:, 1:2]) / rays.directions[:, 1:2])
    share = len(manager.index.events(at_most=NUM_EVENTS)) / len(manager.index)
    of_mean, of_samples = FEW_EVENTS * float(volume.events(walls).mean()), fewest / share
    assert (of_mean < of_samples) == (fewest == 10)  # the case that is to be shown
    assert volume.few_events == pytest.approx(max(of_mean, of_samples), rel=0.1)


def _around(depth_at: Any, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Depths at pixels and `OUTLINE` pixels beside them, as `before_outlines` takes them."""
    steps = ((0, 0), (OUTLINE, 0), (-OUTLINE, 0), (0, OUTLINE), (0, -OUTLINE))
    return torch.stack([depth_at(x + right, y + down) for right, down in steps])[..., None]


def test_events_beside_an_outline_come_from_what_hides():
    """A disc of depth 1 before a wall of depth 3."""

    def depth_at(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.where((x - 50.0) ** 2 + (y - 50.0) ** 2 <= 20.0**2, 1.0, 3.0)

    y, x = (grid.flatten() for grid in torch.meshgrid(*2 * [torch.arange(100.0)], indexing="ij"))
    came_from = before_outlines(_around(depth_at, x, y))[:, 0]
    distance = ((x - 50.0) ** 2 + (y - 50.0) ** 2).sqrt() - 20.0
    torch.testing.assert_close(came_from[distance < 0.5 * OUTLINE].unique(), torch.tensor([1.0]))
    assert (came_from[distance > OUTLINE] == 3.0).all()


def test_events_beside_an_object_before_nothing_come_from_the_object():
    depths = torch.tensor([[0.0, 2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 2.0, 2.0]]).T
    assert before_outlines(depths[..., None])[:, 0].tolist() == [2.0, 0.0, 2.0]


def test_events_of_a_slanted_plane_and_of_a_ball_come_from_their_rays():
    """Of the ball without its outline, at which depth is steep."""
    focal = 100.0
    y, x = (grid.flatten() for grid in torch.meshgrid(*2 * [torch.arange(100.0)], indexing="ij"))

    def plane(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return 1.0 / (0.3 + 0.01 * (y - 20.0).clamp(min=0.0) + 0.001 * x)  # a floor that runs to a wall

    def ball(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        ray = torch.stack([(x - 50.0) / focal, (y - 50.0) / focal, torch.ones_like(x)], dim=-1)
        squared, along = (ray**2).sum(-1), 2.0 * ray[..., 2]  # centre at depth 2, radius 0.8
        root = (along**2 - squared * (4.0 - 0.8**2)).clamp(min=0.0).sqrt()
        return (along - root) / squared

    inside = (x - 50.0) ** 2 + (y - 50.0) ** 2 < 35.0**2
    for depth_at, chosen in ((plane, torch.ones_like(inside)), (ball, inside)):
        torch.testing.assert_close(
            before_outlines(_around(depth_at, x, y))[chosen][:, 0], depth_at(x, y)[chosen], rtol=0.0, atol=0.0
        )


def test_the_rim_is_the_outermost_pixel_of_a_surface_that_hides_another():
    """Against a loop that compares each pixel with both pairs of neighbours."""
    rows, columns = np.mgrid[:40, :60]
    floor = 70.0 / (rows + 30.0)  # a plane, whose inverse depth is linear
    ball = np.where((rows - 18) ** 2 + (columns - 30) ** 2 <= 100, 0.8 * floor.min(), floor)
    depth = torch.from_numpy(ball)[..., None]
    found = is_rim(depth)[..., 0].numpy()
    expected = np.zeros_like(found)
    inverse = np.pad(1.0 / ball, 1, mode="edge")
    for row, column in np.ndindex(*ball.shape):
        own = inverse[row + 1, column + 1]
        pairs = (inverse[row + 1, [column, column + 2]], inverse[[row, row + 2], column + 1])
        expected[row, column] = any(sum(pair) - 2.0 * own < -STEP * own for pair in pairs)
    np.testing.assert_array_equal(found, expected)
    inside = ball < floor
    assert found.any() and not found[~inside].any()
    core = np.logical_and.reduce([np.roll(inside, step, axis) for step in (-1, 1) for axis in (0, 1)])
    assert not found[core].any() and found[inside & ~core].mean() > 0.9


def test_nothing_is_the_rim_of_a_plane_or_of_what_meets_nothing():
    plane = torch.from_numpy(1.0 / (0.2 + 0.01 * np.arange(30.0)[:, None] + 0.002 * np.arange(40.0)))[..., None]
    assert not is_rim(plane).any() and not is_rim(torch.zeros(5, 5, 1)).any()
    assert not is_rim(torch.full((1, 1, 1), 2.0)).any()
    before_nothing = torch.zeros(5, 5, 1)
    before_nothing[2, 2] = 1.0
    assert is_rim(before_nothing).nonzero().tolist() == [[2, 2, 0]]
    assert not is_rim(torch.full((3, 3, 1), torch.nan)).any()
