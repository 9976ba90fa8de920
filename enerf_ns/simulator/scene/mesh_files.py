"""Scenes from mesh files.

The file may be of any format that trimesh loads: glTF (.glb, .gltf), .obj with .mtl, .ply, .stl, .off, .dae, .3mf and
others; trimesh needs further packages for some of them. All meshes of the file are taken, each where the file's scene
graph places it. Units are metres, and z is up. In glTF y is up by definition, so y is turned to z.

The picture of a material (baseColorTexture, map_Kd, TextureFile) is converted from sRGB to linear brightness and
stretched to a square of a power of two of at most 2048 texels. It repeats outside of [0, 1]. In glTF it is multiplied
by baseColorFactor and COLOR_0. A mesh without texture coordinates shows the colours of its vertices or faces (linear in
glTF, sRGB elsewhere), or else the colour of its material, or else a grey of 0.8; a note tells the user so. Transparency
and all other properties of materials are ignored. Surfaces are diffuse (see `scenes.diffuse_light`).
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from jaxtyping import Float, Float32, UInt8
from numpy.typing import ArrayLike
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual.material import PBRMaterial

from enerf_ns.dataparsers.recording.errors import RecordingError, UserError
from enerf_ns.simulator.scene import textures
from enerf_ns.simulator.scene.scenes import Scene, Surface, build_scene, corner_normals, diffuse_light, doubled_areas
from enerf_ns.simulator.sources import linear_from_srgb, linear_picture

LARGEST_TEXTURE = 2048
"""Most texels along one side of a texture. It is halved, once or more, for files with more than eight pictures."""

IMAGES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".tga", ".gif"}

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Pose that turns the axes of glTF, whose y is up, to axes whose z is up."""

GLTF_FLOAT = 5126
"""Component type of floating point numbers in glTF."""


def load_scene(path: Path, notes: list[str]) -> Scene:
    """The scene of a mesh file; its camera stands 30 degrees above the middle of the meshes and sees all of them.

    Args:
        path: Mesh file.
        notes: Gets a sentence for each thing that is left out or shown differently than a user may expect.

    Returns:
        A scene of one channel where everything is grey, else of three.

    Raises:
        RecordingError: The file, or a file that it names, is missing or cannot be read; or the meshes have no faces,
            or lie too far from the origin.
    """
    surfaces = read_mesh(path, notes)
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
    lower, upper = corners.min(0), corners.max(0)
    size, farthest = np.linalg.norm(upper - lower), np.abs(corners).max()
    if farthest * np.finfo(np.float32).eps > 1e-5 * size:
        raise RecordingError(
            f"{path} holds {size:.3g} m of surfaces {farthest:.3g} m away from the origin, too far for single "
            "precision; move them closer to it."
        )
    target = (lower + upper) / 2
    camera = target + size * np.array([0, -np.cos(np.pi / 6), np.sin(np.pi / 6)])
    return build_scene(surfaces, camera, target)


def read_mesh(path: Path, notes: list[str]) -> list[Surface]:
    """All surfaces of a mesh file, where its scene graph places them, lit, z up.

    Args:
        path: Mesh file.
        notes: As for `load_scene`.

    Raises:
        RecordingError: The file, or a file that it names, is missing or cannot be read, or there are no faces.
    """
    if not path.is_file():
        raise RecordingError(
            f"{path} is {'a folder' if path.is_dir() else 'missing'}; the file of a mesh was expected."
        )
    kind = path.suffix.lower().lstrip(".")
    if kind not in trimesh.available_formats():
        raise RecordingError(
            f"{path} is of a type that trimesh does not load with the packages that are installed; give a .glb, .gltf, "
            ".obj, .ply, .stl or .off file."
        )
    is_gltf = kind in ("glb", "gltf")
    expected = _check_gltf(path, notes) if is_gltf else 0
    files, surfaces = _Files(path), []
    try:
        with _without_warnings():
            graph: Any = trimesh.load(str(path), resolver=files, process=False, force="scene")
            if not files.fault:
                surfaces = _surfaces(path, graph, is_gltf, expected, notes)
    except UserError:
        raise
    except ImportError as error:
        raise RecordingError(f"{path} needs a package that is not installed: {_in_one_line(error)}.") from error
    except Exception as error:  # of any kind: trimesh raises other ones for damaged files of each format
        if not files.fault:
            raise RecordingError(
                f"{path} cannot be read as a mesh ({_in_one_line(error)}); copy it in full or export it again."
            ) from error
    if files.fault:
        raise RecordingError(f"{path} names {files.fault}; put it there or take its name out of {path.name}.")
    if not surfaces:
        raise RecordingError(f"{path} holds no mesh with faces; give one with at least one triangle.")
    total = sum(len(surface.triangles) for surface in surfaces)
    declared = _declared_faces(path) if kind == "ply" else 0
    if total < declared:
        raise RecordingError(f"{path} holds {total} faces, but its header says {declared}; copy it in full.")
    surfaces = [surface for surface in map(_with_area, surfaces) if len(surface.triangles)]
    kept = sum(len(surface.triangles) for surface in surfaces)
    if not kept:
        raise RecordingError(f"{path} holds {total} triangles, but none of them has an area; export it again.")
    if kept < total:
        notes.append(f"{path} holds {total - kept} triangles without an area, which are left out; {kept} are used.")
    return surfaces


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
        self.folder = path.parent
        self.fault = ""
        """The first file that is missing or cannot be read as an image; empty if there is none."""

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
        except Exception:  # of any kind: Pillow raises other ones for damaged files of each format
            self.fault = self.fault or f"{place}, which cannot be read as an image"
            raise


