"""Pictures and depth of a scene, seen by a camera of any model.

The picture is divided into quarters recursively, down to blocks of 256 samples. For each part a list of the triangles
that may be visible in it is kept. In a block every triangle of its list is tested. A sample sees a triangle if its
direction lies on the inner side of the three planes through the camera and an edge (Olano, Greer: Triangle scan
conversion using 2D homogeneous coordinates, 1997). This needs no projection and no clipping, so that a camera is a
table of directions.

Open3D's `RaycastingScene` was tried in place of this. On one thread, 160 x 120 pixels of 16 samples take it 56 ms for
the hits alone in the scene shapes (3,936 triangles) and 70 ms in the scene moon (80,000 triangles); this module takes 5
ms and 15 ms with shading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.simulator.scene.scenes import Scene

GROUP = 4
"""Samples that share one look-up of brightness, in their middle, if they all see the same triangle."""

_HAMMERSLEY = np.stack([np.arange(16), [int(f"{i:04b}"[::-1], 2) for i in range(16)]], axis=1) / 16 - 15 / 32

SAMPLES = _HAMMERSLEY[np.lexsort((_HAMMERSLEY > 0).T)]
"""Offsets (x, y) of the samples from the centre of a pixel, in pixels: a Hammersley set, ordered by quarters."""

CENTRE = np.zeros((1, 2))

BLOCK = 256
"""Samples in which a triangle is tested at once; the loop over them compiles to vector instructions."""

SLACK = 1e-4
"""Fraction of its size by which a part of the picture is enlarged, against rounding."""

EDGE_ON = 1e-7
"""Sine of the angle between a triangle and the ray to its corner below which the triangle is invisible."""

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


class Renderer:
    """Renders a scene for a camera. A picture uses one thread; several threads may render at once.

    Args:
        scene: The scene.
        camera: A camera of any model.
        places: Offsets of the samples from the centre of a pixel, in pixels; 1, 4, 16 or 64 of them.

    Raises:
        ValueError: The distortion of the camera has no inverse at some pixel.
    """

    def __init__(self, scene: Scene, camera: Camera, places: Float64[np.ndarray, "places 2"] = SAMPLES):
        self.scene, self.camera = scene, camera
        self._samples, self._centres = _Samples.of(camera, places), _Samples.of(camera, CENTRE)

    def brightness(
        self, pose: Float64[np.ndarray, "3 4"], pixels: Int64[np.ndarray, " pixels"] | None = None
    ) -> Float32[np.ndarray, "*pixels"]:
        """Mean linear brightness over the area of every pixel: [height, width], or [height, width, 3] for colour.

        Args:
            pose: Camera to world, OpenCV axes, metres.
            pixels: Numbers of the wanted pixels, y * width + x; the result is then [pixels], or [pixels, 3] for colour,
                and equal to the whole picture at these pixels. Default: all pixels.
        """
        scene, samples = self.scene, self._samples
        order = samples.order if pixels is None else samples.order.reshape(-1)[pixels]
        nodes, bounds = samples.tree if pixels is None else samples.tree_above(order)
        wanted = np.full(samples.sizes.shape, pixels is None)
        wanted.reshape(-1)[order] = True
        seen, faces = _see(scene.triangles, np.ascontiguousarray(pose, np.float64), samples.tree[1][0])
        shaded = _shade(
            seen, faces, samples.x, samples.y, nodes, bounds, samples.sizes, wanted,
            scene.uv, scene.shade, scene.texels_per_metre, scene.texture,
            scene.texels, scene.texture_start, scene.texture_size, float(scene.background),
        )  # fmt: skip
        brightness = shaded.reshape(-1, scene.channels)[order]
        return brightness if scene.channels > 1 else brightness[..., 0]

    def depth(self, pose: Float64[np.ndarray, "3 4"]) -> Float32[np.ndarray, "height width"]:
        """z-depth at the centres of the pixels in metres, 0 where nothing is hit.

        Args:
            pose: Camera to world, OpenCV axes, metres.
        """
        centres = self._centres
        seen, _ = _see(self.scene.triangles, np.ascontiguousarray(pose, np.float64), centres.tree[1][0])
        return _measure(seen, centres.x, centres.y, *centres.tree).reshape(-1)[centres.order]


@dataclass(frozen=True)
class _Samples:
    """Directions (x, y, 1) of the samples of a camera, in camera axes, by square blocks of pixels; and their tree."""

    x: Float32[np.ndarray, "blocks 256"]
    """x of each direction: in a block ordered by pixel, row by row, and in a pixel by sample."""
    y: Float32[np.ndarray, "blocks 256"]
    sizes: Float32[np.ndarray, "blocks pixels"]
    """Side of a square with the area that a group of samples represents, in the unit of x and y."""
    order: Int64[np.ndarray, "height width"]
    """Index of each pixel of the picture among the pixels of all blocks."""
    tree: tuple[Int32[np.ndarray, "nodes 3"], Float32[np.ndarray, "nodes 4"]]
    """Nodes of the tree, depth first, and their bounds. A node has its level (0 is one block), the number of the node
    after its last descendant, and its first block. Bounds are least and largest x, least and largest y."""

    @classmethod
    def of(cls, camera: Camera, offsets: Float64[np.ndarray, "samples 2"]) -> _Samples:
        """Samples at these offsets from the centre of every pixel, in pixels; 1, 4, 16 or 64 of them."""
        directions, (right, down) = camera.pixel_directions(), camera.pixel_steps()
        sizes = np.sqrt(np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]) * GROUP / len(offsets))
        side = round((BLOCK / len(offsets)) ** 0.5)
        rows, columns = -(-camera.height // side), -(-camera.width // side)
        row, column = np.divmod(np.arange(rows * columns), columns)
        levels = (max(rows, columns) - 1).bit_length() + 1
        code = np.zeros_like(row)  # Morton: the blocks of every part of the picture follow each other
        for bit in range(levels):
            code |= (row >> bit & 1) << (2 * bit + 1) | (column >> bit & 1) << (2 * bit)
        along = np.argsort(code)
        code = code[along]

        def blocks(pixels: np.ndarray) -> np.ndarray:
            """Converts [height, width, N] to [blocks, pixels * N]; blocks beyond the edge repeat the edge."""
            beyond = [(0, rows * side - camera.height), (0, columns * side - camera.width), (0, 0)]
            padded = np.pad(pixels, beyond, mode="edge").reshape(rows, side, columns, side, -1)
            return padded.swapaxes(1, 2).reshape(rows * columns, -1)[along]

        def samples(axis: int) -> np.ndarray:
            steps = right[..., axis, None] * offsets[:, 0] + down[..., axis, None] * offsets[:, 1]
            return blocks((directions[..., axis, None] + steps).astype(np.float32))

        x, y = samples(0), samples(1)
        boxes = np.stack([x.min(1), -x.max(1), y.min(1), -y.max(1)], axis=1)
        nodes, bounds = [], []
        for level in range(levels):
            first = np.flatnonzero(np.diff(code >> 2 * level, prepend=-1))
            nodes.append(np.stack([np.full(len(first), level), np.append(first[1:], len(code)), first], axis=1))
            box = np.minimum.reduceat(boxes, first)
            bounds.append(box + SLACK * (box + box[:, [1, 0, 3, 2]]))
        nodes, bounds = np.concatenate(nodes), np.concatenate(bounds) * np.array([1, -1, 1, -1], np.float32)
        depth_first = np.lexsort((-nodes[:, 0], nodes[:, 2]))
        nodes = nodes[depth_first]
        nodes[:, 1] = np.searchsorted(nodes[:, 2], nodes[:, 1])

        numbers = blocks(np.arange(camera.height * camera.width).reshape(camera.height, camera.width, 1)).reshape(-1)
        _, order = np.unique(numbers, return_index=True)
        order = order.reshape(camera.height, camera.width)
        sizes = blocks(sizes[..., None]).astype(np.float32)
        return cls(x, y, sizes, order, (nodes.astype(np.int32), bounds[depth_first].astype(np.float32)))

    def tree_above(
        self, places: Int64[np.ndarray, " pixels"]
    ) -> tuple[Int32[np.ndarray, "nodes 3"], Float32[np.ndarray, "nodes 4"]]:
        """The part of the tree above the blocks of some pixels, given by their indices as in `order`."""
        nodes, bounds = self.tree
        wanted = np.zeros(len(self.x) + 1, np.int64)
        wanted[1 + places // self.sizes.shape[1]] = 1
        before = np.cumsum(wanted)
        first = np.append(nodes[:, 2], len(self.x))
        kept = before[first[nodes[:, 1]]] > before[first[:-1]]
        followers = np.append(0, np.cumsum(kept)).astype(np.int32)
        nodes = nodes[kept]
        nodes[:, 1] = followers[nodes[:, 1]]
        return nodes, bounds[kept]


@compiled
def _see(triangles, pose, view):  # pragma: no cover
    """Edge vectors and boxes of the triangles that may be in view, float32 [N, 16], and their numbers, int32 [N].

    The first 12 numbers are four vectors. The inner products of a direction (x, y, 1), in camera axes, with the first
    three vectors are all at least 0 if the direction hits the triangle; they are then proportional to the weights of
    the corners. Otherwise one of them is negative. The inner product with the fourth vector is one over the depth. Two
    triangles with a common edge have the same vector for it, with opposite sign, so that no direction passes between
    them; at a common corner a direction may, within rounding. The last 4 numbers are a box around the triangle: least
    and largest x, least and largest y, as in `view`.
    """
    seen, faces = np.empty((len(triangles), 16), np.float32), np.empty(len(triangles), np.int32)
    corners, normals, normal = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    count = 0
    for f in range(len(triangles)):
        nearest, farthest = np.inf, 0.0
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for k in range(3):
            x, y, z = triangles[f, k, 0] - pose[0, 3], triangles[f, k, 1] - pose[1, 3], triangles[f, k, 2] - pose[2, 3]
            for axis in range(3):
                corners[k, axis] = pose[0, axis] * x + pose[1, axis] * y + pose[2, axis] * z
            x, y, z = corners[k]
            nearest, farthest = min(nearest, z), max(farthest, z)
            if z > 0:
                left, right, top, bottom = min(left, x / z), max(right, x / z), min(top, y / z), max(bottom, y / z)
        if nearest <= 0 < farthest:
            left, right, top, bottom = -np.inf, np.inf, -np.inf, np.inf
        if not (left <= view[1] and right >= view[0] and top <= view[3] and bottom >= view[2]):
            continue
        for k in range(3):
            a, b = corners[(k + 1) % 3], corners[(k + 2) % 3]
            for axis in range(3):
                i, j = (axis + 1) % 3, (axis + 2) % 3
                normals[k, axis] = a[i] * b[j] - a[j] * b[i]
        volume = corners[0, 0] * normals[0, 0] + corners[0, 1] * normals[0, 1] + corners[0, 2] * normals[0, 2]
        for axis in range(3):
            normal[axis] = normals[0, axis] + normals[1, axis] + normals[2, axis]
        size = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if abs(volume) <= EDGE_ON * size * np.sqrt(corners[0, 0] ** 2 + corners[0, 1] ** 2 + corners[0, 2] ** 2):
            continue
        for axis in range(3):
            for k in range(3):
                seen[count, 3 * k + axis] = normals[k, axis] if volume > 0 else -normals[k, axis]
            seen[count, 9 + axis] = normal[axis] / volume
        seen[count, 12], seen[count, 13], seen[count, 14], seen[count, 15] = left, right, top, bottom
        faces[count] = f
        count += 1
    return seen[:count], faces[:count]


@compiled
def _measure(seen, x, y, nodes, bounds):  # pragma: no cover
    """Depth of every sample [blocks, 256], 0 where it sees no triangle."""
    depth, closeness, faces = np.zeros(x.shape, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    lists, lengths = _all(seen, nodes)
    node, block = _next(seen, x, y, nodes, bounds, 0, lists, lengths, faces, closeness)
    while block >= 0:
        for k in range(BLOCK):
            if faces[k] >= 0:
                depth[block, k] = ONE / closeness[k]
        node, block = _next(seen, x, y, nodes, bounds, node, lists, lengths, faces, closeness)
    return depth


@compiled
def _all(seen, nodes):  # pragma: no cover
    """Lists of candidate triangles for each level of `_next`; that of the whole picture holds all triangles."""
    levels = nodes[0, 0] + 1 if len(nodes) > 0 else 1
    lists, lengths = np.empty((levels + 1, len(seen)), np.int32), np.zeros(levels + 1, np.int64)
    lists[levels], lengths[levels] = np.arange(len(seen)), len(seen)
    return lists, lengths


@compiled
def _next(seen, x, y, nodes, bounds, node, lists, lengths, faces, closeness):  # pragma: no cover
    """The node to continue with, and the next block, from a node on, that may see triangles; -1 if there is none.

    Writes the triangle that each sample of the block sees (-1 for none) and one over its depth (0 for none), [256]
    each.
    """
    while node < len(nodes):
        level, after, block = nodes[node]
        lengths[level] = _select(seen, lists[level + 1, : lengths[level + 1]], bounds[node], lists[level])
        node = node + 1 if lengths[level] > 0 else after
        if level == 0 and lengths[0] > 0:
            faces[:], closeness[:] = -1, 0
            _try(seen, lists[0, : lengths[0]], x[block], y[block], faces, closeness)
            return node, block
    return node, np.int32(-1)


@compiled
def _select(seen, candidates, bounds, selected):  # pragma: no cover
    """Selects triangles whose box meets the bounds and whose edges each have a corner of the bounds on the inner side.

    Returns their number.
    """
    left, right, top, bottom = bounds[0], bounds[1], bounds[2], bounds[3]
    count = 0
    for f in candidates:
        s = seen[f]
        inside = (s[12] <= right) & (s[13] >= left) & (s[14] <= bottom) & (s[15] >= top)
        for k in range(0, 9, 3):
            inside &= max(s[k] * left, s[k] * right) + max(s[k + 1] * top, s[k + 1] * bottom) + s[k + 2] >= 0
        selected[count] = f
        count += inside
    return count


@compiled
def _try(seen, candidates, x, y, faces, closeness):  # pragma: no cover
    """Finds the nearest of some triangles that each sample of a block sees, and one over its depth."""
    for f in candidates:
        p = seen[f]
        a0, a1, a2, b0, b1, b2 = p[0], p[1], p[2], p[3], p[4], p[5]
        c0, c1, c2, d0, d1, d2 = p[6], p[7], p[8], p[9], p[10], p[11]
        for k in range(BLOCK):
            near = d0 * x[k] + d1 * y[k] + d2
            hit = (
                (a0 * x[k] + a1 * y[k] + a2 >= 0)
                & (b0 * x[k] + b1 * y[k] + b2 >= 0)
                & (c0 * x[k] + c1 * y[k] + c2 >= 0)
                & (near > closeness[k])
            )
            closeness[k] = near if hit else closeness[k]
            faces[k] = f if hit else faces[k]


@compiled
def _shade(
    seen, faces, x, y, nodes, bounds, sizes, wanted,
    uv, shade, texels_per_metre, texture, texels, texture_start, texture_size, background,
):  # fmt: skip  # pragma: no cover
    """Mean over the samples of a wanted pixel of shade times texture, [blocks, pixels, C].

    Each step is done for all places of a block before the next step, so that it compiles to vector instructions.
    """
    channels, pixels = texels.shape[1], sizes.shape[1]
    picture = np.full((len(x), pixels, channels), np.float32(background))
    hit, closeness = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.float32)
    px, py, face = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    pixel, share = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.float32)
    s, t, light = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty((channels, BLOCK), np.float32)
    start, side, blend = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.float32)
    value, coarser = np.empty((channels, BLOCK), np.float32), np.empty(BLOCK, np.float32)
    lists, lengths = _all(seen, nodes)
    node, block = _next(seen, x, y, nodes, bounds, 0, lists, lengths, hit, closeness)
    while block >= 0:
        count = _places(x[block], y[block], hit, wanted[block], px, py, face, pixel, share)
        blends = False
        end = 0
        while end < count:
            begin, h = end, face[end]
            while end < count and face[end] == h:
                end += 1
            f = faces[h]
            first, finest, last = texture_start[texture[f]], texture_size[texture[f]], -1
            at, size, part = first, finest, ZERO
            for k in range(begin, end):
                a = seen[h, 0] * px[k] + seen[h, 1] * py[k] + seen[h, 2]
                b = seen[h, 3] * px[k] + seen[h, 4] * py[k] + seen[h, 5]
                c = seen[h, 6] * px[k] + seen[h, 7] * py[k] + seen[h, 8]
                scale = ONE / (a + b + c)
                a, b, c = a * scale, b * scale, c * scale
                s[k] = a * uv[f, 0, 0] + b * uv[f, 1, 0] + c * uv[f, 2, 0]
                t[k] = a * uv[f, 0, 1] + b * uv[f, 1, 1] + c * uv[f, 2, 1]
                for channel in range(channels):
                    light[channel, k] = a * shade[f, 0, channel] + b * shade[f, 1, channel] + c * shade[f, 2, channel]
                if pixel[k] != last:
                    last = pixel[k]
                    near = seen[h, 9] * px[k] + seen[h, 10] * py[k] + seen[h, 11]
                    footprint = min(sizes[block, last] * texels_per_metre[f] / near, np.float32(finest))
                    level = np.log2(footprint) if footprint > ONE else ZERO
                    size = finest >> np.intp(level)
                    at, part = first + 4 * (finest * finest - size * size) // 3, level - np.float32(np.intp(level))
                    blends |= part > 0
                start[k], side[k], blend[k] = at, size, part
        for channel in range(channels):
            _look_up(texels, channel, start, side, s, t, count, value[channel])
        if blends:
            for k in range(count):
                if blend[k] > 0:
                    start[k] += side[k] * side[k]
                    side[k] >>= 1
            for channel in range(channels):
                _look_up(texels, channel, start, side, s, t, count, coarser)
                for k in range(count):
                    value[channel, k] += blend[k] * (coarser[k] - value[channel, k])
        for channel in range(channels):
            for k in range(count):
                change = share[k] * (light[channel, k] * value[channel, k] - np.float32(background))
                picture[block, pixel[k], channel] += change
        node, block = _next(seen, x, y, nodes, bounds, node, lists, lengths, hit, closeness)
    return picture


@compiled
def _places(x, y, hit, wanted, px, py, face, pixel, share):  # pragma: no cover
    """Finds the places where a block looks up brightness, with triangle, pixel and weight; returns their number.

    A group of samples that all see the same triangle has one place; otherwise each of its samples has one.
    """
    samples = BLOCK // len(wanted)
    count = 0
    for first in range(0, BLOCK, GROUP):
        if not wanted[first // samples]:
            continue
        f = hit[first]
        if hit[first + 1] == f and hit[first + 2] == f and hit[first + 3] == f:
            if f >= 0:
                px[count] = (x[first] + x[first + 1] + x[first + 2] + x[first + 3]) / np.float32(GROUP)
                py[count] = (y[first] + y[first + 1] + y[first + 2] + y[first + 3]) / np.float32(GROUP)
                face[count], pixel[count], share[count] = f, first // samples, np.float32(GROUP) / np.float32(samples)
                count += 1
            continue
        for k in range(first, first + GROUP):
            if hit[k] >= 0:
                px[count], py[count], face[count], pixel[count] = x[k], y[k], hit[k], first // samples
                share[count] = ONE / np.float32(samples)
                count += 1
    return count


@compiled
def _look_up(texels, channel, start, side, s, t, count, value):  # pragma: no cover
    """Interpolates bilinearly in a periodic level of side x side texels that begins at row `start`."""
    for k in range(count):
        mask, scale = np.int32(side[k] - 1), np.float32(side[k])
        across, along = s[k] * scale - HALF, t[k] * scale - HALF
        left, top = np.floor(across), np.floor(along)
        dx, dy = across - left, along - top
        column, row = np.int32(left) & mask, np.int32(top) & mask
        right, below = (column + np.int32(1)) & mask, (row + np.int32(1)) & mask
        upper, lower = start[k] + side[k] * row, start[k] + side[k] * below
        one, other = texels[np.uintp(upper + column), channel], texels[np.uintp(upper + right), channel]
        above = one + dx * (other - one)
        one, other = texels[np.uintp(lower + column), channel], texels[np.uintp(lower + right), channel]
        value[k] = above + dy * (one + dx * (other - one) - above)
