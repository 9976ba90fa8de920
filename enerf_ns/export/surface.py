"""Surfaces of a trained run, in metres and in the axes of the recording, fused from rendered depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float32, Float64, UInt8
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.export.open3d_library import open3d
from enerf_ns.method.pipeline import EnerfPipeline
from enerf_ns.poses.posed_camera import PosedCamera
from enerf_ns.rendering.spread_depth import depth_evidence

NUM_VIEWS = 40
"""Number of views that are fused, spread evenly over the trajectory."""

SURE = 0.15
"""Confidence from which depth is fused. It is lower than for scores, because views are averaged. A lower value makes
the surface more complete and less accurate."""

SMOOTHNESS = 10.0
"""Smoothness of the depth that is fused (`spread_depth`). It is lower than for one picture: views average what differs
between them, but not what smoothness gets wrong in all of them."""

VOXEL_PIXELS = 1.5
"""Default side of a voxel, as a multiple of the size of a pixel at the median known depth."""

TRUNCATION = 4.0
"""Truncation distance of the signed distance function, in voxels."""

STRIDE = 4
"""Step between the rows and columns of pixels at which Open3D looks for blocks. It fails if none of them is known."""

BLOCK, NUM_BLOCKS = 16, 10_000
"""Voxels along each side of a block, and number of blocks with memory at first."""

FEWEST_VIEWS = 2.0
"""Number of views that must show a place for it to be surface."""

WHITE = 0.99
"""Quantile of brightness that is white in the colours."""

GAMMA = 2.2
"""Gamma of the display: colours are brightness^(1 / GAMMA)."""


@dataclass(frozen=True)
class SurfaceView:
    """The render at one pose of the trajectory."""

    pose: Float64[np.ndarray, "3 4"]
    """Camera to world, OpenCV axes, metres."""
    depth: Float32[np.ndarray, "height width"]
    """Spread depth along the optical axis, metres."""
    known: Bool[np.ndarray, "height width"]
    """Whether the confidence of the depth is at least `SURE`."""
    brightness: Float32[np.ndarray, "height width 3"]
    """Linear brightness, 0 or more."""


@torch.no_grad()
def surface_views(pipeline: EnerfPipeline, number: int = NUM_VIEWS) -> tuple[Camera, list[SurfaceView]]:
    """Renders views at poses spread evenly over the trajectory.

    Returns:
        The event camera without distortion, and its views.

    Raises:
        RecordingError: The run is a panorama, which has no depth.
    """
    pipeline.eval()
    manager, model = pipeline.datamanager, pipeline.model
    if model.config.panorama:
        raise RecordingError(
            f"The camera of {manager.recording.path} only turned, so that the run is a panorama without depth, and has "
            "no surface; record sideways motion for one."
        )
    recording, outputs = manager.recording, manager.train_dataparser_outputs
    camera, scale = recording.camera.undistorted(), outputs.dataparser_scale
    posed = PosedCamera(camera, recording.trajectory, outputs.metadata["transform"], scale, pipeline.device)
    pixels = torch.arange(camera.width * camera.height, device=pipeline.device)
    views = []
    for time in track(recording.instants(number), "Rendering depth", console=CONSOLE, transient=True):
        times = torch.full_like(pixels, int(time))
        rays = posed.rays(pixels, times).reshape((camera.height, camera.width))
        shown = model.get_outputs_for_camera_ray_bundle(rays)
        brightness = shown["rgb"].cpu()
        depth = (shown["depth"] / rays.metadata["directions_norm"]).cpu() / scale
        confidence, spread = depth_evidence(model, rays, depth, brightness, scale, SMOOTHNESS)
        pose = recording.trajectory.poses(torch.as_tensor(int(time))).numpy()
        known = (confidence >= SURE) & (spread > 0.0) & spread.isfinite()
        views.append(SurfaceView(pose, spread[..., 0].numpy(), known[..., 0].numpy(), brightness.numpy()))
    return camera, views


def colours_of(views: Sequence[SurfaceView]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The brightness of views as colours for a display; the quantile `WHITE` of it becomes white."""
    white = max(float(np.quantile(np.stack([view.brightness for view in views]), WHITE)), 1e-6)
    shown = [(view.brightness / white).clip(0.0, 1.0) ** (1.0 / GAMMA) for view in views]
    return [np.ascontiguousarray((255.0 * picture).round().astype(np.uint8)) for picture in shown]


