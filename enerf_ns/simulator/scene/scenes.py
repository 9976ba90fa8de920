"""Scenes of textured triangles, and the built-in scenes of `enerf simulate`.

World axes: x right, y away from the camera, z up, in metres. In the built-in scenes every camera ray hits a surface
under every motion. A function that is added to `SCENES` becomes a scene of `engine.simulate`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Float64, Int64
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates
from trimesh.transformations import rotation_matrix, transform_points

from enerf_ns.dataparsers.recording.picture_depth import LUMA
from enerf_ns.simulator.scene import textures

LIGHT = np.array([-0.4, -0.7, 0.6]) / np.linalg.norm([-0.4, -0.7, 0.6])
"""Unit vector towards the light, which is far away."""


@dataclass(frozen=True)
class Scene:
    """Diffuse triangles: their brightness does not depend on the viewing direction."""

    triangles: Float32[np.ndarray, "faces 3 3"]
    """Corners of the triangles in metres."""
    uv: Float32[np.ndarray, "faces 3 2"]
    """Texture coordinates of the corners, to the right and downwards. The texture repeats after 1."""
    shade: Float32[np.ndarray, "faces 3 channels"]
    """Light and colour at the corners, at least 0. Brightness is shade times texture. One channel is grey, three
    channels are linear red, green and blue."""
    texture: Int64[np.ndarray, " faces"]
    """Number of each face's texture."""
    texels: Float32[np.ndarray, "texels channels"]
    """Linear brightness of the texels: the mip pyramids (see `textures.mip_pyramid`) of all textures in sequence."""
    texture_start: Int64[np.ndarray, " textures"]
    """First row of each texture in `texels`."""
    texture_size: Int64[np.ndarray, " textures"]
    """Texels along one side of the finest level of each texture, a power of two; 1 for a surface of one colour."""
    texels_per_metre: Float32[np.ndarray, " faces"]
    """Texels per metre of the finest level on each face; 0 if the whole face has one texture coordinate."""
    camera: Float64[np.ndarray, "3"]
    """Mean position of the camera, metres."""
    target: Float64[np.ndarray, "3"]
    """Point that the camera looks at, metres."""
    background: float = 0.0
    """Brightness of rays that hit no surface."""

    @property
    def channels(self) -> int:
        """Number of colour channels: 1 for grey, 3 for linear red, green and blue."""
        return self.texels.shape[1]

    def grey(self) -> Scene:
        """The scene with the luma (see `response.luma`) in place of each colour.

        The luma of a texture's colour times a corner's colour is approximated by the product of their lumas.
        """
        if self.channels == 1:
            return self
        weights = np.array(LUMA, np.float32)[:, None]
        return replace(self, shade=self.shade @ weights, texels=self.texels @ weights)


@dataclass(frozen=True)
class Surface:
    """Triangles with one texture. Its `shade` and `image` may differ in their number of channels, one or three."""

    triangles: Float[np.ndarray, "faces 3 3"]
    """Corners of the triangles in metres."""
    uv: Float[np.ndarray, "faces 3 2"]
    """Texture coordinates of the corners, as in `Scene`."""
    shade: Float[np.ndarray, "faces 3 channels"]
    """Light and colour at the corners, as in `Scene`."""
    image: Float[np.ndarray, "size size channels"]
    """Linear brightness of the texture; `size` is a power of two."""


