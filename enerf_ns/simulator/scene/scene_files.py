"""Scenes from files: a mesh file, or a scene file in JSON that puts parts together.

A mesh file is glTF (.glb, .gltf), .obj with .mtl, .ply, .stl or .off. All meshes of the file are taken, each where the
file's scene graph places it. Units are metres, and z is up. In glTF y is up by definition, so y is turned to z.

The picture of a material (baseColorTexture, map_Kd, TextureFile) is converted from sRGB to linear brightness and
stretched to a square of a power of two of at most 2048 texels. It repeats outside of [0, 1]. In glTF it is multiplied
by baseColorFactor and COLOR_0. A mesh without texture coordinates shows the colours of its vertices or faces (linear in
glTF, sRGB elsewhere), or else the colour of its material, or else a grey of 0.8; a note tells the user so. Transparency
and all other properties of materials are ignored.

A scene file (.json) is an object like this one. Paths are relative to the folder of the scene file:
    {
      "parts": [
        {"shape": "models/chair.glb", "size": 0.9, "position": [0.5, 2, 0], "rotation": [0, 0, 30]},
        {"shape": "box", "size": [0.5, 0.5, 0.7], "position": [0, 2, 0], "texture": "bricks", "brightness": [0.1, 0.8]},
        {"shape": "ball", "size": 0.4, "position": [0.4, 1.5, 0], "texture": "clouds"},
        {"shape": "plane", "size": [3, 2], "position": [0, 3, 0], "rotation": [90, 0, 0], "texture": "poster.jpg"}
      ],
      "camera": [0, 0, 0],
      "target": [0, 2, 0],
      "background": 0.0,
      "light": [-0.4, -0.7, 0.6]
    }

Keys of the scene file; only `parts` is required:
    parts       At least one part.
    camera      Mean position of the camera, metres. Default: in front of the target and 30 degrees above it. With the
                default target, the camera then sees all parts.
    target      Point that the camera looks at, metres. Default: the middle of the bounding box of all parts.
    background  Linear brightness of rays that hit no surface. Default: 0.
    light       Direction towards the light. Default: [-0.4, -0.7, 0.6]. With null, every surface is as bright as its
                texture.

Keys of a part; only `shape` is required:
    shape       box, ball, plane, or the path of a mesh file. Before its rotation, a plane lies in z = 0 and
                its face looks upwards.
    size        Metres: lengths of a box along x, y, z (default: [1, 1, 1]), diameter of a ball (default: 1), lengths of
                a plane along x, y (default: [1, 1]), or longest side of the bounding box of a mesh (default: its length
                in the mesh file).
    position    Position of the origin of the part, metres. Default: [0, 0, 0]. The origin of a box, ball or plane is
                its middle.
    rotation    Degrees about the axes x, then y, then z of the world. Default: [0, 0, 0]. The part turns about its
                origin.
    inward      Whether the faces of the part look inwards, like the walls of a room. Default: false. A camera may be
                inside of a closed part only if the faces of the part look inwards.
    texture     plain, clouds, mosaic, bricks, lines, text, wood, roads, moon, page, or the path of an image file.
                Default: plain, or the materials of a mesh file. An image file, like page, is stretched once over each
                side of the part. The other textures repeat every 4 metres (moon: 6 metres).
    brightness  Linear brightness of the darkest and the brightest value of the texture. Default: [0.15, 0.9], or [0, 1]
                for image files, roads and moon.

Surfaces are diffuse: their brightness is the texture times a factor between 0.7, where no light falls, and 1, where the
light falls straight (see `scenes.diffuse_light`).
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from jaxtyping import Float, Float32, Shaped, UInt8
from numpy.typing import ArrayLike
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.resolvers import FilePathResolver
from trimesh.visual.material import PBRMaterial

from enerf_ns.dataparsers.formats.columns import FARTHEST
from enerf_ns.dataparsers.recording.errors import RecordingError, UserError
from enerf_ns.dataparsers.recording.files import (
    LARGEST_PICTURE,
    check_is_file,
    image_size,
    load_image,
    read_json,
    reading,
)
from enerf_ns.dataparsers.recording.picture_depth import find_white_level
from enerf_ns.simulator.scene import textures
from enerf_ns.simulator.scene.gltf import MOST_TRIANGLES, check_gltf
from enerf_ns.simulator.scene.scenes import (
    LIGHT,
    Scene,
    Surface,
    build_scene,
    corner_normals,
    diffuse_light,
    doubled_areas,
    texture_coordinates,
)
from enerf_ns.simulator.sources import linear_from_srgb, linear_picture
from enerf_ns.simulator.trajectories import SMALLEST_DISTANCE, STEEPEST_LOOK

LARGEST_TEXTURE = 2048
"""Most texels along one side of a texture from a picture. It is halved, once or more, for more than eight pictures."""

MOST_TEXELS = 2**26
"""Most pixels of a picture that becomes a texture."""

SHAPES = {"box": 3, "ball": 1, "plane": 2}
"""Count of numbers in the size of each shape that needs no file."""

EXPECTED = "the file of a mesh"

GREY = 0.8
"""Linear brightness of a mesh that has neither a picture nor colours."""

MESHES = ("glb", "gltf", "obj", "ply", "stl", "off")
"""Suffixes of mesh files. trimesh loads others, but archives and XML may unpack to any size and repeat parts."""

IMAGES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".tga", ".gif"}

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Pose that turns the axes of glTF, whose y is up, to axes whose z is up."""