def pixel_size(camera: Camera, views: Sequence[SurfaceView]) -> float:
    """Size of a pixel at the median known depth, metres.

    Raises:
        RecordingError: No depth is known.
    """
    known = np.concatenate([view.depth[view.known] for view in views])
    if not len(known):
        raise RecordingError("The run knows no depth anywhere, so there is no surface; train it longer.")
    return float(np.median(known)) / camera.fx


def fused(camera: Camera, views: Sequence[SurfaceView], voxel: float) -> trimesh.Trimesh:
    """The surface that views show where their depth is known. Unseen regions stay empty.

    A truncated signed distance function (B. Curless, M. Levoy, "A volumetric method for building complex models from
    range images", SIGGRAPH 1996), by Open3D.

    Args:
        camera: Camera without distortion.
        views: Its views.
        voxel: Side of a voxel, metres.

    Returns:
        Vertices in metres, with colours; empty where no depth is known.

    Raises:
        UserError: Open3D cannot be loaded.
    """
    library = open3d()
    core, image, block_grid = library.core, library.t.geometry.Image, library.t.geometry.VoxelBlockGrid
    names, types, channels = ("tsdf", "weight", "color"), (core.float32,) * 3, (1, 1, 3)
    grid = block_grid(names, types, channels, voxel, BLOCK, NUM_BLOCKS)  # of the older volumes, one stays empty
    intrinsics = core.Tensor(camera.matrix)
    used = [bool(view.known[::STRIDE, ::STRIDE].any()) for view in views]
    for view, colours, is_used in zip(views, colours_of(views), used, strict=True):
        if not is_used:
            continue
        depth = np.where(view.known, view.depth, 0.0).astype(np.float32)[..., None]
        extrinsics = core.Tensor(np.linalg.inv(np.vstack([view.pose, [0.0, 0.0, 0.0, 1.0]])))
        pictures = image(core.Tensor(depth)), image(core.Tensor(colours.astype(np.float32) / 255.0))
        given = 1.0, float(depth.max()) + 1.0, TRUNCATION
        blocks = grid.compute_unique_block_coordinates(pictures[0], intrinsics, extrinsics, *given)
        grid.integrate(blocks, *pictures, intrinsics, intrinsics, extrinsics, *given)
    if not any(used):
        return trimesh.Trimesh()
    mesh = grid.extract_triangle_mesh(FEWEST_VIEWS)
    faces = mesh.triangle.indices.numpy() if "indices" in mesh.triangle else np.zeros((0, 3), int)
    if not len(faces):
        return trimesh.Trimesh()
    colours = (255.0 * mesh.vertex.colors.numpy().clip(0.0, 1.0)).round().astype(np.uint8)
    return trimesh.Trimesh(mesh.vertex.positions.numpy(), faces, vertex_colors=colours, process=False)


def points_of(camera: Camera, views: Sequence[SurfaceView], voxel: float) -> trimesh.PointCloud:
    """The points that views show where their depth is known, averaged with their colours within each voxel.

    Args:
        camera: Camera without distortion.
        views: Its views.
        voxel: Side of a voxel, metres.
    """
    directions = camera.pixel_directions()
    points = np.concatenate(
        [(directions * v.depth[..., None])[v.known] @ v.pose[:, :3].T + v.pose[:, 3] for v in views]
    )
    colours = np.concatenate([picture[v.known] for picture, v in zip(colours_of(views), views, strict=True)])
    _, cell, count = np.unique(
        np.floor(points / voxel).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    both = np.column_stack([points, colours])
    means = np.stack([np.bincount(cell.ravel(), column) / count for column in both.T], axis=1)
    return trimesh.PointCloud(means[:, :3], colors=means[:, 3:].round().astype(np.uint8))