def build_scene(surfaces: list[Surface], camera: ArrayLike, target: ArrayLike, background: float = 0.0) -> Scene:
    """The scene of some surfaces. Surfaces whose image is the same array share one texture.

    Args:
        surfaces: At least one.
        camera: Mean position of the camera [3], metres.
        target: Point that the camera looks at [3], metres.
        background: Brightness of rays that hit no surface.
    """
    channels = max(array.shape[-1] for surface in surfaces for array in (surface.shade, surface.image))
    images = list({id(surface.image): surface.image for surface in surfaces}.values())
    number = {id(image): index for index, image in enumerate(images)}
    pyramids = [textures.mip_pyramid(np.broadcast_to(image, (*image.shape[:2], channels))) for image in images]
    sizes = np.array([len(image) for image in images])
    triangles = np.concatenate([surface.triangles for surface in surfaces])
    uv = np.concatenate([surface.uv for surface in surfaces])
    texture = np.repeat([number[id(surface.image)] for surface in surfaces], [len(s.triangles) for s in surfaces])
    area, texels = doubled_areas(triangles), doubled_areas(uv) * sizes[texture] ** 2
    return Scene(
        triangles.astype(np.float32),
        uv.astype(np.float32),
        np.concatenate([np.broadcast_to(s.shade, (*s.shade.shape[:2], channels)) for s in surfaces]).astype(np.float32),
        texture.astype(np.int64),
        np.concatenate(pyramids),
        np.cumsum([0, *map(len, pyramids[:-1])], dtype=np.int64),
        sizes.astype(np.int64),
        np.sqrt(np.divide(texels, area, out=np.zeros_like(area), where=area > 0)).astype(np.float32),
        np.array(camera, float),
        np.array(target, float),
        background,
    )


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles [F, 3, D] in the plane (D = 2) or in space (D = 3)."""
    edges = np.diff(corners.astype(np.float64), axis=1)
    return np.sqrt(np.maximum(np.linalg.det(edges @ edges.swapaxes(1, 2)), 0))


def shapes(rng: np.random.Generator) -> Scene:
    """A room with boxes and balls 1.2 to 2.8 metres away. Some surfaces have no texture."""
    clouds, fine, mosaic = textures.clouds(rng), textures.clouds(rng, 0.4, 0.05), textures.mosaic(rng)
    bricks, lines, text, plain = textures.bricks(rng), textures.lines(rng), textures.text(rng), textures.plain()
    back, floor = 3.3, -0.85
    return build_scene(
        [
            *_room((-2.3, -1.5, floor), (2.3, back, 1.5), bricks, clouds, plain, mosaic),
            _surface(_box((0.9, 0.04, 0.6), (-0.1, back, 0.75)), plain, (0, 0.8)),
            _surface(_box((0.5, 0.5, 0.7), (-0.55, 1.75, floor + 0.35), 25), mosaic, (0.15, 0.95)),
            _surface(_box((0.45, 0.45, 0.45), (0.55, 1.45, floor + 0.225), -20), text, (0.15, 0.9)),
            _surface(_box((0.6, 0.4, 1.1), (1.15, 2.4, floor + 0.55), 15), lines, (0.15, 0.9)),
            _surface(_box((0.3, 0.3, 0.3), (0.0, 2.25, 0.1), 40, 20), plain, (0, 0.8)),
            _surface(_box((0.4, 0.1, 0.5), (-1.35, 2.7, 0.45), 10), text, (0.15, 0.9)),
            _surface(_box((0.5, 0.3, 0.25), (0.75, 2.6, 0.75), -30, 10), fine, (0.2, 0.9)),
            _surface(_ball(0.25, (-0.05, 1.35, floor + 0.25)), lines, (0.2, 0.95)),
            _surface(_ball(0.22, (0.5, 1.9, 0.3)), plain, (0, 0.35)),
            _surface(_ball(0.3, (-0.75, 2.2, 0.35)), clouds, (0.2, 0.8)),
        ],
        camera=(0, 0, 0),
        target=(0, 2, -0.1),
    )


def carpet(rng: np.random.Generator) -> Scene:
    """A plane of road-like lines, seen at a slant of 60 degrees from 1.5 metres away."""
    plane = _box((16, 16, 0.1), (0, 0, -0.05))
    return build_scene([_surface(plane, textures.lines(rng), (0.15, 0.9))], camera=(0, -0.75, 1.3), target=(0, 0, 0))


def roads(rng: np.random.Generator) -> Scene:
    """A plane with the map of a town, in colour, seen at a slant of 60 degrees from 1.5 metres away."""
    corners = 20 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    triangles = corners[[[0, 1, 2], [0, 2, 3]]]
    uv = triangles[..., :2] * (1, -1) / textures.EXTENT
    town = Surface(triangles, uv, np.ones((2, 3, 1)), textures.roads(rng))
    return build_scene([town], camera=(0, -0.75, 1.3), target=(0, 0, 0))


def moon(rng: np.random.Generator) -> Scene:
    """A grey landscape of craters under a low sun, seen at a slant of 53 degrees from 1.9 metres away.

    Its mesh is finest at the target, 4 centimetres, and reaches 20 metres. Its texture holds light and shadows.
    """
    heights, brightness = textures.moon(rng)
    smooth = gaussian_filter(heights, 8, mode="wrap")
    steps = np.linspace(-1, 1, 201)
    x, y = np.meshgrid(*2 * [20 * np.sinh(3.5 * steps) / np.sinh(3.5)])
    uv = np.stack([x, -y], -1) / textures.MOON_EXTENT
    z = map_coordinates(smooth, uv.transpose(2, 0, 1)[::-1] * len(smooth) - 0.5, order=1, mode="grid-wrap")
    corner = np.arange(x.size).reshape(x.shape)
    near, far = (corner[:-1, :-1], corner[:-1, 1:]), (corner[1:, :-1], corner[1:, 1:])
    faces = np.concatenate([np.stack([*near, far[1]], -1), np.stack([near[0], far[1], far[0]], -1)]).reshape(-1, 3)
    ground = Surface(
        np.stack([x, y, z], -1).reshape(-1, 3)[faces],
        uv.reshape(-1, 2)[faces],
        np.ones((len(faces), 3, 1)),
        brightness[..., None],
    )
    return build_scene([ground], camera=(0, -1.15, 1.5), target=(0, 0, 0))


def board(rng: np.random.Generator) -> Scene:
    """A desk in a room, with a board 1.3 metres away. Text in many sizes, some of it small, is printed on the board."""
    bricks, wood, clouds, plain = textures.bricks(rng), textures.wood(rng), textures.clouds(rng), textures.plain()
    lines, text, mosaic = textures.lines(rng), textures.text(rng), textures.mosaic(rng)
    desk = -0.47
    tilt = rotation_matrix(np.radians(-8), [1, 0, 0], (0, 1.2, desk))

    def on_desk(size: tuple, x: float, y: float, turn: float = 0, above: float = 0) -> trimesh.Trimesh:
        return _box(size, (x, y, desk + above + size[2] / 2), turn)

    slab = _box((1.28, 0.03, 0.98), (0, 1.22, desk + 0.49))
    slab.apply_transform(tilt)
    left, right, top, bottom = -0.6, 0.6, desk + 0.94, desk + 0.04
    corners = transform_points([[left, 1.2, top], [right, 1.2, top], [right, 1.2, bottom], [left, 1.2, bottom]], tilt)
    halves = [[0, 1, 2], [0, 2, 3]]
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    page = Surface(corners[halves], square[halves], np.full((2, 3, 1), 0.9), 0.06 + 0.9 * textures.page(rng)[..., None])
    mug = trimesh.creation.cylinder(0.05, 0.12)
    mug.apply_translation((0.5, 0.9, desk + 0.06))
    return build_scene(
        [
            *_room((-2.4, -1.5, -1.2), (2.4, 2.3, 1.6), bricks, clouds, plain, mosaic),
            page,
            _surface(slab, wood, (0, 0.4)),
            _surface(on_desk((2.6, 1.0, 0.04), 0, 1.2, above=-0.04), wood, (0.1, 0.75)),
            _surface(on_desk((0.3, 0.22, 0.05), -0.66, 0.92, 12), text, (0.1, 0.7)),
            _surface(on_desk((0.26, 0.2, 0.04), -0.66, 0.92, -6, 0.05), mosaic, (0.2, 0.8)),
            _surface(on_desk((0.24, 0.18, 0.06), -0.65, 0.93, 25, 0.09), lines, (0.15, 0.9)),
            _surface(on_desk((0.4, 0.16, 0.02), -0.1, 0.88, 4), mosaic, (0.1, 0.8)),
            _surface(on_desk((0.18, 0.012, 0.012), 0.3, 0.85, 30), plain, (0, 0.85)),
            _surface(on_desk((0.16, 0.012, 0.012), 0.27, 0.92, -15), plain, (0, 0.1)),
            _surface(mug, plain, (0, 0.75)),
            _surface(_ball(0.09, (0.72, 1.05, desk + 0.09)), mosaic, (0.15, 0.95)),
        ],
        camera=(0, -0.1, 0),
        target=(0, 1.2, -0.08),
    )


SCENES = {"shapes": shapes, "carpet": carpet, "roads": roads, "moon": moon, "board": board}


def diffuse_light(
    normals: Float[np.ndarray, "faces 3 3"], light: Float[np.ndarray, "3"] = LIGHT
) -> Float[np.ndarray, "faces 3 1"]:
    """The light on corners with these unit normals: 0.7 from everywhere, and up to 0.3 from a light far away.

    Args:
        normals: Unit normals at the corners.
        light: Unit vector towards the light.
    """
    return 0.7 + 0.3 * np.maximum(normals @ light, 0)[..., None]


def corner_normals(mesh: trimesh.Trimesh) -> Float[np.ndarray, "faces 3 3"]:
    """Unit normals at the corners of all faces: smoothed over edges of up to 40 degrees, else normals of the face."""
    smooth, flat = mesh.vertex_normals[mesh.faces], mesh.face_normals[:, None]
    return np.where((smooth * flat).sum(-1, keepdims=True) > np.cos(np.radians(40)), smooth, flat)


def texture_coordinates(
    triangles: Float[np.ndarray, "faces 3 3"], face_normals: Float[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3 2"]:
    """Texture coordinates to the right and downwards along the two axes that each face lies closest to.

    A texture is upright and not mirrored as seen from outside.

    Args:
        triangles: Corners, z up, in any unit; the texture coordinates have the same unit.
        face_normals: Normals of the faces, outwards, of any length.
    """
    across = np.abs(face_normals).argmax(1)
    faces = np.arange(len(across))
    outwards = np.sign(face_normals[faces, across]) * np.array([1, -1, 1])[across]
    to_right, up = np.array([1, 0, 0])[across], np.array([2, 2, 1])[across]
    return np.stack([outwards[:, None] * triangles[faces, :, to_right], -triangles[faces, :, up]], axis=-1)


def _surface(mesh: trimesh.Trimesh, levels: np.ndarray, brightness: tuple[float, float]) -> Surface:
    """The surface of a mesh, lit, with a texture that repeats every `textures.EXTENT` metres.

    Args:
        mesh: In metres, z up.
        levels: Texture in [0, 1] [size, size], as the functions of `textures` return them; `size` is a power of two.
        brightness: Linear brightness of the levels 0 and 1.
    """
    dark, bright = brightness
    uv = texture_coordinates(mesh.triangles, mesh.face_normals) / textures.EXTENT
    image = (dark + (bright - dark) * levels)[..., None]
    return Surface(mesh.triangles, uv, diffuse_light(corner_normals(mesh)), image)


def _room(
    lower: tuple, upper: tuple, back: np.ndarray, floor: np.ndarray, plain: np.ndarray, right: np.ndarray
) -> list[Surface]:
    """The inner sides of a box between two corners, with textures."""
    room = trimesh.creation.box(bounds=[lower, upper])
    room.invert()
    room.unmerge_vertices()

    def wall(*normal: int) -> trimesh.Trimesh:
        return trimesh.Trimesh(room.vertices, room.faces[room.face_normals @ normal > 0.5], process=False)

    return [
        _surface(wall(0, -1, 0), back, (0.3, 0.6)),
        _surface(wall(0, 0, 1), floor, (0.35, 0.65)),
        _surface(wall(1, 0, 0), plain, (0, 0.5)),
        _surface(wall(-1, 0, 0), right, (0.3, 0.6)),
        _surface(wall(0, 0, -1), plain, (0, 0.8)),
        _surface(wall(0, 1, 0), plain, (0, 0.5)),
    ]


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
