"""Pictures and depth of a scene, by casting rays: on Embree where it is installed, in Numba elsewhere."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numba import njit

from enerf_ns.simulator.scenes import Scene
from enerf_ns.simulator.textures import SIZE, TEXELS_PER_METRE

HAS_EMBREE = find_spec("embreex") is not None

SAMPLES = np.array([(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)])
"""Where in a pixel, x and y from its centre, brightness is sampled: a rotated grid, no two in one row or column."""


class Renderer:
    """Renders a scene for a pinhole camera whose integer pixel indices are pixel centres.

    Args:
        scene: what to render.
        width, height: size of the picture in pixels.
        focal_length: of the camera, in pixels; its principal point is (width / 2, height / 2), as E-NeRF's ESIM
            layout assumes.
    """

    def __init__(self, scene: Scene, width: int, height: int, focal_length: float):
        self.scene, self.width, self.height, self.focal_length = scene, width, height, focal_length
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        self.centre_rays = self.rays(x, y)
        self.sample_rays = self.rays(x[..., None] + SAMPLES[:, 0], y[..., None] + SAMPLES[:, 1])
        self.cast = (embree_caster if HAS_EMBREE else numba_caster)(scene)

    def rays(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Directions through pixel coordinates x and y of one shape, float64 [..., 3], camera axes, z = 1."""
        rays = np.stack([x - self.width / 2, y - self.height / 2, np.full(x.shape, self.focal_length)], axis=-1)
        return rays / self.focal_length

    def brightness(self, pose: np.ndarray) -> np.ndarray:
        """Mean brightness of every pixel's area, float64 [height, width] in [0, 1]; 0 where nothing is hit.

        Args:
            pose: float64 [3, 4], camera to world, OpenCV axes, metres.
        """
        scene, angle = self.scene, 1 / (2 * self.focal_length)
        hits = self.cast(*_world(self.sample_rays.reshape(-1, 3), pose))
        samples = _shade(*hits, angle, scene.triangles, scene.uv, scene.shade, scene.texture, scene.textures)
        return samples.reshape(self.sample_rays.shape[:-1]).mean(-1)

    def depth(self, pose: np.ndarray, rays: np.ndarray | None = None) -> np.ndarray:
        """z-depth in metres along rays of camera axes [..., 3], float32 [...]; 0 where nothing is hit.

        Without rays: through the centres of all pixels, [height, width].
        """
        rays = self.centre_rays if rays is None else rays
        face, _, _, depth = self.cast(*_world(rays.reshape(-1, 3), pose))
        return np.where(face < 0, 0, depth).astype(np.float32).reshape(rays.shape[:-1])


@njit(cache=True, nogil=True)
def _world(rays, pose):  # pragma: no cover
    """Origins and directions of rays in the world, float32 [N, 3] each."""
    origins, directions = np.empty(rays.shape, np.float32), np.empty(rays.shape, np.float32)
    for i in range(len(rays)):
        for axis in range(3):
            origins[i, axis] = pose[axis, 3]
            directions[i, axis] = pose[axis, 0] * rays[i, 0] + pose[axis, 1] * rays[i, 1] + pose[axis, 2] * rays[i, 2]
    return origins, directions


