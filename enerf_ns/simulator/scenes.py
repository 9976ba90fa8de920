"""The scenes that `enerf simulate` knows: textured triangles, and where the camera stands on average.

World axes: x right, y away from the camera, z up, in metres. Every camera ray of a scene's motions hits a surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.transformations import rotation_matrix

from enerf_ns.simulator import textures

LIGHT = np.array([-0.4, -0.7, 0.6]) / np.linalg.norm([-0.4, -0.7, 0.6])
"""Direction towards the light, far away."""


@dataclass(frozen=True)
class Scene:
    """Diffuse grey triangles whose brightness does not depend on the direction they are seen from."""

    triangles: np.ndarray
    """float32 [F, 3, 3], corners in metres."""
    uv: np.ndarray
    """float32 [F, 3, 2], texture coordinates of the corners in metres."""
    shade: np.ndarray
    """float32 [F, 3], light that falls on the corners, in (0, 1]; brightness is shade times texture."""
    texture: np.ndarray
    """int64 [F], which row of `textures`."""
    textures: np.ndarray
    """float32 [T, P], mip pyramids (see `textures.mip_pyramid`)."""
    camera: np.ndarray
    """float64 [3], where the camera stands on average, in metres."""
    target: np.ndarray
    """float64 [3], what it looks at."""


def shapes(rng: np.random.Generator) -> Scene:
    """A room with boxes and balls between 1.2 and 2.8 metres away; some of its surfaces have no texture."""
    clouds, fine, mosaic = textures.clouds(rng), textures.clouds(rng, 0.4, 0.05), textures.mosaic(rng)
    bricks, lines, text, plain = textures.bricks(rng), textures.lines(rng), textures.text(rng), textures.plain()
    left, right, front, back, floor, ceiling = -2.3, 2.3, -1.5, 3.3, -0.85, 1.5
    room = trimesh.creation.box(bounds=[[left, front, floor], [right, back, ceiling]])
    room.invert()
    room.unmerge_vertices()

    def wall(*normal: int) -> trimesh.Trimesh:
        return trimesh.Trimesh(room.vertices, room.faces[room.face_normals @ normal > 0.5], process=False)

    return _scene(
        [
            (wall(0, -1, 0), bricks, (0.3, 0.6)),
            (wall(0, 0, 1), clouds, (0.35, 0.65)),
            (wall(1, 0, 0), plain, (0, 0.5)),
            (wall(-1, 0, 0), mosaic, (0.3, 0.6)),
            (wall(0, 0, -1), plain, (0, 0.8)),
            (wall(0, 1, 0), plain, (0, 0.5)),
            (_box((0.9, 0.04, 0.6), (-0.1, back, 0.75)), plain, (0, 0.8)),
            (_box((0.5, 0.5, 0.7), (-0.55, 1.75, floor + 0.35), 25), mosaic, (0.15, 0.95)),
            (_box((0.45, 0.45, 0.45), (0.55, 1.45, floor + 0.225), -20), text, (0.15, 0.9)),
            (_box((0.6, 0.4, 1.1), (1.15, 2.4, floor + 0.55), 15), lines, (0.15, 0.9)),
            (_box((0.3, 0.3, 0.3), (0.0, 2.25, 0.1), 40, 20), plain, (0, 0.8)),
            (_box((0.4, 0.1, 0.5), (-1.35, 2.7, 0.45), 10), text, (0.15, 0.9)),
            (_box((0.5, 0.3, 0.25), (0.75, 2.6, 0.75), -30, 10), fine, (0.2, 0.9)),
            (_ball(0.25, (-0.05, 1.35, floor + 0.25)), lines, (0.2, 0.95)),
            (_ball(0.22, (0.5, 1.9, 0.3)), plain, (0, 0.35)),
            (_ball(0.3, (-0.75, 2.2, 0.35)), clouds, (0.2, 0.8)),
        ],
        camera=(0, 0, 0),
        target=(0, 2, -0.1),
    )


def carpet(rng: np.random.Generator) -> Scene:
    """A plane of road-like lines, seen at a slant of 60 degrees from 1.5 metres away."""
    plane = _box((16, 16, 0.1), (0, 0, -0.05))
    return _scene([(plane, textures.lines(rng), (0.15, 0.9))], camera=(0, -0.75, 1.3), target=(0, 0, 0))


SCENES = {"shapes": shapes, "carpet": carpet}


def _scene(
    surfaces: list[tuple[trimesh.Trimesh, np.ndarray, tuple[float, float]]], camera: tuple, target: tuple
) -> Scene:
    """Meshes, each with its texture and the brightness of the texture's zeros and ones."""
    meshes = [mesh for mesh, _, _ in surfaces]
    return Scene(
        np.concatenate([mesh.triangles for mesh in meshes]).astype(np.float32),
        np.concatenate([_texture_coordinates(mesh) for mesh in meshes]).astype(np.float32),
        np.concatenate([0.7 + 0.3 * np.maximum(mesh.vertex_normals[mesh.faces] @ LIGHT, 0) for mesh in meshes]).astype(
            np.float32
        ),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
        np.stack([textures.mip_pyramid(dark + (bright - dark) * levels) for _, levels, (dark, bright) in surfaces]),
        np.array(camera, float),
        np.array(target, float),
    )


def _texture_coordinates(mesh: trimesh.Trimesh) -> np.ndarray:
    """Along the two world axes that a face lies closest to, so that it is upright and not mirrored from outside."""
    across = np.abs(mesh.face_normals).argmax(1)
    faces = np.arange(len(across))
    outwards = np.sign(mesh.face_normals[faces, across]) * np.array([1, -1, 1])[across]
    to_right, up = np.array([1, 0, 0])[across], np.array([2, 2, 1])[across]
    return np.stack([outwards[:, None] * mesh.triangles[faces, :, to_right], -mesh.triangles[faces, :, up]], axis=-1)


def _box(size: tuple, centre: tuple, turn: float = 0, tilt: float = 0) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_transform(rotation_matrix(np.radians(turn), [0, 0, 1]) @ rotation_matrix(np.radians(tilt), [1, 0, 0]))
    mesh.apply_translation(centre)
    mesh.unmerge_vertices()
    return mesh


def _ball(radius: float, centre: tuple) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.apply_translation(centre)
    return mesh
