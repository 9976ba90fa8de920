"""Pictures and depth of a scene, by casting rays: on Embree where it is installed, in Numba elsewhere."""

from __future__ import annotations

import numpy as np
from numba import njit

from enerf_ns.simulator.scenes import Scene
from enerf_ns.simulator.textures import SIZE, TEXELS_PER_METRE

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError:
    EmbreeScene = None


class Renderer:
    """Renders a scene for a pinhole camera whose integer pixel indices are pixel centres.

    Args:
        scene: what to render.
        width, height: size of the picture in pixels.
        focal_length: of the camera, in pixels; its principal point is (width / 2, height / 2), as E-NeRF's ESIM
            layout assumes.
    """

    samples = 2
    """Rays along each side of a pixel."""

    def __init__(self, scene: Scene, width: int, height: int, focal_length: float):
        self.scene, self.width, self.height, self.focal_length = scene, width, height, focal_length
        subpixel = (np.arange(self.samples) + 0.5) / self.samples - 0.5
        self.rays = self.directions(
            (np.arange(width)[:, None] + subpixel).ravel(), (np.arange(height)[:, None] + subpixel).ravel()
        )
        self.cast = (embree_caster if EmbreeScene else numba_caster)(scene)

    def directions(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Rays of a grid of pixel coordinates, float64 [len(y) * len(x), 3], camera axes, z = 1."""
        x, y = np.meshgrid(x, y)
        rays = np.stack([x - self.width / 2, y - self.height / 2, np.full(x.shape, self.focal_length)], axis=-1)
        return rays.reshape(-1, 3) / self.focal_length

    def grid(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows of every `step`-th pixel."""
        return np.arange(0, self.width, step), np.arange(0, self.height, step)

    def brightness(self, pose: np.ndarray) -> np.ndarray:
        """Mean brightness of every pixel's area, float64 [height, width] in [0, 1].

        Args:
            pose: float64 [3, 4], camera to world, OpenCV axes, metres.
        """
        scene = self.scene
        face, u, v, depth = self.cast(*_world(self.rays, pose))
        samples = _shade(
            face, u, v, depth, 1 / (self.focal_length * self.samples),
            scene.triangles, scene.uv, scene.shade, scene.texture, scene.textures,
        )  # fmt: skip
        return samples.reshape(self.height, self.samples, self.width, self.samples).mean((1, 3))

    def depth(self, pose: np.ndarray, step: int = 1) -> np.ndarray:
        """z-depth in metres through the centre of every `step`-th pixel, float32 [height, width]; 0: nothing hit."""
        x, y = self.grid(step)
        face, _, _, depth = self.cast(*_world(self.directions(x, y), pose))
        return np.where(face < 0, 0, depth).reshape(len(y), len(x))


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
        level = np.log2(max(depth[i] * angle * TEXELS_PER_METRE, 1.0))
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