def embree_caster(scene: Scene):
    """A function from origins and directions, float32 [N, 3] each, to the first hits.

    These are, [N] each: the triangle (-1: none), its barycentric coordinates u and v (weights of the second and the
    third corner), and how many lengths of the direction the hit is away.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    embree = EmbreeScene()
    TriangleMesh(embree, scene.triangles)

    def cast(origins, directions):
        hits = embree.run(origins, directions, output=True)
        return hits["primID"], hits["u"], hits["v"], hits["tfar"]

    return cast


def numba_caster(scene: Scene):
    """What `embree_caster` returns, without Embree: tries the triangles of every surface whose bounding box is hit."""
    firsts = np.flatnonzero(np.diff(scene.texture, prepend=-1))
    lower = np.minimum.reduceat(scene.triangles.min(1), firsts) - 1e-4
    upper = np.maximum.reduceat(scene.triangles.max(1), firsts) + 1e-4
    bounds = np.append(firsts, len(scene.triangles))

    def cast(origins, directions):
        return _nearest(origins, directions, scene.triangles, bounds, lower, upper)

    return cast


@njit(cache=True, nogil=True)
def _nearest(origins, directions, triangles, bounds, lower, upper):  # pragma: no cover
    """Moller, Trumbore: Fast, minimum storage ray-triangle intersection, 1997, behind a slab test of each box."""
    face, depth = np.full(len(origins), -1), np.full(len(origins), np.inf)
    us, vs = np.zeros(len(origins)), np.zeros(len(origins))
    for i in range(len(origins)):
        ox, oy, oz = float(origins[i, 0]), float(origins[i, 1]), float(origins[i, 2])
        dx, dy, dz = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
        for part in range(len(lower)):
            enter, leave = 0.0, depth[i]
            for axis in range(3):
                slope = 1 / (directions[i, axis] if directions[i, axis] != 0 else 1e-30)
                a = (lower[part, axis] - origins[i, axis]) * slope
                b = (upper[part, axis] - origins[i, axis]) * slope
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            if enter > leave:
                continue
            for f in range(bounds[part], bounds[part + 1]):
                ax, ay, az = float(triangles[f, 0, 0]), float(triangles[f, 0, 1]), float(triangles[f, 0, 2])
                bx, by, bz = triangles[f, 1, 0] - ax, triangles[f, 1, 1] - ay, triangles[f, 1, 2] - az
                cx, cy, cz = triangles[f, 2, 0] - ax, triangles[f, 2, 1] - ay, triangles[f, 2, 2] - az
                px, py, pz = dy * cz - dz * cy, dz * cx - dx * cz, dx * cy - dy * cx
                volume = bx * px + by * py + bz * pz
                if volume == 0:
                    continue
                sx, sy, sz = ox - ax, oy - ay, oz - az
                u = (sx * px + sy * py + sz * pz) / volume
                if u < 0 or u > 1:
                    continue
                qx, qy, qz = sy * bz - sz * by, sz * bx - sx * bz, sx * by - sy * bx
                v = (dx * qx + dy * qy + dz * qz) / volume
                distance = (cx * qx + cy * qy + cz * qz) / volume
                if v >= 0 and u + v <= 1 and 0 < distance < depth[i]:
                    face[i], us[i], vs[i], depth[i] = f, u, v, distance
    return face, us, vs, depth


@njit(cache=True, nogil=True)
def _shade(face, u, v, depth, angle, triangles, uv, shade, texture, textures):  # pragma: no cover
    """Brightness at every hit: texture at the level of detail of the ray's footprint, times shade; 0: nothing hit."""
    out = np.zeros(len(face))
    for i in range(len(face)):
        f = face[i]
        if f < 0:
            continue
        a, b = u[i], v[i]
        c = 1 - a - b
        s = c * uv[f, 0, 0] + a * uv[f, 1, 0] + b * uv[f, 2, 0]
        t = c * uv[f, 0, 1] + a * uv[f, 1, 1] + b * uv[f, 2, 1]
        light = c * shade[f, 0] + a * shade[f, 1] + b * shade[f, 2]
        level = np.log2(min(max(depth[i] * angle * TEXELS_PER_METRE, 1.0), SIZE / 2))
        low = int(level)
        out[i] = light * (
            (low + 1 - level) * _texel(textures[texture[f]], low, s, t)
            + (level - low) * _texel(textures[texture[f]], low + 1, s, t)
        )
    return out


@njit(cache=True, nogil=True)
def _texel(pyramid, level, s, t):  # pragma: no cover
    """Bilinear look-up at (s, t) metres, repeating at the borders."""
    size = SIZE >> level
    start = 4 * (SIZE * SIZE - size * size) // 3
    x = s * TEXELS_PER_METRE * size / SIZE - 0.5
    y = t * TEXELS_PER_METRE * size / SIZE - 0.5
    left, top = int(np.floor(x)), int(np.floor(y))
    dx, dy = x - left, y - top
    column, next_column = left & (size - 1), (left + 1) & (size - 1)
    row, next_row = start + size * (top & (size - 1)), start + size * ((top + 1) & (size - 1))
    upper = (1 - dx) * pyramid[row + column] + dx * pyramid[row + next_column]
    lower = (1 - dx) * pyramid[next_row + column] + dx * pyramid[next_row + next_column]
    return (1 - dy) * upper + dy * lower