LARGEST_MESH = 2**28
"""Most bytes of the file of a mesh, and of each file that it names but pictures."""


def load_scene(path: Path, rng: np.random.Generator, notes: list[str]) -> Scene:
    """The scene of a mesh file or of a scene file (.json); the docstring of this module describes both.

    Args:
        path: Mesh file or scene file.
        rng: Generator that draws the procedural textures of a scene file.
        notes: Gets a sentence for each thing that is left out or shown differently than a user may expect.

    Returns:
        A scene of one channel where everything is grey, else of three.

    Raises:
        RecordingError: The file, or a file that it names, is missing or cannot be read; the meshes have no faces, or
            lie too far from the origin; or a key or value of the scene file is not allowed.
    """
    if path.suffix.lower() == ".json":
        return _read_scene_file(path, rng, notes)
    return _assemble(path, [_surface(piece, LIGHT) for piece in read_mesh(path, notes)], {})


@dataclass(frozen=True)
class Piece:
    """Triangles with one texture, without light."""

    triangles: Float[np.ndarray, "faces 3 3"]
    """Corners of the triangles in metres, counter-clockwise as seen from outside."""
    normals: Float[np.ndarray, "faces 3 3"]
    """Unit normals at the corners, outwards."""
    uv: Float[np.ndarray, "faces 3 2"]
    """Texture coordinates of the corners, as in `Scene`."""
    colour: Float[np.ndarray, "faces 3 channels"]
    """Linear colour at the corners, a factor of the image."""
    image: Float32[np.ndarray, "size size channels"] = field(default_factory=lambda: textures.plain()[..., None])
    """Linear brightness of the texture; `size` is a power of two."""

    def moved(self, matrix: Float[np.ndarray, "4 4"]) -> Piece:
        """The piece after an affine transform of its points.

        The transform may stretch and mirror. Corners stay counter-clockwise as seen from outside.
        """
        normals = self.normals @ np.linalg.pinv(matrix[:3, :3])
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        triangles = self.triangles @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) >= 0:
            return replace(self, triangles=triangles, normals=normals)
        return replace(self, triangles=triangles, normals=-normals).inside_out()

    def inside_out(self) -> Piece:
        """The piece with faces that look the other way."""
        triangles, normals, uv, colour = (
            array[:, ::-1] for array in (self.triangles, -self.normals, self.uv, self.colour)
        )
        return Piece(triangles, normals, uv, colour, self.image)


