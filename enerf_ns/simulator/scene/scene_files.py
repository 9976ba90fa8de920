"""Scenes from files: a mesh in any format that trimesh loads, or a JSON file that puts parts together.

Mesh (glTF .glb and .gltf, .obj with .mtl, .ply, .stl, .off, .dae, .3mf ...; some need further packages of trimesh's):
    All meshes of the file are taken, each where the file's graph of nodes places it. Metres; z is up, except in glTF,
    whose y is up by definition and is turned to z. The picture of a material (baseColorTexture, map_Kd, TextureFile)
    is taken from sRGB to linear brightness, stretched to a square of a power of two of at most 2048 texels, and repeats
    outside of [0, 1]. In glTF it is multiplied by baseColorFactor and COLOR_0. Where there are no texture coordinates
    the colours of vertices or faces are taken (linear in glTF, sRGB elsewhere), or else the material's, or else a grey
    of 0.8, and a note says so. Transparency and all other properties of materials are ignored.

Scene file (.json), paths relative to its folder; everything but `parts` and `shape` may be left out:
    {
      "parts": [
        {"shape": "models/chair.glb", "size": 0.9, "position": [0.5, 2, 0], "rotation": [0, 0, 30]},
        {"shape": "box", "size": [0.5, 0.5, 0.7], "position": [0, 2, 0], "texture": "bricks", "brightness": [0.1, 0.8]},
        {"shape": "ball", "size": 0.4, "position": [0.4, 1.5, 0], "texture": "clouds"},
        {"shape": "plane", "size": [3, 2], "position": [0, 3, 0], "rotation": [90, 0, 0], "texture": "poster.jpg"}
      ],
      "camera": [0, 0, 0],        where it stands on average, metres; without it, where it sees all parts
      "target": [0, 2, 0],        what it looks at; without it, the middle of all parts
      "background": 0.0,          brightness where there is nothing
      "light": [-0.4, -0.7, 0.6]  direction towards the light; null: surfaces are as bright as their texture
    }
    shape       a box, a ball, a plane (z = 0 before it is turned, seen from above), or a mesh's file.
    size        metres: a box along x, y, z [1, 1, 1]; a ball's diameter [1]; a plane along x, y [1, 1]; of a mesh the
                longest side of its bounding box, without it the mesh is as large as it is.
    position    of the origin of the part, for box, ball and plane their middle, metres [0, 0, 0].
    rotation    degrees about the axes x, then y, then z of the world [0, 0, 0], about the origin of the part.
    inward      whether its faces look inwards, as those of a room [false]; a camera may only be inside of such a part.
    texture     plain, clouds, mosaic, bricks, lines, text, wood, roads, moon, page, or an image file, which is
                stretched once over each side of the part, as page is (plain; a mesh: its own materials).
    brightness  of the texture's darkest and brightest value ([0.15, 0.9]; of images, roads and moon [0, 1]).
Surfaces are diffuse: brightness is the texture times 0.7 where the light does not fall and up to 1 where it does.
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
from importlib.util import find_spec
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

from enerf_ns.dataparsers.recording.errors import RecordingError, UserError
from enerf_ns.dataparsers.recording.files import load_image, read_json
from enerf_ns.dataparsers.recording.picture_depth import find_white_level
from enerf_ns.simulator.scene import textures
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
"""Most texels along one side of a texture made from a picture; less where there are more than eight pictures."""

SHAPES = {"box": 3, "ball": 1, "plane": 2}
"""Shapes that need no file, with how many numbers their size has."""

GREY = 0.8
"""Brightness of a mesh that has neither a picture nor colours."""

IMAGES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".tga", ".gif"}

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Pose that turns the axes of glTF, whose y is up, to axes whose z is up."""

GLTF_FLOAT, GLTF_FAN = 5126, 6
"""Component type of floats and mode of a fan of triangles, as glTF numbers them."""


def load_scene(path: Path, rng: np.random.Generator, notes: list[str]) -> Scene:
    """A scene from a mesh's file or from a scene file (.json), as the module describes them.

    Args:
        path: of the file.
        rng: draws the procedural textures of a scene file.
        notes: gains a sentence for whatever was left out or is not as one may expect.

    Returns:
        One channel where everything is grey, else three.

    Raises:
        RecordingError: The file or one that it names is missing or cannot be read, nothing in it has faces, a texture
            is not known, or a value of the scene file is not what it must be.
    """
    if path.suffix.lower() == ".json":
        return _read_scene_file(path, rng, notes)
    return _assemble(path, [_surface(piece, LIGHT) for piece in read_mesh(path, notes)], {})


