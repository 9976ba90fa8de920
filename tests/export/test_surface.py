"""Surfaces from views whose depth is known: a plane and a sphere, in metres, in the axes of the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import set_up, small_config

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.export.surface import SurfaceView, colours_of, fused, pixel_size, points_of, surface_views

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
VOXEL = 0.03
LOOKING_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def view(depth: np.ndarray, place: np.ndarray, known: np.ndarray | None = None) -> SurfaceView:
    """Brighter to the right, looking along y."""
    brightness = np.broadcast_to(np.linspace(0.1, 0.5, CAMERA.width)[None, :, None], (*depth.shape, 3))
    pose = np.column_stack([LOOKING_ALONG_Y, place])
    known = np.ones(depth.shape, bool) if known is None else known
    return SurfaceView(pose, depth.astype(np.float32), known & (depth > 0), brightness.astype(np.float32))


def wall(known: np.ndarray | None = None) -> list[SurfaceView]:
    """At y = 5, from four places."""
    places = [np.array([x, 3.0, 1.0]) for x in (-0.1, 0.0, 0.1, 0.2)]
    return [view(np.full((60, 80), 2.0), place, known) for place in places]


def test_a_wall_becomes_a_plane_where_it_is_known_and_not_mirrored():
    left = np.broadcast_to(np.arange(80) < 40, (60, 80))
    mesh = fused(CAMERA, wall(left), VOXEL)
    assert len(mesh.faces) > 100
    np.testing.assert_allclose(mesh.vertices[:, 1], 5.0, atol=VOXEL)
    assert mesh.vertices[:, 0].max() < 0.2 + 2 * VOXEL  # what is right of the middle of each view is not known
    assert mesh.vertices[:, 0].min() == pytest.approx(-0.1 - 2.0 * 39.5 / 70.0 + 0.1, abs=0.15)
    assert mesh.vertices[:, 2].mean() == pytest.approx(1.0, abs=VOXEL)
    visual: Any = mesh.visual
    shown = visual.vertex_colors[:, 0].astype(float)
    assert np.corrcoef(shown, mesh.vertices[:, 0])[0, 1] > 0.9


def test_a_ball_becomes_a_sphere():
    """As seen from all around."""
    directions = CAMERA.pixel_directions()
    views, centre, radius = [], np.array([1.0, 2.0, -1.0]), 0.5
    for angle in np.arange(12) * np.pi / 6:
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        rotation = turn @ LOOKING_ALONG_Y
        along = (directions**2).sum(-1)
        b = 2.0 * directions[..., 2]
        under = b**2 - along * (4.0 - radius**2)
        depth = np.where(under > 0, (b - np.sqrt(under.clip(0))) / along, 0.0)
        seen = view(depth, centre - 2.0 * rotation[:, 2])
        views.append(SurfaceView(np.column_stack([rotation, seen.pose[:, 3]]), *list(vars(seen).values())[1:]))
    for shape in (fused(CAMERA, views, VOXEL), points_of(CAMERA, views, VOXEL)):
        distances = np.linalg.norm(shape.vertices - centre, axis=1)
        assert len(distances) > 300
        assert np.abs(distances - radius).max() < 2 * VOXEL and np.abs(distances - radius).mean() < 0.3 * VOXEL


def test_points_are_means_within_voxels_of_what_is_known():
    middle = np.zeros((60, 80), bool)
    middle[28:32, 38:42] = True
    cloud = points_of(CAMERA, wall(middle), 0.5)
    assert 1 <= len(cloud.vertices) < 16
    np.testing.assert_allclose(cloud.vertices[:, 1], 5.0)
    assert cloud.vertices[:, 0].min() > -0.2 and cloud.vertices[:, 0].max() < 0.3


def test_a_few_known_pixels_make_no_surface():
    """Open3D looks at every fourth pixel."""
    known = np.zeros((60, 80), bool)
    known[30, 41:43] = True
    assert not len(fused(CAMERA, wall(known), VOXEL).faces)


def test_nothing_known_is_a_sentence_and_an_empty_mesh():
    nothing = wall(np.zeros((60, 80), bool))
    assert not len(fused(CAMERA, nothing, VOXEL).faces)
    with pytest.raises(RecordingError, match="knows no depth"):
        pixel_size(CAMERA, nothing)
    assert pixel_size(CAMERA, wall()) == pytest.approx(2.0 / 70.0)


def test_colours_are_for_displays():
    (picture,) = colours_of(wall()[:1])
    assert picture.max() == 255 and picture[0, 0, 0] == pytest.approx(255 * (0.1 / 0.5) ** (1 / 2.2), abs=3)


def test_a_point_of_the_recording_is_found_again_in_metres_and_its_axes(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A field that shows a wall through a known point of the world, whatever the transform of the scene is."""
    pipeline: Any = set_up(small_config(recording, tmp_path)).pipeline
    outputs = pipeline.datamanager.train_dataparser_outputs
    transform, scale = outputs.metadata["transform"].numpy(), outputs.dataparser_scale
    assert scale != 1.0 and np.abs(transform[:, 3]).max() > 0.1
    level = 2.5  # metres along y in the world
    normal = transform[:, :3] @ [0.0, 1.0, 0.0]  # in the scene, whose point p is at scale * (R p + t)
    offset = scale * (level + transform[:, 3] @ normal)

    def shown(rays: Any) -> dict[str, torch.Tensor]:
        along = torch.from_numpy(normal).float()
        depth = (offset - rays.origins @ along) / (rays.directions @ along)
        return {"rgb": torch.full((*rays.shape, 3), 0.5), "depth": depth[..., None]}

    def sure(rays: Any, depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.ones_like(depth), depth

    monkeypatch.setattr(pipeline.model, "get_outputs_for_camera_ray_bundle", shown)
    monkeypatch.setattr(pipeline.model, "depth_evidence", sure)
    camera, views = surface_views(pipeline, 3)
    cloud = points_of(camera, views, 0.01)
    np.testing.assert_allclose(cloud.vertices[:, 1].mean(), level, atol=0.01)
    np.testing.assert_allclose(cloud.vertices[:, 1], level, atol=0.2)