def read_mesh(path: Path, notes: list[str]) -> list[Piece]:
    """All triangles of a mesh file, where its scene graph places them, z up.

    Args:
        path: Mesh file.
        notes: As for `load_scene`.

    Raises:
        RecordingError: The file, or a file that it names, is missing or cannot be read, or there are no faces.
    """
    check_is_file(path, EXPECTED, LARGEST_MESH)
    if not path.exists():
        raise RecordingError(f"{path} is missing; {EXPECTED} was expected.")
    kind = path.suffix.lower().lstrip(".")
    if kind not in MESHES:
        raise RecordingError(
            f"{path} is of a type that is not read; give a .glb, .gltf, .obj, .ply, .stl or .off file, or a scene file "
            "(.json)."
        )
    is_gltf = kind in ("glb", "gltf")
    files, pieces = _Files(path), []
    try:
        expected = check_gltf(path, files.size_of, notes) if is_gltf else 0
        with _without_warnings():
            graph: Any = trimesh.load(str(path), resolver=files, process=False, force="scene")
            if files.fault is None:
                pieces = _pieces(path, graph, is_gltf, expected, notes)
    except UserError:
        if files.fault is None:
            raise
    except ImportError as error:
        raise RecordingError(f"{path} needs a package that is not installed: {_in_one_line(error)}.") from error
    except Exception as error:  # of any kind: trimesh raises other ones for damaged files of each format
        if files.fault is None:
            raise RecordingError(
                f"{path} cannot be read as a mesh ({_reason(error)}); copy it in full or export it again."
            ) from error
    if files.fault is not None:
        raise files.fault
    if not pieces:
        raise RecordingError(f"{path} holds no mesh with faces; give one with at least one triangle.")
    total = sum(len(piece.triangles) for piece in pieces)
    declared = _declared_faces(path) if kind == "ply" else 0
    if total < declared:
        raise RecordingError(f"{path} holds {total} faces, but its header says {declared}; copy it in full.")
    pieces = [piece for piece in map(_with_area, pieces) if len(piece.triangles)]
    kept = sum(len(piece.triangles) for piece in pieces)
    if not kept:
        raise RecordingError(f"{path} holds {total} triangles, but none of them has an area; export it again.")
    if kept < total:
        notes.append(f"{path} holds {total - kept} triangles without an area, which are left out; {kept} are used.")
    return pieces


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Silences trimesh, which logs tracebacks of faults that `read_mesh` reports in a sentence."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _declared_faces(path: Path) -> int:
    """Number of polygons that the header of a PLY file states; trimesh does not compare it with what it finds."""
    with path.open("rb") as file:
        found = re.search(rb"^element\s+face\s+(\d+)", file.read(65536).split(b"end_header")[0], re.MULTILINE)
    return int(found[1]) if found else 0


