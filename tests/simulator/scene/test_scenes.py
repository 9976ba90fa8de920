"""Scenes and textures against closed forms, slow loops, and files written by hand with pictures that are known."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.simulator.scene import textures
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scene_files import load_scene
from enerf_ns.simulator.scene.scenes import SCENES, Scene, Surface, build_scene, corner_normals

RNG = np.random.default_rng

COLOURS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [200, 120, 40]]], np.uint8)
"""A picture of 2 x 2 colours, so that a mirrored or turned one is recognised."""

QUAD = np.array([[-1.0, 0.5], [1, 0.5], [1, -0.5], [-1, -0.5]])
"""To the right and upwards in metres: top left, top right, bottom right, bottom left."""

FORWARD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""Pose of a camera at the origin that looks along y, with z upwards."""

UNLIT = {"light": None}


def to_linear(value: float) -> float:
    """The sRGB transfer function as IEC 61966-2-1 has it."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def load(path: Path, seed: int = 0) -> tuple[Scene, list[str]]:
    notes: list[str] = []
    return load_scene(path, RNG(seed), notes), notes


def write_picture(path: Path, scale: int = 32) -> None:
    Image.fromarray(np.kron(COLOURS, np.ones((scale, scale, 1), np.uint8))).save(path)


def write_obj(folder: Path) -> Path:
    """A standing quad 2 m away, whose top row of the picture is v = 1."""
    write_picture(folder / "picture.png")
    (folder / "quad.mtl").write_text("newmtl painted\nKd 0.3 0.3 0.3\nmap_Kd picture.png\n")
    (folder / "quad.obj").write_text(
        "mtllib quad.mtl\nusemtl painted\n"
        + "".join(f"v {x} 2 {z}\n" for x, z in QUAD)
        + "vt 0 1\nvt 1 1\nvt 1 0\nvt 0 0\nf 1/1 4/4 3/3\nf 1/1 3/3 2/2\n"
    )
    return folder / "quad.obj"


def write_ply(folder: Path) -> Path:
    write_picture(folder / "picture.png")
    rows = "".join(
        f"{x} 2 {z} {s} {t}\n" for (x, z), (s, t) in zip(QUAD, [(0, 1), (1, 1), (1, 0), (0, 0)], strict=True)
    )
    (folder / "quad.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile picture.png\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nelement face 2\nproperty list uchar int vertex_indices\n"
        f"end_header\n{rows}3 0 3 2\n3 0 2 1\n"
    )
    return folder / "quad.ply"


def gltf(positions: np.ndarray, faces: list[list[int]], **attributes: np.ndarray) -> dict[str, Any]:
    """A glTF file of one mesh with one node, its numbers within it."""
    arrays = [("POSITION", positions), *attributes.items()]
    blobs = [np.asarray(array, "<f4").tobytes() for _, array in arrays] + [np.asarray(faces, "<u4").tobytes()]
    starts = np.cumsum([0, *map(len, blobs)]).tolist()
    kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
    accessors = [
        {"bufferView": k, "componentType": 5126, "count": len(array), "type": kinds[array.shape[1]]}
        for k, (_, array) in enumerate(arrays)
    ]
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    indices = {"bufferView": len(arrays), "componentType": 5125, "count": 3 * len(faces), "type": "SCALAR"}
    primitive = {"attributes": {name: k for k, (name, _) in enumerate(arrays)}, "indices": len(arrays)}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [*accessors, indices],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(blob)}
            for start, blob in zip(starts[:-1], blobs, strict=True)
        ],
        "buffers": [
            {
                "byteLength": starts[-1],
                "uri": "data:application/octet-stream;base64," + base64.b64encode(b"".join(blobs)).decode(),
            }
        ],
    }


def gltf_quad() -> dict[str, Any]:
    """The quad of `write_obj` in the axes of glTF, whose y is up and whose v is downwards."""
    positions = np.column_stack([QUAD, np.full(4, -2.0)])
    about = gltf(positions, [[0, 3, 2], [0, 2, 1]], TEXCOORD_0=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
    about["meshes"][0]["primitives"][0]["material"] = 0
    about["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    about["textures"], about["images"] = [{"source": 0}], [{"uri": "picture.png"}]
    return about


def write_gltf(folder: Path) -> Path:
    write_picture(folder / "picture.png")
    (folder / "quad.gltf").write_text(json.dumps(gltf_quad()))
    return folder / "quad.gltf"


def write_glb(folder: Path) -> Path:
    """The same in the binary container."""
    write_picture(folder / "picture.png")
    text = json.dumps(gltf_quad()).encode()
    text += b" " * (-len(text) % 4)
    sizes = [(20 + len(text)).to_bytes(4, "little"), len(text).to_bytes(4, "little")]
    (folder / "quad.glb").write_bytes(b"glTF\2\0\0\0" + sizes[0] + sizes[1] + b"JSON" + text)
    return folder / "quad.glb"


def write_scene(folder: Path, *parts: dict[str, Any], **about: Any) -> Path:
    (folder / "scene.json").write_text(json.dumps({"parts": parts, **about}))
    return folder / "scene.json"


def write_plane_with_picture(folder: Path) -> Path:
    write_picture(folder / "picture.png")
    wall = {"shape": "plane", "size": [2, 1], "position": [0, 2, 0], "rotation": [90, 0, 0], "texture": "picture.png"}
    return write_scene(folder, wall, **UNLIT)


@pytest.mark.parametrize("write", [write_obj, write_ply, write_gltf, write_glb, write_plane_with_picture])
def test_a_picture_is_seen_upright_and_in_linear_brightness(tmp_path, write):
    scene, notes = load(write(tmp_path))
    seen = Renderer(scene, Camera(40, 20, 40.0, 40.0, 19.5, 9.5)).brightness(FORWARD)
    light = 1.0 if write is write_plane_with_picture else 0.7 + 0.3 * 0.7 / np.sqrt(0.4**2 + 0.7**2 + 0.6**2)
    for row, column in np.ndindex(2, 2):
        expected = [light * to_linear(value / 255) for value in COLOURS[row, column].tolist()]
        inside = seen[10 * row + 2 : 10 * row + 8, 20 * column + 2 : 20 * column + 18]
        np.testing.assert_allclose(inside, np.broadcast_to(expected, inside.shape), atol=1e-5)
    assert scene.channels == 3 and not notes
    np.testing.assert_allclose(scene.texels_per_metre, 64 / np.sqrt(2), rtol=1e-6)


def test_surfaces_become_one_scene_with_texels_per_metre_and_shared_textures():
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 0.5, 0]])[None]
    stretched = corners[..., :2] * (2, 2)  # 4 x 1 textures on 2 m x 0.5 m
    checks, colour = np.ones((64, 64, 1)), np.full((16, 16, 3), 0.5)
    surfaces = [
        Surface(corners, stretched, np.ones((1, 3, 1)), checks),
        Surface(corners + 1, stretched, np.full((1, 3, 3), (0.1, 0.2, 0.3)), colour),
        Surface(corners + 2, np.zeros((1, 3, 2)), np.ones((1, 3, 1)), textures.plain()[..., None]),
        Surface(corners + 3, stretched, np.ones((1, 3, 1)), checks),
    ]
    scene = build_scene(surfaces, (0, -1, 0), (0, 0, 0), 0.25)
    assert scene.channels == 3 and scene.background == 0.25
    np.testing.assert_array_equal(scene.texture, [0, 1, 2, 0])
    np.testing.assert_array_equal(scene.texture_size, [64, 16, 1])
    np.testing.assert_array_equal(scene.texture_start, [0, 5461, 5461 + 341])
    np.testing.assert_allclose(scene.texels_per_metre, [128, 32, 0, 128])
    np.testing.assert_allclose(scene.shade[:, 0], [[1, 1, 1], [0.1, 0.2, 0.3], [1, 1, 1], [1, 1, 1]])
    assert scene.texels.shape == (5461 + 341 + 1, 3)


def test_a_grey_camera_sees_the_luma_of_a_coloured_texture():
    image = RNG(0).uniform(size=(4, 4, 3))
    shade = RNG(1).uniform(size=(1, 3, 1))
    scene = build_scene([Surface(np.eye(3)[None], np.eye(3)[None, :, :2], shade, image)], (0, -1, 0), (0, 0, 0))
    grey = scene.grey()
    assert grey.channels == 1 and grey.grey() is grey
    luma = 0.299 * image[..., 0] + 0.587 * image[..., 1] + 0.114 * image[..., 2]
    np.testing.assert_allclose(grey.texels[:16, 0], luma.ravel(), rtol=1e-5)
    np.testing.assert_allclose(grey.shade, shade, rtol=1e-5)


def test_nodes_of_a_graph_are_placed_by_all_that_is_above_them(tmp_path):
    corners = np.array([[0.0, 0, 0], [1, 0, 0.2], [0, 1, -0.3]])
    about = gltf(corners, [[0, 1, 2]])
    turn, tilt = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]), Rotation.from_euler("x", 0.7)
    about["nodes"] = [
        {"children": [1, 2], "translation": [1, 2, 3], "rotation": turn.as_quat().tolist()},
        {"mesh": 0, "scale": [2, 0.5, 3], "translation": [0, 0.1, 0]},
        {"mesh": 0, "rotation": tilt.as_quat().tolist()},
    ]
    (tmp_path / "tree.gltf").write_text(json.dumps(about))
    scene, (note,) = load(tmp_path / "tree.gltf")
    below = [corners * (2, 0.5, 3) + np.array([0, 0.1, 0]), tilt.apply(corners)]
    placed = [turn.apply(child) + np.array([1, 2, 3]) for child in below]
    expected = np.array([[[x, -z, y] for x, y, z in triangle] for triangle in placed])
    order = np.argsort(scene.triangles[:, 1, 0] != np.float32(expected[0, 1, 0]), kind="stable")
    np.testing.assert_allclose(scene.triangles[order], expected, atol=1e-6)
    normals = np.cross(expected[:, 1] - expected[:, 0], expected[:, 2] - expected[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = np.array([-0.4, -0.7, 0.6]) / np.sqrt(0.4**2 + 0.7**2 + 0.6**2)
    grey = 0.8 * (0.7 + 0.3 * np.maximum(normals @ light, 0))
    np.testing.assert_allclose(scene.shade[order][..., 0], np.repeat(grey[:, None], 3, 1), atol=1e-6)
    assert scene.channels == 1 and "(in 2 of 2 meshes)" in note


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{vertex}"
    "element face 1\nproperty list uchar int vertex_indices\n{face}end_header\n{rows}"
)

RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


def lightless(scene: Scene) -> np.ndarray:
    """Colours of the corners of the first triangle, by the light on them, which has to be the same for all."""
    corners = scene.triangles[0].astype(float)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    light = np.array([-0.4, -0.7, 0.6]) / np.sqrt(0.4**2 + 0.7**2 + 0.6**2)
    return scene.shade[0] / (0.7 + 0.3 * max(normal / np.linalg.norm(normal) @ light, 0))


def test_without_texture_coordinates_the_colours_of_vertices_are_shown(tmp_path):
    colours = [[255, 128, 0], [10, 20, 30], [200, 200, 50]]
    rows = "".join(f"{x} 2 {z} {r} {g} {b}\n" for (x, z), (r, g, b) in zip(QUAD[:3], colours, strict=True))
    (tmp_path / "a.ply").write_text(PLY.format(vertex=RGB, face="", rows=rows + "3 0 2 1\n"))
    scene, (note,) = load(tmp_path / "a.ply")
    assert "no texture coordinates and shows the colours of its vertices" in note
    expected = [[to_linear(value / 255) for value in colours[index]] for index in (0, 2, 1)]
    np.testing.assert_allclose(lightless(scene), expected, atol=1e-6)
    assert scene.texture_size.tolist() == [1] and scene.texels.tolist() == [[1.0, 1.0, 1.0]]


def test_without_texture_coordinates_the_colours_of_faces_are_shown(tmp_path):
    rows = "".join(f"{x} 2 {z}\n" for x, z in QUAD[:3]) + "3 0 2 1 90 90 90\n"
    (tmp_path / "a.ply").write_text(PLY.format(vertex="", face=RGB, rows=rows))
    scene, (note,) = load(tmp_path / "a.ply")
    assert "no texture coordinates and shows the colours of its faces" in note
    assert scene.channels == 1
    np.testing.assert_allclose(lightless(scene), to_linear(90 / 255), atol=1e-6)


def test_colours_of_gltf_are_linear_and_multiplied(tmp_path):
    colours = np.array([[1.0, 0.5, 0.25], [0.1, 0.2, 0.3], [1, 1, 1]])
    about = gltf(np.column_stack([QUAD[:3], np.zeros(3)]), [[0, 2, 1]], COLOR_0=colours)
    about["meshes"][0]["primitives"][0]["material"] = 0
    about["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}}]
    (tmp_path / "a.gltf").write_text(json.dumps(about))
    scene, notes = load(tmp_path / "a.gltf")
    np.testing.assert_allclose(lightless(scene), colours[[0, 2, 1]] * (0.2, 0.4, 0.6), atol=1e-6)
    assert not notes


def test_colours_of_16_bits_are_read_with_a_material_and_refused_without(tmp_path):
    levels = np.array([[0.5, 0.25, 0.5], [0.003, 0.002, 0.003], [1, 1, 1]])
    about = gltf(np.column_stack([QUAD[:3], np.zeros(3)]), [[0, 2, 1]], COLOR_0=levels)
    numbers = np.pad(np.round(65535 * levels), ((0, 0), (0, 3))).astype("<u2").tobytes()  # 12 bytes, as three floats
    blob = bytearray(base64.b64decode(about["buffers"][0]["uri"].partition("base64,")[2]))
    blob[36:72] = numbers
    about["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    about["accessors"][1] |= {"componentType": 5123, "normalized": True}
    about["bufferViews"][1]["byteStride"] = 12
    (tmp_path / "a.gltf").write_text(json.dumps(about))
    with pytest.raises(RecordingError, match="colours of vertices in 16 bits without a material"):
        load(tmp_path / "a.gltf")
    about["meshes"][0]["primitives"][0]["material"] = 0
    about["materials"] = [{"pbrMetallicRoughness": {}}]
    (tmp_path / "a.gltf").write_text(json.dumps(about))
    scene, _ = load(tmp_path / "a.gltf")
    np.testing.assert_allclose(lightless(scene), levels[[0, 2, 1]], atol=1e-4)


def test_a_mesh_without_anything_is_grey_and_a_note_says_so(tmp_path):
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 2 0\n1 2 0\n0 2 1\n3 0 1 2\n")
    scene, (note,) = load(tmp_path / "a.off")
    assert "neither a texture nor colours" in note
    np.testing.assert_allclose(lightless(scene), 0.8, atol=1e-6)


def test_each_material_of_an_obj_has_its_picture_or_its_colour(tmp_path):
    Image.new("RGB", (4, 4), (188, 188, 188)).save(tmp_path / "a.png")
    Image.new("RGB", (16, 16), (99, 0, 0)).save(tmp_path / "b c.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b c.png\nnewmtl c\nKd 0.2 0.4 0.6\n")
    faces = "".join(f"usemtl {name}\nf {k}/1 {k + 1}/2 {k + 2}/3\n" for name, k in (("a", 1), ("b", 4), ("c", 7)))
    vertices = "".join(f"v {3 * k} 2 0\nv {3 * k + 1} 2 0\nv {3 * k} 2 1\n" for k in range(3))
    (tmp_path / "m.obj").write_text(f"mtllib m.mtl\n{vertices}vt 0 0\nvt 1 0\nvt 0 1\n{faces}")
    scene, notes = load(tmp_path / "m.obj")
    assert not notes
    light = 0.7 + 0.3 * 0.7 / np.sqrt(0.4**2 + 0.7**2 + 0.6**2)
    expected = {0: [to_linear(188 / 255)] * 3, 3: [to_linear(99 / 255), 0, 0], 6: [0.2, 0.4, 0.6]}
    sizes = {0: 4, 3: 16, 6: 1}
    for face in range(3):
        place = round(float(scene.triangles[face, :, 0].min()))
        start = scene.texture_start[scene.texture[face]]
        seen = scene.shade[face, 0] * scene.texels[start]
        np.testing.assert_allclose(seen, light * np.array(expected[place]), atol=1e-3)
        assert scene.texture_size[scene.texture[face]] == sizes[place]


def test_triangles_without_an_area_are_left_out_with_a_note(tmp_path):
    rows = ["0 2 0", "1 2 0", "0 2 1", "2 2 0", "nan 2 1"]
    faces = ["3 0 1 2", "3 0 1 3", "3 1 1 2", "3 0 1 4"]
    (tmp_path / "a.off").write_text("\n".join(["OFF", "5 4 0", *rows, *faces]))
    scene, notes = load(tmp_path / "a.off")
    assert len(scene.triangles) == 1 and "3 triangles without an area" in notes[-1]


def test_normals_are_those_of_the_faces_at_sharp_edges_and_smooth_elsewhere():
    import trimesh

    box, ball = trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(3, 2.0)
    np.testing.assert_allclose(corner_normals(box), np.repeat(box.face_normals[:, None], 3, 1), atol=1e-9)
    np.testing.assert_allclose(corner_normals(ball), ball.triangles / 2, atol=0.01)


def test_parts_stand_where_the_scene_file_puts_them(tmp_path):
    write_obj(tmp_path)
    path = write_scene(
        tmp_path,
        {"shape": "box", "size": [0.2, 0.4, 0.6], "position": [1, 2, 3], "rotation": [20, -30, 50]},
        {"shape": "ball", "size": 0.5, "position": [-1, 4, 0], "texture": "clouds", "brightness": [0.2, 0.7]},
        {"shape": "plane", "size": [4, 3], "rotation": [0, 0, 90], "texture": "page"},
        {"shape": "quad.obj", "size": 0.5, "position": [0, 0, 9], "rotation": [0, 0, 180]},
        camera=[0, -3, 1],
        target=[0, 1, 0.5],
        background=0.4,
    )
    scene, notes = load(path)
    assert not notes and scene.background == 0.4 and scene.channels == 3
    np.testing.assert_array_equal([scene.camera, scene.target], [[0, -3, 1], [0, 1, 0.5]])
    box, ball, plane, quad = (scene.triangles[scene.texture == k] for k in range(4))
    corners = np.array(np.meshgrid([-0.1, 0.1], [-0.2, 0.2], [-0.3, 0.3])).reshape(3, -1).T
    corners = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).apply(corners) + np.array([1, 2, 3])
    distances = np.linalg.norm(box.reshape(-1, 1, 3) - corners, axis=2)
    assert distances.min(1).max() < 1e-5 and distances.min(0).max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(ball - (-1, 4, 0), axis=2), 0.25, atol=1e-5)
    np.testing.assert_allclose([plane.min((0, 1)), plane.max((0, 1))], [[-1.5, -2, 0], [1.5, 2, 0]], atol=1e-6)
    np.testing.assert_allclose(quad.min((0, 1)), [-0.25, -0.5, 8.875], atol=1e-6)
    np.testing.assert_allclose(quad.max((0, 1)), [0.25, -0.5, 9.125], atol=1e-6)
    clouds = scene.texels[scene.texture_start[1] :][: 1024**2]
    np.testing.assert_allclose([clouds.min(), clouds.max()], [0.2, 0.7], atol=1e-6)
    np.testing.assert_allclose(scene.texels_per_metre[scene.texture == 2], 2048 / np.sqrt(12), rtol=1e-6)
    np.testing.assert_allclose(scene.texels[scene.texture_start[0]], 0.9)


def test_an_inward_part_looks_inwards_and_light_falls_on_its_inside(tmp_path):
    box = {"shape": "box", "size": [4, 4, 4], "texture": "plain", "brightness": [1, 1]}
    about = {"camera": [0, 0, 0], "target": [0, 1, 0], "light": [0, 0, 1]}
    volumes, floors = [], []
    for inward in (False, True):
        path = tmp_path / f"{inward}.json"
        path.write_text(json.dumps({"parts": [{**box, "inward": inward}], **about}))
        scene, _ = load(path)
        volumes.append(np.linalg.det(scene.triangles).sum() / 6)
        floors.append(scene.shade[(scene.triangles[..., 2] < -1.9).all(1)])
    np.testing.assert_allclose(volumes, [64, -64], rtol=1e-6)
    assert (floors[1] > 0.99).all() and (floors[0] < 0.71).all()


def test_a_scene_file_without_a_camera_is_looked_at_from_above_and_all_is_seen(tmp_path):
    parts = ({"shape": "box", "position": [x, y, 0.5]} for x in (-2, 2) for y in (3, 7))
    scene, _ = load(write_scene(tmp_path, *parts))
    np.testing.assert_allclose(scene.target, [0, 5, 0.5], atol=1e-6)
    offset = scene.camera - scene.target
    assert offset[0] == 0 and offset[1] < 0 < offset[2]
    forward = -offset / np.linalg.norm(offset)
    rays = scene.triangles.reshape(-1, 3) - scene.camera
    assert (rays @ forward / np.linalg.norm(rays, axis=1)).min() > np.cos(np.radians(30))


def test_a_picture_lies_once_on_each_side_of_a_box_and_is_not_mirrored(tmp_path):
    write_picture(tmp_path / "picture.png")
    box = {"shape": "box", "size": [2, 4, 1], "texture": "picture.png"}
    scene, _ = load(write_scene(tmp_path, box, camera=[0, -9, 0], **UNLIT))
    np.testing.assert_allclose(np.ptp(scene.uv, axis=1), 1, atol=1e-6)
    corners, uv = scene.triangles.astype(float), scene.uv.astype(float)
    edges, steps = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    # to the right crossed with downwards points into the box
    along = np.linalg.solve(steps, edges)
    inwards = np.cross(along[:, 0], along[:, 1])
    assert ((inwards * corners.mean(1)).sum(1) < 0).all()
    sides = np.abs(inwards[:, 2]) < 1e-6
    np.testing.assert_allclose(along[sides, 1], np.tile([0, 0, -1], (8, 1)), atol=1e-6)


BOX = {"shape": "box"}

SHORT_PLY = PLY.format(vertex="", face="", rows="0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n").replace("face 1", "face 2")

TRIANGLE = "0 2 0\n1 2 0\n0 2 1\n"


def corrupted(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Path]:
    """Writes the glTF quad after a change."""

    def write(folder: Path) -> Path:
        write_picture(folder / "picture.png")
        about = gltf_quad()
        change(about)
        (folder / "quad.gltf").write_text(json.dumps(about))
        return folder / "quad.gltf"

    return write


def named(name: str, content: str | bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / name

    return write


def scene_of(*parts: Any, **about: Any) -> Callable[[Path], Path]:
    return lambda folder: write_scene(folder, *parts, **about)


def without_picture(folder: Path) -> Path:
    path = write_obj(folder)
    (folder / "picture.png").unlink()
    return path


def with_broken_picture(folder: Path) -> Path:
    path = write_obj(folder)
    (folder / "picture.png").write_bytes((folder / "picture.png").read_bytes()[:60])
    return path


def without_materials(folder: Path) -> Path:
    path = write_obj(folder)
    (folder / "quad.mtl").unlink()
    return path


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda folder: folder / "none.glb", ("none.glb is missing",)),
        (lambda folder: folder, ("of a mesh was expected",)),
        (lambda folder: folder / "none.json", ("none.json is missing",)),
        (named("a.blend", "BLENDER"), ("a.blend is of a type", ".obj")),
        (named("a.3mf", "PK"), ("a.3mf is of a type", ".obj")),
        (named("a.obj", ""), ("a.obj holds no mesh with faces",)),
        (named("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"), ("a.obj holds no mesh with faces",)),
        (named("a.obj", "v 0 0 0\nv 1 0 0\nf 1 2 9\n"), ("a.obj cannot be read",)),
        (named("a.ply", b"\x00\xff\x17" * 50), ("a.ply cannot be read",)),
        (named("a.ply", PLY.format(vertex="", face="", rows="0 0 0\n")), ("a.ply holds no mesh with faces",)),
        (named("a.ply", SHORT_PLY), ("a.ply holds 1 faces, but its header says 2",)),
        (named("a.glb", b"glTF\2\0\0\0\x20\0\0\0\x90\0\0\0JSON{"), ("a.glb cannot be read as glTF",)),
        (named("a.gltf", "[1, 2"), ("a.gltf cannot be read as glTF",)),
        (named("a.gltf", "[1, 2]"), ("a.gltf holds a list, but a JSON object",)),
        (named("a.off", f"OFF\n3 1 0\n{TRIANGLE}3 0 1 1\n"), ("1 triangles, but none of them has an area",)),
        (named("a.off", f"OFF\n3 1 0\n{TRIANGLE.replace('2', '1e9')}3 0 1 2\n"), ("1e+09 m away", "single precision")),
        (without_picture, ("quad.obj names picture.png, which is not in",)),
        (with_broken_picture, ("picture.png, which cannot be read as an image",)),
        (without_materials, ("quad.obj names quad.mtl, which is not in",)),
        (corrupted(lambda about: about["images"][0].update(uri="gone.png")), ("names gone.png, which is not in",)),
        (
            corrupted(lambda about: about["images"][0].update(uri="data:image/png;base64,AAAA")),
            ("1 pictures as textures, of which 0 can be decoded", "PNG"),
        ),
        (corrupted(lambda about: about["buffers"][0].update(uri="gone.bin")), ("names gone.bin, which is not in",)),
        (corrupted(lambda about: about.update(extensionsRequired=["KHR_new"])), ("needs KHR_new", "uncompressed")),
        (corrupted(lambda about: about["accessors"][1].update(componentType=5123)), ("without quantization",)),
        (
            corrupted(lambda about: about["meshes"][0]["primitives"][0].pop("attributes")),
            ("lacks meshes[0].primitives[0].attr",),
        ),
        (corrupted(lambda about: about["bufferViews"][0].update(byteLength=10**6)), ("reaches to byte 1,000,000 of",)),
        (
            corrupted(lambda about: about["accessors"][2].update(bufferView=0)),
            ("triangle at vertex", "with 4 vertices"),
        ),
        (corrupted(lambda about: about["nodes"][0].update(matrix=[1e300] * 16)), ("by a matrix that holds 1e+300",)),
        (
            corrupted(lambda about: about["nodes"][0].update(scale=[1, 1, float("nan")])),
            ("nodes[0].scale", "3 numbers"),
        ),
        (corrupted(lambda about: about["textures"][0].update(source=5)), ("names images[5] in textures[0].source",)),
        (
            corrupted(lambda about: about["nodes"][0].update(name="\ud800")),
            (r"holds \ud800, which is half of a letter",),
        ),
        (corrupted(lambda about: about["nodes"][0].pop("mesh")), ("holds no mesh with faces",)),
        (named("a.json", "{"), ("a.json cannot be read as JSON",)),
        (named("a.json", "[]"), ("a.json holds a list",)),
        (named("a.json", "{}"), ("a.json holds parts = null", "at least one part")),
        (scene_of(), ("holds parts = []",)),
        (scene_of(7), ("scene.json, part 1, is 7",)),
        (scene_of(BOX, {}), ("part 2, holds shape = null", "plane")),
        (scene_of({"shape": "cube"}), ('shape = "cube"', "box, ball, plane")),
        (scene_of({"shape": "chair.glb"}), ("chair.glb is missing",)),
        (scene_of({**BOX, "sise": 1}), ('holds "sise"', "size, position")),
        (scene_of(BOX, colour=1), ('holds "colour"', "background")),
        (scene_of({**BOX, "size": 2}), ("size = 2", "3 numbers")),
        (scene_of({**BOX, "size": [1, 0, 1]}), ("size = [1, 0, 1]",)),
        (scene_of({"shape": "ball", "size": [1]}), ("size = [1]", "a number")),
        (scene_of({**BOX, "position": [0, 1, float("nan")]}), ("position = [0, 1, NaN]",)),
        (scene_of({**BOX, "rotation": "x"}), ('rotation = "x"',)),
        (scene_of({**BOX, "rotation": [0, True, 10**400]}), ("rotation = [0, true, 1000",)),
        (scene_of({**BOX, "texture": "marble"}), ('texture = "marble"', "clouds, mosaic")),
        (scene_of({**BOX, "texture": 3}), ("texture = 3",)),
        (scene_of({**BOX, "texture": "marble.png"}), ("marble.png",)),
        (scene_of({**BOX, "brightness": [0, -1]}), ("brightness = [0, -1]",)),
        (scene_of({"shape": "quad.obj", "brightness": [0, 1]}), ("holds brightness, but no texture",)),
        (scene_of(BOX, camera=[0, 1]), ("camera = [0, 1]",)),
        (scene_of(BOX, camera=[0, 0, 3], target=[0, 0, 0]), ("camera at [0.0, 0.0, 3.0]", "right above")),
        (scene_of(BOX, camera=[0, 1, 3], target=[0, 1, 3]), ("must be apart",)),
        (scene_of(BOX, background=-0.1), ("background = -0.1",)),
        (scene_of(BOX, light=[0, 0, 0]), ("no direction",)),
    ],
)
def test_a_scene_that_cannot_be_is_refused_in_one_sentence(tmp_path, write, said):
    if "brightness" in said[0]:
        write_obj(tmp_path)
    with pytest.raises(RecordingError) as error:
        load(write(tmp_path))
    message = str(error.value)
    assert all(part in message for part in said), message
    assert message.endswith(".") and "\n" not in message and len(message) < 400 + 2 * len(str(tmp_path)), message


def test_what_gltf_says_and_is_not_followed_is_noted(tmp_path):
    def change(about: dict[str, Any]) -> None:
        about["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = {
            "KHR_texture_transform": {"scale": [2, 2]}
        }

    _, (note,) = load(corrupted(change)(tmp_path))
    assert "KHR_texture_transform" in note


def test_meshes_with_one_picture_share_its_texture(tmp_path):
    def change(about: dict[str, Any]) -> None:
        (first,) = about["meshes"][0]["primitives"]
        about["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}})
        about["textures"].append({"source": 0, "sampler": 0})
        about["samplers"] = [{"magFilter": 9729}]
        about["meshes"][0]["primitives"].append({**first, "material": 1})

    scene, notes = load(corrupted(change)(tmp_path))
    assert len(scene.triangles) == 4 and scene.texture_size.tolist() == [64] and not notes


def same(first: Scene, second: Scene) -> bool:
    return all(np.array_equal(vars(first)[name], vars(second)[name]) for name in vars(first))


def test_the_same_seed_makes_the_same_scene(tmp_path):
    path = write_scene(tmp_path, {**BOX, "texture": "lines"}, {**BOX, "texture": "page", "position": [2, 0, 0]})
    assert same(load(path, 3)[0], load(path, 3)[0])
    assert not same(load(path, 3)[0], load(path, 4)[0])


@pytest.mark.sweep(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_same_seed_makes_the_same_preset(name):
    assert same(SCENES[name](RNG(3)), SCENES[name](RNG(3)))
    assert not same(SCENES[name](RNG(3)), SCENES[name](RNG(4)))


@pytest.mark.slow
def test_shadows_of_the_moon_fall_where_the_ground_is_in_the_way_of_the_sun():
    heights, brightness = textures.moon(RNG(0))
    size, cell = len(heights), textures.MOON_EXTENT / len(heights)
    reach = np.arange(1, int(np.ptp(heights) / np.tan(np.radians(23)) / cell) + 2)
    shaded, lit = [], []
    for row, column in RNG(1).integers(0, size, (4000, 2)):
        rise = heights[row, (column - reach) % size] - heights[row, column]
        if (rise > reach * cell * np.tan(np.radians(25))).any():
            shaded.append(brightness[row, column])
        elif (rise < reach * cell * np.tan(np.radians(23))).all():
            lit.append(brightness[row, column])
    assert len(shaded) > 100 and max(shaded) <= 1.2 * 0.035 + 1e-6
    assert len(lit) > 2000 and np.median(lit) > 0.3


@pytest.mark.parametrize(
    ("shape", "size"), [((5, 3), 8), ((64, 64), 64), ((65, 10), 128), ((20, 5000), 2048), ((1, 1), 1)]
)
def test_pictures_of_any_size_become_squares_that_show_the_same(tmp_path, shape, size):
    width = shape[1]
    ramp = np.broadcast_to(np.linspace(40, 200, width).round().astype(np.uint8), shape)
    Image.fromarray(np.ascontiguousarray(ramp)).save(tmp_path / "picture.png")
    scene, _ = load(write_scene(tmp_path, {"shape": "plane", "texture": "picture.png"}))
    assert scene.channels == 1 and scene.texture_size.tolist() == [size]
    image = scene.texels[: size**2, 0].reshape(size, size)
    assert np.ptp(image, axis=0).max() < 1e-6
    expected = [to_linear(value / 255) for value in ramp[0].tolist()]
    places = (np.arange(size) + 0.5) / size * width - 0.5
    if width <= size:
        np.testing.assert_allclose(image[0], np.interp(places, np.arange(width), expected), atol=2e-3)
    else:
        edges = np.linspace(0, width, size + 1)
        whole = np.interp(edges, np.arange(width + 1), np.append(0, np.cumsum(expected)))
        np.testing.assert_allclose(image[0], np.diff(whole) * size / width, atol=2e-3)
