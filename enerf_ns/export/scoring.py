"""Distances in metres between a surface and the part of a reference that cameras saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import read_json
from enerf_ns.export.open3d_library import open3d
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import Scene
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.view import scene_of

NEAR = 0.05
"""Distance in metres up to which a surface counts as correct."""

SAMPLES = 100_000
"""Most points whose distances are measured in each direction."""


@dataclass(frozen=True)
class SurfaceScores:
    """Distances between a surface and the reference, metres."""

    accuracy: float
    """Mean distance from the surface to the reference."""
    completeness: float
    """Mean distance from the seen part of the reference to the surface."""
    chamfer: float
    """Mean of accuracy and completeness."""
    accurate_share: float
    """Share of the surface within `NEAR` of the reference."""
    complete_share: float
    """Share of the seen part of the reference within `NEAR` of the surface."""

    def __str__(self) -> str:
        """The scores in one sentence."""
        return (
            f"accuracy {self.accuracy:.4f} m, completeness {self.completeness:.4f} m, Chamfer {self.chamfer:.4f} m; "
            f"within {NEAR:g} m: {self.accurate_share:.1%} of the surface, {self.complete_share:.1%} of the seen "
            "part of the reference"
        )


def simulated_scene(recording: Path, notes: list[str]) -> Scene | None:
    """The scene of a simulated recording; None if the recording was not simulated from a scene.

    Args:
        recording: Its folder.
        notes: Gets a sentence if the file of the scene is not there any more, or cannot be used. Nothing is returned.
    """
    file = recording / "simulation.json"
    about = read_json(file) if file.is_file() else {}
    if not about.get("scene"):
        return None
    settings = SimulationSettings(about["scene"], sensor=SensorSettings(seed=about.get("sensor", {}).get("seed", 0)))
    try:
        return None if settings.pictures else scene_of(settings, [])
    except RecordingError as error:
        notes.append(f"Nothing is compared, since {str(error).rstrip('.')}; give the scene by --reference.")
        return None


def surface_scores(
    surface: trimesh.Trimesh | trimesh.PointCloud,
    scene: Scene,
    camera: Camera,
    poses: Sequence[Float64[np.ndarray, "3 4"]],
) -> SurfaceScores:
    """Compares a surface with a scene.

    Args:
        surface: Mesh or points in metres, in the axes of the scene; not empty.
        scene: The reference.
        camera: Camera without distortion that saw the scene.
        poses: Its poses, camera to world in OpenCV axes, metres.
    """
    generator = np.random.default_rng(0)
    reference = trimesh.Trimesh(scene.triangles.reshape(-1, 3), np.arange(3 * len(scene.triangles)).reshape(-1, 3))
    if isinstance(surface, trimesh.Trimesh):
        points = np.asarray(trimesh.sample.sample_surface(surface, SAMPLES, seed=0)[0])
    else:
        points = generator.permutation(np.asarray(surface.vertices))[:SAMPLES]
    seen = generator.permutation(seen_points(scene, camera, poses))[:SAMPLES]
    to_reference, to_surface = distances(points, reference), distances(seen, surface)
    accuracy, completeness = float(to_reference.mean()), float(to_surface.mean())
    return SurfaceScores(
        accuracy,
        completeness,
        (accuracy + completeness) / 2.0,
        float((to_reference <= NEAR).mean()),
        float((to_surface <= NEAR).mean()),
    )


def seen_points(
    scene: Scene, camera: Camera, poses: Sequence[Float64[np.ndarray, "3 4"]]
) -> Float64[np.ndarray, "points 3"]:
    """Points of a scene that pixels of the camera show, in metres; one point for each cubic centimetre."""
    renderer, directions = Renderer(scene, camera), camera.pixel_directions()
    points = []
    for pose in poses:
        depth = renderer.depth(pose)
        hit = depth > 0
        points.append((directions * depth[..., None])[hit] @ pose[:, :3].T + pose[:, 3])
    every = np.concatenate(points)
    return every[np.unique(np.floor(100.0 * every).astype(np.int64), axis=0, return_index=True)[1]]


def distances(
    points: Float[np.ndarray, "points 3"], surface: trimesh.Trimesh | trimesh.PointCloud
) -> Float[np.ndarray, " points"]:
    """Distance of each point to a mesh, or to the nearest point of a cloud."""
    if isinstance(surface, trimesh.PointCloud):
        return KDTree(surface.vertices).query(points)[0]
    library = open3d()
    tensor = library.core.Tensor
    scene = library.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        tensor(np.asarray(surface.vertices, np.float32)),
        tensor(np.asarray(surface.faces, np.uint32)),
    )
    return scene.compute_distance(tensor(points.astype(np.float32))).numpy()