@dataclass(frozen=True)
class Piece:
    """Triangles with one texture, before light falls on them."""

    triangles: Float[np.ndarray, "faces 3 3"]
    """Corners of the triangles in metres, counter-clockwise as seen from outside."""
    normals: Float[np.ndarray, "faces 3 3"]
    """Unit vectors at the corners, outwards."""
    uv: Float[np.ndarray, "faces 3 2"]
    """Texture coordinates of the corners, as in `Scene`."""
    colour: Float[np.ndarray, "faces 3 channels"]
    """Linear colour at the corners; multiplies the image."""
    image: Float32[np.ndarray, "size size channels"] = field(default_factory=lambda: textures.plain()[..., None])
    """Linear brightness of the texture, as in `Surface`."""

    def moved(self, matrix: Float[np.ndarray, "4 4"]) -> Piece:
        """The piece in other axes, which may be stretched or mirrored; corners stay counter-clockwise as seen from
        outside."""
        normals = self.normals @ np.linalg.pinv(matrix[:3, :3])
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        triangles = self.triangles @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) >= 0:
            return replace(self, triangles=triangles, normals=normals)
        return replace(self, triangles=triangles, normals=-normals).inside_out()

    def inside_out(self) -> Piece:
        """The piece turned inside out: its inside becomes its outside."""
        triangles, normals, uv, colour = (
            array[:, ::-1] for array in (self.triangles, -self.normals, self.uv, self.colour)
        )
        return Piece(triangles, normals, uv, colour, self.image)


def read_mesh(path: Path, notes: list[str]) -> list[Piece]:
    """All triangles of a mesh's file, where its graph of nodes places them, z up.

    Raises:
        RecordingError: The file or one that it names is missing or cannot be read, or there are no faces.
    """
    if not path.is_file():
        raise RecordingError(
            f"{path} is {'a folder' if path.is_dir() else 'missing'}; the file of a mesh was expected."
        )
    kind = path.suffix.lower().lstrip(".")
    if kind not in trimesh.available_formats():
        raise RecordingError(
            f"{path} is of a type that trimesh does not load with the packages that are installed; give a .glb, .gltf, "
            ".obj, .ply, .stl or .off file, or a scene file (.json)."
        )
    is_gltf = kind in ("glb", "gltf")
    expected = _check_gltf(path, notes) if is_gltf else 0
    files, pieces = _Files(path), []
    try:
        with _without_warnings():
            graph: Any = trimesh.load(str(path), resolver=files, process=False, force="scene")
            if not files.fault:
                pieces = _pieces(path, graph, is_gltf, expected, notes)
    except UserError:
        raise
    except ImportError as error:
        raise RecordingError(f"{path} needs a package that is not installed: {_in_one_line(error)}.") from error
    except Exception as error:  # of any kind: each format of trimesh's has some of its own for what is damaged
        if not files.fault:
            raise RecordingError(
                f"{path} cannot be read as a mesh ({_in_one_line(error)}); copy it in full or export it again."
            ) from error
    if files.fault:
        raise RecordingError(f"{path} names {files.fault}; put it there or take its name out of {path.name}.")
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
    """Nothing is logged by trimesh, which shows tracebacks for what is said here in a sentence."""
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
    """How many polygons the header of a PLY file says there are; trimesh takes what it finds."""
    with path.open("rb") as file:
        found = re.search(rb"^element\s+face\s+(\d+)", file.read(65536).split(b"end_header")[0], re.MULTILINE)
    return int(found[1]) if found else 0