def _check_gltf(path: Path, notes: list[str]) -> int:
    """Refuses glTF files that trimesh reads wrongly without an error, and returns how many pictures the triangles have.

    trimesh 5.2 takes the integers of quantised and sparse arrays for coordinates, ignores required extensions, and
    leaves out pictures that it cannot decode.
    """
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
    if moved:
        notes.append(f"{path} moves textures by KHR_texture_transform or has them at TEXCOORD_1, which is ignored.")
    return len(sources)


def _is_read(extension: str) -> bool:
    """Whether trimesh reads a glTF extension, or the extension changes nothing that is simulated."""
    if extension == "KHR_draco_mesh_compression":
        return find_spec("DracoPy") is not None
    harmless = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp")
    return extension.startswith("KHR_materials_") or extension in harmless


def _surfaces(path: Path, graph: trimesh.Scene, is_gltf: bool, expected: int, notes: list[str]) -> list[Surface]:
    """The meshes of a scene graph, where it places them; a note for each substitute of a texture.

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
    images = {key: _linear_image(_pixels(picture), largest) for key, picture in pictures.items()}
    surfaces, substitutes = [], Counter[str]()
    for matrix, mesh in placed:
        moved = mesh.copy(include_cache=True, include_visual=False)
        moved.apply_transform(Z_UP @ matrix if is_gltf else matrix)
        uv, colour, image, substitute = _appearance(mesh, moved.faces, images, is_gltf)
        shade = colour * diffuse_light(corner_normals(moved))
        surfaces.append(Surface(np.asarray(moved.triangles, np.float64), uv, shade, image))
        substitutes[substitute] += 1
    del substitutes[""]
    notes.extend(f"{path} has {what} (in {count} of {len(placed)} meshes)." for what, count in substitutes.items())
    return surfaces


def _appearance(
    mesh: trimesh.Trimesh, faces: np.ndarray, images: dict[int, np.ndarray], is_gltf: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Texture coordinates, colours, texture of a mesh, and what it shows in place of a texture that it lacks.

    Args:
        mesh: With at least one face.
        faces: Vertices of each face [faces, 3]: those of the mesh, but in reverse order where it is mirrored.
        images: Linear brightness of each picture, by its id.
        is_gltf: Whether colours are linear, as in glTF, else sRGB.

    Returns:
        Texture coordinates [faces, 3, 2] and colours [faces, 3, channels] of corners, the texture [size, size,
        channels], and the end of a sentence, which is empty if the mesh lacks nothing.
    """
    visual: Any = mesh.visual
    substitute = "neither a texture nor colours and is shown in grey"
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
            substitute = "no texture coordinates and shows the colours of its materials" if lacks_coordinates else ""
    elif visual.kind in ("vertex", "face"):
        colour = _fractions(visual.vertex_colors[faces] if visual.kind == "vertex" else visual.face_colors[:, None])
        colour = colour if is_gltf else linear_from_srgb(colour)
        of_what = "vertices" if visual.kind == "vertex" else "faces"
        substitute = f"no texture coordinates and shows the colours of its {of_what}"
    colour = np.full(1, 0.8) if colour is None else _one_or_three(colour)
    return uv, np.broadcast_to(colour, (*faces.shape, colour.shape[-1])), image, substitute


def _picture(mesh: Any) -> Image.Image | None:
    """Picture of the material of a mesh, if it has one."""
    material = getattr(getattr(mesh, "visual", None), "material", None)
    return getattr(material, "baseColorTexture", getattr(material, "image", None))


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


def _linear_image(
    picture: UInt8[np.ndarray, "height width channels"], largest: int
) -> Float32[np.ndarray, "size size channels"]:
    """Linear brightness of an sRGB picture, stretched to a square.

    The side of the square is the next power of two from the longer side of the picture on, but at most `largest`.
    """
    size = min(largest, 1 << (max(picture.shape[:2]) - 1).bit_length())
    return textures.square(linear_picture(_one_or_three(picture)), size)


def _with_area(surface: Surface) -> Surface:
    """The surface without triangles that are a line or a point, or that have numbers that are not finite."""
    longest = np.linalg.norm(surface.triangles - np.roll(surface.triangles, 1, axis=1), axis=2).max(1)
    with np.errstate(invalid="ignore"):
        kept = (doubled_areas(surface.triangles) > 1e-7 * longest**2) & np.isfinite(surface.uv).all((1, 2))
    return replace(surface, **{name: getattr(surface, name)[kept] for name in ("triangles", "uv", "shade")})


def _in_one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
