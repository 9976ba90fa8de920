"""Checks glTF files before trimesh reads them: whether all that they name is there, and what trimesh would misread.

trimesh 5.2 takes the integers of quantised and sparse arrays for coordinates, keeps the low 8 bits of colours of 16
bits without a material, ignores required extensions, and leaves out pictures that it cannot decode. It copies each view
and each accessor, follows nodes that have several parents, and its errors at a damaged file name neither the part of
the file nor the fault.

The specification of glTF 2.0: registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from enerf_ns.dataparsers.formats.json_values import Value, shown
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import parse_json, reading

LARGEST_HEADER = 2**26
"""Most bytes of the JSON of a file, in which whole buffers may be written as text."""

LARGEST_DATA = 2**28
"""Most bytes of all views, and of all accessors. Those of a usual file do not overlap."""

MOST_TRIANGLES = 2_000_000
"""Most triangles that nodes may place by repeating meshes."""

DEEPEST_NODE = 256
"""Most nodes above one another. trimesh follows all of them for each mesh."""

UNSIGNED_SHORT, FLOAT = 5123, 5126
"""Component types of whole numbers of 16 bits and of floating point numbers."""

TRIANGLES, FAN = 4, 6
"""Modes of triangles and of a fan of triangles."""

COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, UNSIGNED_SHORT: 2, 5125: 4, FLOAT: 4}
PARTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

DRACO = "KHR_draco_mesh_compression"


def check_gltf(path: Path, size_of: Callable[[str], int], notes: list[str]) -> int:
    """Refuses files that are damaged or that trimesh would misread, and returns how many pictures the triangles have.

    Args:
        path: The file, .gltf or .glb.
        size_of: Function that returns the number of bytes of another file that this one names.
        notes: Gets a sentence for each thing that is left out.

    Raises:
        RecordingError: The file is no glTF; something that it names is not in it; its nodes form no trees; or it needs
            an extension or a kind of numbers that is not read.
    """
    with reading(path, "glTF", LARGEST_DATA):
        return _check(*_read(path, size_of), notes)


def _check(header: Value, sizes: list[int], notes: list[str]) -> int:
    path = header.path
    required = [name.found for name in _items(header, "extensionsRequired")]
    if unread := [str(name) for name in required if not _is_read(name)]:
        raise RecordingError(f"{path} needs {', '.join(unread)}, which cannot be read; export it uncompressed.")
    _check_data(header, sizes)
    primitives = {i: mesh["primitives"].values() for i, mesh in enumerate(_items(header, "meshes"))}
    triangles = {i: sum(_triangles(header, primitive) for primitive in of_mesh) for i, of_mesh in primitives.items()}
    _check_nodes(header, triangles)
    pictures, fans, moved = [], False, False
    for primitive in (primitive for of_mesh in primitives.values() for primitive in of_mesh):
        fans |= primitive.found.get("mode") == FAN
        picture = _picture(header, primitive)
        if picture is not None:
            moved |= bool(picture.found.get("texCoord")) or "KHR_texture_transform" in picture.found.get(
                "extensions", {}
            )
            pictures.append(picture)
    if fans:
        notes.append(f"{path} holds fans of triangles, which are left out.")
    if moved:
        notes.append(f"{path} moves textures by KHR_texture_transform or has them at TEXCOORD_1, which is ignored.")
    textures = [_named(header, picture["index"], "textures").found for picture in pictures]
    return len({json.dumps([texture.get("source"), texture.get("extensions")]) for texture in textures})


def _read(path: Path, size_of: Callable[[str], int]) -> tuple[Value, list[int]]:
    """Returns the JSON of a file, and the number of bytes that are there of each buffer."""
    text, binary = path.read_bytes(), b""
    if text[:4] == b"glTF":
        _, stated, length = struct.unpack_from("<III", text, 4)
        text, binary = text[20 : 20 + length], text[28 + length :]
        there = 20 + len(text) + (8 + len(binary) if binary else 0)
        if there < max(stated, 20 + length):
            raise ValueError(f"it states {max(stated, 20 + length):,} bytes, of which {there:,} are there")
    if len(text) > LARGEST_HEADER:
        raise ValueError(f"it holds {len(text):,} bytes of text, but at most {LARGEST_HEADER:,} were expected")
    header = Value(path, parse_json(path, text.decode("utf-8-sig")))
    if not isinstance(header.found, dict):
        raise RecordingError(f"{path} holds a {type(header.found).__name__}, but a JSON object was expected.")
    sizes = []
    for buffer in _items(header, "buffers"):
        uri = buffer.get("uri")
        if uri is None:
            sizes.append(len(binary))
        elif not isinstance(uri.found, str):
            raise uri.wrong("the name of a file was")
        elif "base64," in uri.found:
            sizes.append(len(uri.found.partition("base64,")[2].rstrip("=")) * 3 // 4)
        else:
            sizes.append(size_of(uri.found))
    return header, sizes


def _is_read(extension: object) -> bool:
    """Whether trimesh reads an extension, or the extension changes nothing that is simulated."""
    if extension == DRACO:
        return find_spec("DracoPy") is not None
    harmless = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp")
    return isinstance(extension, str) and (extension.startswith("KHR_materials_") or extension in harmless)


def _check_data(header: Value, sizes: list[int]) -> None:
    """Checks that views lie within their buffers, and accessors within their views."""
    in_views, in_accessors = 0, 0
    for view in _items(header, "bufferViews"):
        _named(header, view["buffer"], "buffers")
        end = _whole(view, "byteOffset", 0) + _whole(view, "byteLength")
        _check_end(view, end, sizes[view.found["buffer"]])
        in_views += _whole(view, "byteLength")
    for accessor in _items(header, "accessors"):
        count, kind = _whole(accessor, "count"), accessor["componentType"].found
        if type(kind) is not int or kind not in COMPONENT_BYTES:
            raise accessor["componentType"].wrong(f"one of {', '.join(map(str, COMPONENT_BYTES))} was")
        item = COMPONENT_BYTES[kind] * PARTS[accessor["type"].choice(PARTS)]
        in_accessors += count * item
        if accessor.get("bufferView") is not None:
            view = _named(header, accessor["bufferView"], "bufferViews")
            stride = _whole(view, "byteStride", item) or item
            end = _whole(accessor, "byteOffset", 0) + ((count - 1) * stride + item if count else 0)
            _check_end(accessor, end, _whole(view, "byteLength"))
    if max(in_views, in_accessors) > LARGEST_DATA:
        raise RecordingError(
            f"{header.path} holds views or accessors of {max(in_views, in_accessors):,} bytes, but at most "
            f"{LARGEST_DATA:,} were expected; export parts of it."
        )


def _check_end(of: Value, end: int, size: int) -> None:
    if end > size:
        raise RecordingError(
            f"{of.place} reaches to byte {end:,} of {size:,} that are there; copy the file in full or export it again."
        )


def _triangles(header: Value, primitive: Value) -> int:
    """Returns the number of triangles of a primitive, or of a third of its vertices, after checking what it names."""
    attributes = primitive["attributes"]
    if not isinstance(attributes.found, dict):
        raise attributes.wrong("an object was")
    accessors = {name: _named(header, attributes[name], "accessors") for name in attributes.found}
    coordinates = [accessors[name] for name in ("POSITION", "TEXCOORD_0") if name in accessors]
    is_coded = any("sparse" in accessor.found or accessor.found["componentType"] != FLOAT for accessor in coordinates)
    if is_coded:
        raise RecordingError(
            f"{header.path} holds positions or texture coordinates that are sparse or not floating point, which cannot "
            "be read; export it without quantization."
        )
    colours = accessors.get("COLOR_0")
    if colours is not None and colours.found["componentType"] == UNSIGNED_SHORT and primitive.get("material") is None:
        raise RecordingError(
            f"{header.path} holds colours of vertices in 16 bits without a material, which cannot be read; give the "
            "mesh a material, or its colours 8 bits."
        )
    mode = primitive.found.get("mode", TRIANGLES)
    indices = primitive.get("indices")
    corners = None if indices is None else _named(header, indices, "accessors")
    used = [*coordinates, *([corners] if corners else [])]
    if DRACO not in primitive.found.get("extensions", {}):
        for accessor in used:
            accessor["bufferView"]
    position = _named(header, attributes["POSITION"], "accessors")
    if position.found["type"] != "VEC3":
        raise position["type"].wrong("VEC3 was")
    number = (corners or position).found["count"]
    if mode == TRIANGLES and number % 3:
        raise (corners or position)["count"].wrong("a multiple of 3, for triangles, was")
    return max(number if mode != TRIANGLES else number // 3, position.found["count"] // 3)


def _picture(header: Value, primitive: Value) -> Value | None:
    """Returns baseColorTexture of the material of a primitive, if it has one, after checking what it names."""
    if primitive.get("material") is None:
        return None
    roughness = _named(header, primitive["material"], "materials").get("pbrMetallicRoughness")
    picture = None if roughness is None else roughness.get("baseColorTexture")
    if picture is not None:
        texture = _named(header, picture["index"], "textures")
        if texture.get("source") is not None:
            image = _named(header, texture["source"], "images")
            if image.get("bufferView") is not None:
                _named(header, image["bufferView"], "bufferViews")
    return picture


def _check_nodes(header: Value, triangles: dict[int, int]) -> None:
    """Checks that nodes form trees that are not too deep, that they are placed by finite numbers, and what they place.

    Args:
        header: The JSON of the file.
        triangles: Number of triangles of each mesh.
    """
    nodes = _items(header, "nodes")
    parent: dict[int, int] = {}
    placed = 0
    for number, node in enumerate(nodes):
        for child in _items(node, "children"):
            _named(header, child, "nodes")
            if child.found in parent:
                raise RecordingError(
                    f"{header.path} names nodes[{child.found}] twice as a child, in nodes[{parent[child.found]}] and "
                    f"in nodes[{number}], but a node has one parent in glTF; export it again."
                )
            parent[child.found] = number
        if node.get("mesh") is not None:
            _named(header, node["mesh"], "meshes")
            placed += triangles[node.found["mesh"]]
        for name, count in (("matrix", 16), ("translation", 3), ("rotation", 4), ("scale", 3)):
            if (value := node.get(name)) is not None:
                value.numbers((count,), f"{count} numbers were")
    if placed > max(MOST_TRIANGLES, sum(triangles.values())):
        raise RecordingError(
            f"{header.path} places {placed:,} triangles by repeating its meshes, but at most {MOST_TRIANGLES:,} were "
            "expected; export parts of it."
        )
    level, depth, found = [number for number in range(len(nodes)) if number not in parent], 0, 0
    children: dict[int, list[int]] = {}
    for child, of in parent.items():
        children.setdefault(of, []).append(child)
    while level and depth <= DEEPEST_NODE:
        found, depth = found + len(level), depth + 1
        level = [child for number in level for child in children.get(number, [])]
    if found < len(nodes):
        fault = f"more than {DEEPEST_NODE} nodes above one another" if level else "nodes that are above themselves"
        raise RecordingError(f"{header.path} holds {fault}, but trees of nodes were expected; export it again.")
    for scene in _items(header, "scenes"):
        for root in _items(scene, "nodes"):
            _named(header, root, "nodes")
            if root.found in parent:
                raise RecordingError(
                    f"{root.place} is nodes[{root.found}], which has a parent, but the roots of a scene have none in "
                    "glTF; export it again."
                )
    if header.get("scene") is not None:
        _named(header, header["scene"], "scenes")


def _items(value: Value, key: str) -> list[Value]:
    """Returns the items of a list, or none where it is missing."""
    found = value.get(key)
    return [] if found is None else found.values()


def _named(header: Value, number: Value, kind: str) -> Value:
    """Returns the item of a list that a value names by its number."""
    items = header.found.get(kind)
    count = len(items) if isinstance(items, list) else 0
    if type(number.found) is not int or not 0 <= number.found < count:
        raise RecordingError(
            f"{number.path} names {kind}[{shown(number.found)}] in {number.name}, but holds {count:,} {kind}; copy it "
            "in full or export it again."
        )
    item = header[kind][number.found]
    if not isinstance(item.found, dict):
        raise item.wrong("an object was")
    return item


def _whole(value: Value, key: str, default: int | None = None) -> int:
    """Returns the whole number under a key."""
    if default is not None and value.get(key) is None:
        return default
    number = value[key]
    if type(number.found) is not int or not 0 <= number.found < 2**53:
        raise number.wrong("a whole number from 0 on was")
    return number.found