class _Files(FilePathResolver):
    """Gives trimesh the files that a mesh names, and remembers what is wrong with one, which trimesh passes over."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.folder = path.parent
        self.fault = ""
        """The first file that is missing or no image, if any."""

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        for place in (self.folder / name, self.folder / unquote(name), self.folder / Path(name).name):
            if place.is_file():
                content = place.read_bytes()
                if place.suffix.lower() in IMAGES:
                    self._check_image(place, content)
                return content
        self.fault = self.fault or f"{name}, which is not in {self.folder}"
        raise FileNotFoundError(name)

    def _check_image(self, place: Path, content: bytes) -> None:
        try:
            Image.open(BytesIO(content)).load()
        except Exception:  # of any kind, since Pillow has some of its own for what is damaged
            self.fault = self.fault or f"{place}, which cannot be read as an image"
            raise


def _check_gltf(path: Path, notes: list[str]) -> int:
    """Refuses what trimesh would read wrongly without a word, and says how many pictures the triangles have."""
    try:
        with path.open("rb") as file:
            start = file.read(20)
            is_binary = start[:4] == b"glTF"
            text = file.read(int.from_bytes(start[12:16], "little")) if is_binary else start + file.read()
        header = json.loads(text)
        required = [name for name in header.get("extensionsRequired", []) if not _is_read(name)]
        primitives = [primitive for mesh in header.get("meshes", []) for primitive in mesh["primitives"]]
        used = {primitive["attributes"].get(name) for primitive in primitives for name in ("POSITION", "TEXCOORD_0")}
        accessors = [header["accessors"][index] for index in used - {None}]
        coded = any("sparse" in accessor or accessor["componentType"] != GLTF_FLOAT for accessor in accessors)
        fans = any(primitive.get("mode") == GLTF_FAN for primitive in primitives)
        shown = {primitive["material"] for primitive in primitives if "material" in primitive}
        materials = [header["materials"][index].get("pbrMetallicRoughness", {}) for index in shown]
        pictures = [material["baseColorTexture"] for material in materials if "baseColorTexture" in material]
        moved = any(
            picture.get("texCoord", 0) or "KHR_texture_transform" in picture.get("extensions", {})
            for picture in pictures
        )
        used_textures = [header["textures"][picture["index"]] for picture in pictures]
        sources = {json.dumps([texture.get("source"), texture.get("extensions")]) for texture in used_textures}
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise RecordingError(
            f"{path} cannot be read as glTF ({type(error).__name__}: {_in_one_line(error)}); copy it in full or "
            "export it again."
        ) from error
    if required:
        raise RecordingError(f"{path} needs {', '.join(required)}, which cannot be read; export it uncompressed.")
    if coded:
        raise RecordingError(
            f"{path} holds positions or texture coordinates that are sparse or no floating point numbers, which cannot "
            "be read; export it without quantization."
        )
    if fans:
        notes.append(f"{path} holds fans of triangles, which are left out.")
    if moved:
        notes.append(f"{path} moves textures by KHR_texture_transform or has them at TEXCOORD_1, which is ignored.")
    return len(sources)


def _is_read(extension: str) -> bool:
    """Whether trimesh reads a glTF extension, or it changes nothing that matters here."""
    if extension == "KHR_draco_mesh_compression":
        return find_spec("DracoPy") is not None
    harmless = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp")
    return extension.startswith("KHR_materials_") or extension in harmless


def _pieces(path: Path, graph: trimesh.Scene, is_gltf: bool, expected: int, notes: list[str]) -> list[Piece]:
    """The meshes of a graph, where it places them; notes say how those without a texture are coloured.

    Raises:
        RecordingError: There are fewer pictures than expected.
    """
    nodes = [graph.graph[node] for node in graph.graph.nodes_geometry]
    placed = [(matrix, graph.geometry[name]) for matrix, name in nodes]
    placed = [(matrix, mesh) for matrix, mesh in placed if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    pictures = {id(picture): picture for mesh in graph.geometry.values() if (picture := _picture(mesh)) is not None}
    if len(pictures) < expected:
        raise RecordingError(
            f"{path} has {expected} pictures as textures, of which {len(pictures)} can be read; export them as PNG or "
            "JPEG."
        )
    largest = LARGEST_TEXTURE
    while len(pictures) * largest**2 > 8 * LARGEST_TEXTURE**2:
        largest //= 2
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
    """A mesh in its own axes, and what it shows instead of a texture; empty where it has all that it should."""
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


def _pixels(picture: Image.Image) -> UInt8[np.ndarray, "height width channels"]:
    if picture.mode.startswith("I"):
        return (np.asarray(picture).clip(0, 65535) // 256).astype(np.uint8)[..., None]
    return np.asarray(picture.convert("RGB"))


def _fractions(colours: ArrayLike | None) -> Float[np.ndarray, "*batch 3"]:
    """Red, green and blue in [0, 1], of whole numbers or floats with or without a fourth channel; None is white."""
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
    """Linear brightness of an sRGB picture, uint8 or float32 in [0, 1], stretched to the next power of two above its
    longer side, or to `largest`."""
    size = min(largest, 1 << (max(picture.shape[:2]) - 1).bit_length())
    return textures.square(linear_picture(_one_or_three(picture)), size)


def _with_area(piece: Piece) -> Piece:
    """The piece without triangles that are a line or a point, or whose numbers are not finite."""
    longest = np.linalg.norm(piece.triangles - np.roll(piece.triangles, 1, axis=1), axis=2).max(1)
    with np.errstate(invalid="ignore"):
        kept = (doubled_areas(piece.triangles) > 1e-7 * longest**2) & np.isfinite(piece.uv).all((1, 2))
    names = ("triangles", "normals", "uv", "colour")
    return replace(piece, **{name: getattr(piece, name)[kept] for name in names})


def _surface(piece: Piece, light: np.ndarray | None) -> Surface:
    """What a piece looks like in a light, or without one as bright as its texture."""
    lit = np.ones((1, 1, 1)) if light is None else diffuse_light(piece.normals, light)
    return Surface(piece.triangles, piece.uv, piece.colour * lit, piece.image)


def _assemble(path: Path, surfaces: list[Surface], about: dict[str, Any]) -> Scene:
    """The scene of a file; where it states no camera it stands 30 degrees above the middle and sees everything.

    Args:
        about: may state camera, target and background.
    """
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
    lower, upper = corners.min(0), corners.max(0)
    size, farthest = np.linalg.norm(upper - lower), np.abs(corners).max()
    if farthest * np.finfo(np.float32).eps > 1e-5 * size:
        raise RecordingError(
            f"{path} holds {size:.3g} m of surfaces {farthest:.3g} m away from the origin, too far for single "
            "precision; move them closer to it, in a scene file by position."
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
    about = read_json(path)
    _check_keys(about, str(path), ("parts", "camera", "target", "background", "light"))
    parts = about.get("parts")
    if not isinstance(parts, list) or not parts:
        raise RecordingError(f"{path} holds parts = {_shown(parts)}, but a list of at least one part was expected.")
    light = None if "light" in about and about["light"] is None else _numbers(about, "light", 3, str(path), LIGHT)
    if light is not None:
        if not light.any():
            raise RecordingError(f"{path} holds light = [0, 0, 0], which is no direction; null is for no light.")
        light = light / np.linalg.norm(light)
    library = _Library(path.parent, rng)
    pieces = [
        piece
        for number, part in enumerate(parts, 1)
        for piece in _read_part(path.parent, part, f"{path}, part {number},", library, notes)
    ]
    return _assemble(path, [_surface(piece, light) for piece in pieces], about)


def _read_part(folder: Path, part: Any, where: str, library: _Library, notes: list[str]) -> list[Piece]:
    if not isinstance(part, dict):
        raise RecordingError(f"{where} is {_shown(part)}, but a JSON object was expected.")
    _check_keys(part, where, ("shape", "size", "position", "rotation", "inward", "texture", "brightness"))
    shape, texture = part.get("shape"), part.get("texture")
    if not isinstance(shape, str):
        raise RecordingError(
            f"{where} holds shape = {_shown(shape)}, but box, ball, plane or a mesh's file was expected."
        )
    if shape in SHAPES:
        size = _numbers(part, "size", SHAPES[shape], where, np.ones(SHAPES[shape]), lowest=1e-6)
        pieces, texture = [_shape(shape, size)], "plain" if texture is None else texture
    elif not Path(shape).suffix:
        raise RecordingError(
            f"{where} holds shape = {_shown(shape)}, but box, ball, plane or a mesh's file was expected."
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
        raise RecordingError(f"{where} holds brightness, but no texture that it is of; add one or leave it out.")
    placed = np.eye(4)
    turn = _numbers(part, "rotation", 3, where, np.zeros(3))
    placed[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    placed[:3, 3] = _numbers(part, "position", 3, where, np.zeros(3))
    return [piece.moved(placed) for piece in pieces]


def _shape(shape: str, size: np.ndarray) -> Piece:
    """A box, a ball or a plane about the origin."""
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
    """An image file as uint8, or as float32 in [0, 1] of more than 8 bits."""
    image = load_image(file)
    return image if image.dtype == np.uint8 else image / np.float32(find_white_level((file,)))


class _Library:
    """The textures of a scene file; each is made once.

    Args:
        folder: that images are in.
        rng: draws the procedural ones.
    """

    def __init__(self, folder: Path, rng: np.random.Generator):
        self.folder, self.rng = folder, rng
        self.levels: dict[str, np.ndarray] = {}
        self.scaled: dict[tuple[str, float, float], np.ndarray] = {}

    def texture(self, name: Any, brightness: np.ndarray | None, where: str) -> tuple[np.ndarray, float | None]:
        """The image [size, size, channels] of a texture, and its extent as in `textures.Procedural`.

        Args:
            name: of a procedural texture or an image file.
            brightness: of zeros and ones [2]; None is what is usual for the texture.
            where: the part is, for the error.
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
    """Pieces with a texture instead of their own: along the sides of their bounding box."""
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
    unknown = [key for key in about if key not in known]
    if unknown:
        raise RecordingError(f"{where} holds {_shown(unknown[0])}, which is not known; it may hold {', '.join(known)}.")


def _numbers(
    about: dict[str, Any],
    key: str,
    count: int,
    where: str,
    default: ArrayLike | None = None,
    lowest: float = -1e6,
) -> Float[np.ndarray, " count"]:
    """So many numbers from `lowest` to a million, one of them without a list around it."""
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
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:80]} ..."


def _in_one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