class _Files(FilePathResolver):
    """Gives trimesh the files that a mesh names, and remembers faulty ones, which trimesh passes over."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.path, self.folder = path, path.parent
        self.fault: RecordingError | None = None
        """The error of the first file that is missing, or cannot be read."""

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        for place in (self.folder / name, self.folder / unquote(name), self.folder / Path(name).name):
            if place.exists():
                is_image = place.suffix.lower() in IMAGES
                expected = "an image" if is_image else "a part of a mesh"
                try:
                    with reading(place, expected, LARGEST_PICTURE if is_image else LARGEST_MESH):
                        content = place.read_bytes()
                    if is_image:
                        self._check_image(place, content)
                except RecordingError as error:
                    self.fault = self.fault or error
                    raise
                return content
        self.fault = self.fault or self._naming(f"{name}, which is not in {self.folder}")
        raise FileNotFoundError(name)

    def size_of(self, name: str) -> int:
        """The number of bytes of a file; 0 if it is missing, which is remembered."""
        try:
            return len(self.get(name))
        except (FileNotFoundError, RecordingError):
            return 0

    def _check_image(self, place: Path, content: bytes) -> None:
        try:
            Image.open(BytesIO(content)).load()
        except Exception as error:  # of any kind: Pillow raises other ones for damaged files of each format
            raise self._naming(f"{place}, which cannot be read as an image") from error

    def _naming(self, what: str) -> RecordingError:
        return RecordingError(f"{self.path} names {what}; put it there or take its name out of {self.path.name}.")


def _pieces(path: Path, graph: trimesh.Scene, is_gltf: bool, expected: int, notes: list[str]) -> list[Piece]:
    """The meshes of a scene graph, where it places them; a note for each substitute of a texture.

    Raises:
        RecordingError: There are fewer pictures than expected.
    """
    nodes = [graph.graph[node] for node in graph.graph.nodes_geometry]
    placed = [(matrix, graph.geometry[name]) for matrix, name in nodes]
    placed = [(matrix, mesh) for matrix, mesh in placed if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    for matrix, mesh in placed:
        if (number := int(mesh.faces.max())) >= len(mesh.vertices) or (number := int(mesh.faces.min())) < 0:
            raise RecordingError(
                f"{path} holds a triangle at vertex {number:,} of a mesh with {len(mesh.vertices):,} vertices; copy it "
                "in full or export it again."
            )
        if not np.abs(matrix).max() < FARTHEST:
            raise RecordingError(
                f"{path} places a mesh by a matrix that holds {matrix.flat[np.abs(matrix).argmax()]:g}, but numbers up "
                f"to {FARTHEST:g} were expected; export it again."
            )
    pictures = {id(picture): picture for mesh in graph.geometry.values() if (picture := _picture(mesh)) is not None}
    if len(pictures) < expected:
        raise RecordingError(
            f"{path} has {expected} pictures as textures, of which {len(pictures)} can be decoded; export them as PNG "
            "or JPEG."
        )
    largest = LARGEST_TEXTURE
    while len(pictures) * largest**2 > 8 * LARGEST_TEXTURE**2:
        largest //= 2
    for picture in pictures.values():
        _check_texels(path, *picture.size)
    images = {key: linear_image(_pixels(picture), largest) for key, picture in pictures.items()}
    pieces, untextured = [], Counter[str]()
    for matrix, mesh in placed:
        piece, reason = _piece(mesh, images, is_gltf)
        pieces.append(piece.moved(Z_UP @ matrix if is_gltf else matrix))
        untextured[reason] += 1
    del untextured[""]
    notes.extend(f"{path} has {reason} (in {count} of {len(placed)} meshes)." for reason, count in untextured.items())
    return pieces


def _piece(mesh: trimesh.Trimesh, images: dict[int, np.ndarray], is_gltf: bool) -> tuple[Piece, str]:
    """A mesh in its own axes, and a description of the substitute that it shows for a texture that it lacks.

    Args:
        mesh: Mesh with at least one face.
        images: Linear brightness of each picture, by the id of the picture.
        is_gltf: Whether colours are linear, as in glTF, else sRGB.

    Returns:
        The piece, and the end of a sentence about the substitute, which is empty if the mesh lacks nothing.
    """
    visual: Any = mesh.visual
    faces, instead = mesh.faces, "neither a texture nor colours and is shown in grey"
    colour: np.ndarray | None = None
    uv, image = np.zeros((*faces.shape, 2)), textures.plain()[..., None]
    if visual.kind == "texture":
        material, picture = visual.material, _picture(mesh)
        is_textured = picture is not None and np.shape(visual.uv) == (len(mesh.vertices), 2)
        if is_textured:
            uv, image = (visual.uv * (1, -1) + (0, 1))[faces], images[id(picture)]
        if isinstance(material, PBRMaterial):
            colour = _fractions(material.baseColorFactor)
        elif is_textured:
            colour = np.ones(3)
        elif "kd" in material.kwargs:
            colour = _fractions(material.diffuse)
        if colour is not None and "color" in visual.vertex_attributes:
            colour = colour * _fractions(visual.vertex_attributes["color"])[faces]
        if colour is not None:
            lacks_coordinates = picture is not None and not is_textured
            instead = "no texture coordinates and shows the colours of its materials" if lacks_coordinates else ""
    elif visual.kind in ("vertex", "face"):
        colour = _fractions(visual.vertex_colors[faces] if visual.kind == "vertex" else visual.face_colors[:, None])
        colour = colour if is_gltf else linear_from_srgb(colour)
        of_what = "vertices" if visual.kind == "vertex" else "faces"
        instead = f"no texture coordinates and shows the colours of its {of_what}"
    colour = np.full(1, GREY) if colour is None else _one_or_three(colour)
    corners = np.asarray(mesh.triangles, np.float64)
    colour = np.broadcast_to(colour, (*faces.shape, colour.shape[-1]))
    return Piece(corners, corner_normals(mesh), uv, colour, image), instead


def _picture(mesh: Any) -> Image.Image | None:
    """Picture of the material of a mesh, if it has one."""
    material = getattr(getattr(mesh, "visual", None), "material", None)
    return getattr(material, "baseColorTexture", getattr(material, "image", None))


def _check_texels(path: Path, width: int, height: int) -> None:
    """Refuses a picture that takes gigabytes as linear brightness."""
    if width * height > MOST_TEXELS:
        raise RecordingError(
            f"{path} has a texture of {width:,} x {height:,} pixels, but at most {MOST_TEXELS:,} were expected; make "
            "it smaller."
        )


def _pixels(picture: Image.Image) -> UInt8[np.ndarray, "height width channels"]:
    if picture.mode.startswith("I"):
        return (np.asarray(picture).clip(0, 65535) // 256).astype(np.uint8)[..., None]
    return np.asarray(picture.convert("RGB"))


def _fractions(colours: ArrayLike | None) -> Float[np.ndarray, "*batch 3"]:
    """Red, green and blue in [0, 1], from whole numbers or floats with or without a fourth channel; None is white."""
    if colours is None:
        return np.ones(3)
    values = np.asarray(colours)[..., :3]
    return values / np.iinfo(values.dtype).max if values.dtype.kind in "iu" else values.astype(np.float64)


def _one_or_three(colours: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch channels"]:
    """The colours, in one channel where all of them are grey."""
    return colours[..., :1] if (colours == colours[..., :1]).all() else colours


def linear_image(
    picture: Shaped[np.ndarray, "height width channels"], largest: int = LARGEST_TEXTURE
) -> Float32[np.ndarray, "size size channels"]:
    """Linear brightness of an sRGB picture, stretched to a square.

    The side of the square is the next power of two from the longer side of the picture on, but at most `largest`.

    Args:
        picture: sRGB, uint8 or float32 in [0, 1].
        largest: Most texels along one side, a power of two.
    """
    size = min(largest, 1 << (max(picture.shape[:2]) - 1).bit_length())
    return textures.square(linear_picture(_one_or_three(picture)), size)


def _with_area(piece: Piece) -> Piece:
    """The piece without triangles that are a line or a point, or that have numbers that are not finite."""
    longest = np.linalg.norm(piece.triangles - np.roll(piece.triangles, 1, axis=1), axis=2).max(1)
    with np.errstate(invalid="ignore"):
        kept = (doubled_areas(piece.triangles) > 1e-7 * longest**2) & np.isfinite(piece.uv).all((1, 2))
    names = ("triangles", "normals", "uv", "colour")
    return replace(piece, **{name: getattr(piece, name)[kept] for name in names})


def _surface(piece: Piece, light: np.ndarray | None) -> Surface:
    """The surface of a piece in a light.

    Args:
        piece: Triangles without light.
        light: Unit vector towards the light; None if every surface is as bright as its texture.
    """
    lit = np.ones((1, 1, 1)) if light is None else diffuse_light(piece.normals, light)
    return Surface(piece.triangles, piece.uv, piece.colour * lit, piece.image)


def _assemble(path: Path, surfaces: list[Surface], about: dict[str, Any]) -> Scene:
    """The scene of some surfaces, with the camera and the background of a scene file.

    By default the target is the middle of the surfaces. The camera stands 30 degrees above the target and sees all
    surfaces.

    Args:
        path: Mesh file or scene file, for errors.
        surfaces: At least one.
        about: Keys of the scene file; camera, target and background are used if they are there.

    Raises:
        RecordingError: The surfaces lie too far from the origin; camera, target or background is not allowed; or the
            camera is too close to its target or right above or below it.
    """
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
    lower, upper = corners.min(0), corners.max(0)
    size, farthest = np.linalg.norm(upper - lower), np.abs(corners).max()
    if farthest * np.finfo(np.float32).eps > 1e-5 * size:
        raise RecordingError(
            f"{path} holds {size:.3g} m of surfaces {farthest:.3g} m away from the origin, too far for single "
            "precision; move them closer to the origin (in a scene file: by position)."
        )
    where = str(path)
    target = _numbers(about, "target", 3, where, (lower + upper) / 2)
    camera = _numbers(about, "camera", 3, where, target + size * np.array([0, -np.cos(np.pi / 6), np.sin(np.pi / 6)]))
    background = _numbers(about, "background", 1, where, 0.0, lowest=0)
    forward = target - camera
    distance = np.linalg.norm(forward)
    if distance < SMALLEST_DISTANCE or np.hypot(*forward[:2]) < STEEPEST_LOOK * distance:
        raise RecordingError(
            f"{path} has its camera at {camera.tolist()} and its target at {target.tolist()}, but they must be apart, "
            "and not one right above the other; move the camera."
        )
    return build_scene(surfaces, camera, target, float(background[0]))


def _read_scene_file(path: Path, rng: np.random.Generator, notes: list[str]) -> Scene:
    """The scene of a scene file; arguments and errors as for `load_scene`."""
    about = read_json(path)
    _check_keys(about, str(path), ("parts", "camera", "target", "background", "light"))
    parts = about.get("parts")
    if not isinstance(parts, list) or not parts:
        raise RecordingError(f"{path} holds parts = {_shown(parts)}, but a list of at least one part was expected.")
    light = None if "light" in about and about["light"] is None else _numbers(about, "light", 3, str(path), LIGHT)
    if light is not None:
        if not light.any():
            raise RecordingError(f"{path} holds light = [0, 0, 0], which is no direction; write null for no light.")
        light = light / np.linalg.norm(light)
    library, pieces, triangles, shapes = _Library(path.parent, rng), [], 0, {}
    for number, part in enumerate(parts, 1):
        read = _read_part(path.parent, part, f"{path}, part {number},", library, notes)
        shapes[part["shape"]] = sum(len(piece.triangles) for piece in read)
        triangles += shapes[part["shape"]]
        if triangles > max(MOST_TRIANGLES, sum(shapes.values())):
            raise RecordingError(
                f"{path} holds more than {MOST_TRIANGLES:,} triangles up to part {number}, by repeating shapes; leave "
                "parts out."
            )
        pieces += read
    return _assemble(path, [_surface(piece, light) for piece in pieces], about)


def _read_part(folder: Path, part: Any, where: str, library: _Library, notes: list[str]) -> list[Piece]:
    """The pieces of one part of a scene file, at their place in the world.

    Args:
        folder: Folder of the scene file.
        part: JSON value of the part.
        where: Beginning of errors: scene file and number of the part.
        library: Textures of the scene file.
        notes: As for `load_scene`.

    Raises:
        RecordingError: A key or value of the part is not allowed, or a file that it names cannot be read.
    """
    if not isinstance(part, dict):
        raise RecordingError(f"{where} is {_shown(part)}, but a JSON object was expected.")
    _check_keys(part, where, ("shape", "size", "position", "rotation", "inward", "texture", "brightness"))
    shape, texture = part.get("shape"), part.get("texture")
    if not isinstance(shape, str):
        raise RecordingError(
            f"{where} holds shape = {_shown(shape)}, but box, ball, plane or a mesh file was expected."
        )
    if shape in SHAPES:
        size = _numbers(part, "size", SHAPES[shape], where, np.ones(SHAPES[shape]), lowest=1e-6)
        pieces, texture = [_shape(shape, size)], "plain" if texture is None else texture
    elif not Path(shape).suffix:
        raise RecordingError(
            f"{where} holds shape = {_shown(shape)}, but box, ball, plane or a mesh file was expected."
        )
    else:
        pieces = read_mesh(folder / shape, notes)
        if "size" in part:
            corners = np.concatenate([piece.triangles.reshape(-1, 3) for piece in pieces])
            scale = _numbers(part, "size", 1, where, lowest=1e-6)[0] / np.ptp(corners, axis=0).max()
            pieces = [piece.moved(np.diag([scale, scale, scale, 1])) for piece in pieces]
    inward = part.get("inward", False)
    if not isinstance(inward, bool):
        raise RecordingError(f"{where} holds inward = {_shown(inward)}, but true or false was expected.")
    if inward:
        pieces = [piece.inside_out() for piece in pieces]
    brightness = _numbers(part, "brightness", 2, where, lowest=0) if "brightness" in part else None
    if texture is not None:
        pieces = _textured(pieces, *library.texture(texture, brightness, where))
    elif brightness is not None:
        raise RecordingError(f"{where} holds brightness, but no texture; add texture or leave brightness out.")
    placed = np.eye(4)
    turn = _numbers(part, "rotation", 3, where, np.zeros(3))
    placed[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    placed[:3, 3] = _numbers(part, "position", 3, where, np.zeros(3))
    return [piece.moved(placed) for piece in pieces]


def _shape(shape: str, size: np.ndarray) -> Piece:
    """A box, a ball or a plane whose middle is the origin; `size` as in a scene file, metres."""
    if shape == "box":
        mesh = trimesh.creation.box(size)
    elif shape == "ball":
        mesh = trimesh.creation.icosphere(4, size[0] / 2)
    else:
        corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
        mesh = trimesh.Trimesh(corners * [*size, 1], [[0, 1, 2], [0, 2, 3]], process=False)
    return Piece(
        mesh.triangles, corner_normals(mesh), np.zeros((len(mesh.faces), 3, 2)), np.ones((len(mesh.faces), 3, 1))
    )


def _picture_of(file: Path) -> Shaped[np.ndarray, "height width channels"]:
    """The image of a file: uint8, or float32 in [0, 1] if the file has more than 8 bits."""
    _check_texels(file, *image_size(file))
    image = load_image(file)
    return image if image.dtype == np.uint8 else image / np.float32(find_white_level((file,)))


class _Library:
    """The textures of a scene file. Each texture is made once.

    Args:
        folder: Folder of the scene file, to which paths of image files are relative.
        rng: Generator that draws the procedural textures.
    """

    def __init__(self, folder: Path, rng: np.random.Generator):
        self.folder, self.rng = folder, rng
        self.levels: dict[str, np.ndarray] = {}
        self.scaled: dict[tuple[str, float, float], np.ndarray] = {}

    def texture(self, name: Any, brightness: np.ndarray | None, where: str) -> tuple[np.ndarray, float | None]:
        """The image [size, size, channels] of a texture, and its extent as in `textures.Procedural`.

        Args:
            name: Name of a procedural texture, or path of an image file.
            brightness: Linear brightness of the levels 0 and 1 [2]; None for the default of the texture.
            where: Beginning of errors: scene file and number of the part.

        Raises:
            RecordingError: The texture is not known, or the image file is missing or cannot be read.
        """
        if not isinstance(name, str) or (name not in textures.PROCEDURAL and not Path(name).suffix):
            raise RecordingError(
                f"{where} holds texture = {_shown(name)}, but an image file or one of "
                f"{', '.join(textures.PROCEDURAL)} was expected."
            )
        known = textures.PROCEDURAL.get(name)
        if name not in self.levels:
            levels = linear_image(_picture_of(self.folder / name)) if known is None else known.make(self.rng)
            self.levels[name] = levels.reshape(*levels.shape[:2], -1)
        usual = (0.0, 1.0) if known is None else known.brightness
        dark, bright = usual if brightness is None else brightness.tolist()
        if (name, dark, bright) not in self.scaled:
            self.scaled[name, dark, bright] = (dark + (bright - dark) * self.levels[name]).astype(np.float32)
        return self.scaled[name, dark, bright], None if known is None else known.extent


def _textured(pieces: list[Piece], image: np.ndarray, extent: float | None) -> list[Piece]:
    """The pieces with another texture, along the sides of their common bounding box.

    Args:
        pieces: At least one, in axes along which the texture lies.
        image: Linear brightness of the texture [size, size, channels].
        extent: Metres after which the texture repeats; None if it is stretched once over each side.
    """
    corners = np.concatenate([piece.triangles.reshape(-1, 3) for piece in pieces])
    lower, span = corners.min(0), np.ptp(corners, axis=0)
    unit = np.where(span > 0, span, 1) if extent is None else extent
    textured = []
    for piece in pieces:
        first, second = np.moveaxis(np.diff(piece.triangles, axis=1), 1, 0)
        face_normals = np.cross(first, second)
        start = lower if extent is None else 0
        uv = texture_coordinates((piece.triangles - start) / unit, face_normals)
        textured.append(replace(piece, uv=uv, colour=np.ones((*uv.shape[:2], 1)), image=image))
    return textured


def _check_keys(about: dict[str, Any], where: str, known: tuple[str, ...]) -> None:
    """Refuses keys that are not known."""
    unknown = [key for key in about if key not in known]
    if unknown:
        raise RecordingError(f"{where} holds {_shown(unknown[0])}, which is not known; use {', '.join(known)}.")


def _numbers(
    about: dict[str, Any],
    key: str,
    count: int,
    where: str,
    default: ArrayLike | None = None,
    lowest: float = -1e6,
) -> Float[np.ndarray, " count"]:
    """The numbers of a key of a scene file.

    Args:
        about: The scene file or a part of it.
        key: Name of the value.
        count: Count of numbers. A single number stands without a list around it.
        where: Beginning of errors: scene file, and number of the part if there is one.
        default: Value if the key is missing; if it is None, the key must be there.
        lowest: Smallest number that is allowed; the largest is a million.

    Raises:
        RecordingError: The value is not `count` numbers in this range.
    """
    if key not in about and default is not None:
        return np.atleast_1d(np.asarray(default, np.float64))
    value = about[key]
    numbers = value if isinstance(value, list) and count > 1 else [value]
    if len(numbers) != count or not all(
        isinstance(number, int | float) and not isinstance(number, bool) and lowest <= number <= 1e6
        for number in numbers
    ):
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise RecordingError(
            f"{where} holds {key} = {_shown(value)}, but {expected} from {lowest:g} to 1e+06 was expected."
        )
    return np.array(numbers, np.float64)


def _shown(value: Any) -> str:
    """A value as JSON, cut after 80 characters."""
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:80]} ..."


def _reason(error: Exception) -> str:
    """The fault of a mesh, in place of an error about arrays by which trimesh stumbles on it."""
    if isinstance(error, IndexError):
        return "it names a part that it does not hold"
    text = _in_one_line(error)
    if re.search("array|matmul|unpack|index|object|attribute|argument|sequence|Error$", text):
        return "some of its rows or values are not of the form that they should have"
    return text


def _in_one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
