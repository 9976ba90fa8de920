"""Inputs that never end, grow without end when they are read, or are far too large: each is refused within 30 seconds
and 2 GB, in one sentence that names the file."""

from __future__ import annotations

import base64
import json
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from PIL import Image
from test_wrong_inputs import SMALL, WHOLE, check_sentence, write_event_file
from warm_commands import WarmCommands

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded by what Linux has")

SECONDS, MEMORY = 30, 2 * 10**9

Place = Callable[[Path], object]


def link(target: str) -> Place:
    def place(path: Path) -> None:
        path.unlink(missing_ok=True)
        path.symlink_to(target)

    return place


def zeros(size: int = 6 * 2**30, start: bytes = b"") -> Place:
    """A file of zeros, after what it starts with, which takes no space on the disk."""

    def place(path: Path) -> None:
        with open(path, "wb") as file:
            file.write(start)
            file.truncate(size)

    return place


def text(content: str) -> Place:
    return lambda path: path.write_text(content)


def before(content: str) -> Place:
    return lambda path: path.write_text(content + path.read_text())


def stated(key: str, content: str) -> Place:
    """JSON with one more key, whose value is written as it stands."""
    return lambda path: path.write_text(path.read_text().rstrip()[:-1] + f', "{key}": {content}}}')


NPY_HEADER = b"\x93NUMPY\x02\x00" + (2**32 - 1).to_bytes(4, "little")


def npz_of_zeros(path: Path) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{name: array for name, array in arrays.items() if name != "T_wc_position"})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("T_wc_position.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": (2**26 // 3 * 3, 3)}
        )
        for _ in range(24):
            member.write(bytes(2**26))


def npz_header(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("T_wc_timestamp.npy", "w", force_zip64=True) as member:
            member.write(NPY_HEADER)
            for _ in range(40):
                member.write(bytes(2**26))


def chunk(name: str) -> Place:
    def place(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            file.create_dataset(name, (2**30,), np.uint16, chunks=(2**30,), compression="gzip", fillvalue=0)

    return place


def offset(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.create_dataset("t_offset", (2**40,), np.int64, chunks=(2**10,))


ALIASES = "".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}1]\n" for i in range(1, 30))
MERGED = "".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 30))

ENDLESS: dict[str, tuple[str, str, Place]] = {
    **{
        f"{whole}: {name} is {kind}": (whole, name, place)
        for whole, names in {
            "small own": ("recording.json", "poses.txt", "frames/stamps_ns.txt", "events/t.npy", "depth/0.npy"),
            "small davis": ("events.txt", "groundtruth.txt", "calib.txt", "images/frame_00000001.png"),
            "eds_raw": ("camchain.yaml", "events.h5"),
            "tum_vie_prepared": ("calib_undist.json", "mocap-imu-calib.json"),
            "esim_npz": ("camera_calibration.npz",),
            "esim_bag": ("esim.bag", "esim.conf"),
            "llff_events": ("all_poses_bounds.npy", "all_timestamps.npy", "images_1/timestamps.npz", "events.h5"),
            "eventnerf": ("train/events/test.npz", "train/pose/r_00000.txt", "train/intrinsics/r_00003.txt"),
            "mvsec": ("indoor_flying1_gt.hdf5", "camchain-imucam-indoor_flying.yaml"),
            "vector": ("desk_normal1.synced.gt.txt", "camera_mocap_extrinsic_results1.yaml"),
            "ros_bag_2": ("metadata.yaml", "bag.db3"),
            "dsec": ("calibration/cam_to_cam.yaml", "images/left/exposure_timestamps.txt"),
            "m3ed": ("seq_pose_gt.h5",),
            "small esim": ("simulation.json", "poses_bounds.npy", "images/image_stamps_ns.txt"),
            "file": ("recording.raw",),
        }.items()
        for name in names
        for kind, place in {
            "a file of the kernel": link("/proc/kmsg"),
            "a file of a process": link("/proc/self/mem"),
            "a device": link("/dev/zero"),
            "6 GB of zeros": zeros(),
        }.items()
    },
    "camchain of merge keys": ("eds_raw", "camchain.yaml", before("a0: &a0 {x: 1}\n" + MERGED)),
    "camchain of aliases": ("eds_raw", "camchain.yaml", before("a0: &a0 [1]\n" + ALIASES)),
    "camchain that holds itself": ("eds_raw", "camchain.yaml", before("a: &a {b: [*a]}\n")),
    "camchain of numbers to the base 60": ("eds_raw", "camchain.yaml", before(f"a: {'1:' * 100_000}1\n")),
    "camchain of many values": ("eds_raw", "camchain.yaml", before(f"a: [{'1,' * 30_000}1]\n")),
    "camchain of a wrong number": ("eds_raw", "camchain.yaml", before(f"a: {'1:' * 500}1.5\n")),
    "camchain of a wrong truth": ("eds_raw", "camchain.yaml", before("a: !!bool 3\n")),
    "nested JSON": ("small own", "recording.json", stated("response", "[" * 10**6 + "]" * 10**6)),
    "JSON of many values": ("small own", "recording.json", stated("response", f"[{'[],' * 10**7}1]")),
    "JSON of half a letter": ("small own", "recording.json", stated("response", r'"\ud800"')),
    "a number of a million digits in JSON": ("small own", "recording.json", stated("depth_range", "1" * 10**6)),
    "a pose at a time of a million digits": ("small own", "poses.txt", before(f"0.{'1' * 10**6} 0 0 0 0 0 0 1\n")),
    "an event at a time of a million digits": ("small davis", "events.txt", before(f"0.{'0' * 10**6} 1 1 1\n")),
    "an event of 200 digits": ("small davis", "events.txt", before(f"0.{'0' * 200} 1 1 1\n")),
    "millions of poses": ("small own", "poses.txt", text("10 10 10 10 10 10 10 10\n" * 2_000_001)),
    "events of one line": ("small davis", "events.txt", zeros(2**30, b"0.1 1 1 1\n")),
    "header of an array": ("small own", "events/t.npy", zeros(6 * 2**30, NPY_HEADER)),
    "array of 3 GB": (
        "small esim",
        "poses_bounds.npy",
        lambda path: np.lib.format.open_memmap(path, "w+", np.float64, (3 * 2**27 // 17, 17)).flush(),
    ),
    "array that unpacks to 1.6 GB": ("esim_npz", "camera_poses.npz", npz_of_zeros),
    "header that unpacks to 2.6 GB": ("esim_npz", "camera_poses.npz", npz_header),
    "chunk of 2 GB": ("eds_raw", "events.h5", chunk("x")),
    "offset of 8 TB": ("eds_raw", "events.h5", offset),
}
"""Recording, file and what becomes of it."""


@pytest.fixture
def refused(warm_commands: WarmCommands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Calls `enerf` with so much time and memory; the sentence that it ends with."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> str:
        code, output = warm_commands.run("enerf", *arguments, limit=SECONDS, memory=MEMORY)
        assert code == 1, output[-2000:]
        assert not (tmp_path / "new").exists()
        sentence = check_sentence(output)
        assert "allocate" not in sentence and "Memory" not in sentence, sentence
        return sentence

    return call


@pytest.mark.sweep(24)
@pytest.mark.parametrize("name", ENDLESS)
def test_a_recording_never_takes_long(name: str, tmp_path: Path, refused: Callable[..., str]):
    whole, file, place = ENDLESS[name]
    WHOLE[whole](tmp_path / "recording")
    place(tmp_path / "recording" / file)
    source = tmp_path / "recording"
    sentence = refused("convert", source / file if whole == "file" else source, "--output-dir", "new")
    assert Path(file).name in sentence or str(Path(file).parent) in sentence
    shutil.rmtree(tmp_path / "recording")


def test_a_camchain_may_repeat_a_value(tmp_path: Path, warm_commands: WarmCommands):
    """PyYAML writes a list that two cameras share as an alias."""
    WHOLE["eds_raw"](tmp_path / "recording")
    path = tmp_path / "recording/camchain.yaml"
    camchain = yaml.safe_load(path.read_text())
    camchain["cam0"]["resolution"] = camchain["cam1"]["resolution"]
    path.write_text(yaml.safe_dump(camchain))
    assert "*" in path.read_text()
    code, output = warm_commands.run("enerf", "convert", tmp_path / "recording", "--output-dir", tmp_path / "new")
    assert code == 0, output


OPTIONS: dict[str, tuple[str, ...]] = {
    "convert --poses": ("convert", "recording.raw", "--output-dir", "new", "--poses", "PLACE"),
    "convert --camera": ("convert", "recording.raw", "--output-dir", "new", "--camera", "PLACE"),
    "simulate --trajectory": ("simulate", "shapes", "--output-dir", "new", "--trajectory", "PLACE", *SMALL),
    "simulate --key-frames": ("simulate", "shapes", "--output-dir", "new", "--key-frames", "PLACE", *SMALL),
    "simulate --cameras": ("simulate", "shapes", "--output-dir", "new", "--cameras", "PLACE"),
    "simulate a scene": ("simulate", "PLACE.json", "--output-dir", "new"),
    "simulate an OBJ": ("simulate", "PLACE.obj", "--output-dir", "new"),
    "simulate a PLY": ("simulate", "PLACE.ply", "--output-dir", "new"),
    "simulate a glTF": ("simulate", "PLACE.glb", "--output-dir", "new"),
    "simulate a video": ("simulate", "PLACE.avi", "--output-dir", "new"),
}


@pytest.mark.sweep(10)
@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("kind", ["kernel", "zeros"])
def test_an_option_never_takes_long(option: str, kind: str, tmp_path: Path, refused: Callable[..., str]):
    write_event_file(tmp_path / "recording.raw")
    (argument,) = (argument for argument in OPTIONS[option] if argument.startswith("PLACE"))
    name = argument.replace("PLACE", "place")
    (link("/proc/kmsg") if kind == "kernel" else zeros(3 * 2**30))(tmp_path / name)
    sentence = refused(*(name if part == argument else part for part in OPTIONS[option]))
    assert name in sentence


OBJ = "mtllib quad.mtl\nv 0 2 0\nv 1 2 0\nv 0 2 1\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"
MTL = "newmtl a\nmap_Kd picture.png\n"


def obj(**files: Place) -> Place:
    def place(folder: Path) -> None:
        (folder / "quad.obj").write_text(OBJ)
        (folder / "quad.mtl").write_text(MTL)
        for name, make in files.items():
            make(folder / name.replace("_", "."))

    return place


def gltf(triangles: int = 1, **changed: object) -> Place:
    """One mesh of so many triangles that all lie in one place, and one node, unless changed."""
    corners = np.tile(np.array([[0, 0, -2], [1, 0, -2], [0, 1, -2]], np.float32), (triangles, 1))
    about: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": len(corners), "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": corners.nbytes}],
        "buffers": [
            {
                "byteLength": corners.nbytes,
                "uri": f"data:application/octet-stream;base64,{base64.b64encode(corners.tobytes()).decode()}",
            }
        ],
        **changed,
    }
    return lambda folder: (folder / "quad.gltf").write_text(json.dumps(about))


def diamonds(number: int) -> list[dict]:
    """Nodes of which each is reached by two ways from the one before."""
    first = range(0, 3 * number, 3)
    return [
        *(node for i in first for node in ({"children": [i + 1, i + 2]}, *[{"children": [i + 3]}] * 2)),
        {"mesh": 0},
    ]


def chain(length: int) -> list[dict]:
    return [*({"children": [i + 1]} for i in range(length)), {"mesh": 0}]


def gltf_of_parts(number: int) -> Place:
    """So many views and accessors of the same bytes."""
    view = {"buffer": 0, "byteLength": 36 * 1000}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3000, "type": "VEC3"}
    return gltf(1000, bufferViews=[view] * number, accessors=[accessor] * number)


SCENES: dict[str, tuple[str, Place, str]] = {
    "materials of the kernel": ("quad.obj", obj(quad_mtl=link("/proc/kmsg")), "quad.mtl"),
    "materials of a device": ("quad.obj", obj(quad_mtl=link("/dev/zero")), "quad.mtl"),
    "materials of 6 GB": ("quad.obj", obj(quad_mtl=zeros()), "quad.mtl"),
    "picture of the kernel": ("quad.obj", obj(picture_png=link("/proc/kmsg")), "picture.png"),
    "picture of 6 GB": ("quad.obj", obj(picture_png=zeros()), "picture.png"),
    "picture of 120 million pixels": (
        "quad.obj",
        obj(picture_png=lambda path: Image.new("RGB", (12_000, 10_000)).save(path)),
        "12,000 x 10,000 pixels",
    ),
    "buffer of the kernel": (
        "quad.gltf",
        lambda folder: (
            gltf(buffers=[{"byteLength": 36, "uri": "quad.bin"}])(folder),
            link("/proc/kmsg")(folder / "quad.bin"),
        ),
        "quad.bin",
    ),
    "nodes of a circle": ("quad.gltf", gltf(nodes=[{"children": [1], "mesh": 0}, {"children": [0]}]), "above"),
    "node below itself": ("quad.gltf", gltf(nodes=[{"children": [0], "mesh": 0}]), "above"),
    "nodes that double": (
        "quad.gltf",
        gltf(nodes=[*({"children": [i + 1, i + 1]} for i in range(30)), {"mesh": 0}]),
        "names nodes[1] twice",
    ),
    "nodes that double by way of others": (
        "quad.gltf",
        gltf(nodes=diamonds(30)),
        "names nodes[3] twice",
    ),
    "deep nodes": ("quad.gltf", gltf(nodes=chain(20_000)), "above one another"),
    "many nodes of one mesh": (
        "quad.gltf",
        gltf(5000, nodes=[{"mesh": 0}] * 5000, scenes=[{"nodes": list(range(5000))}]),
        "places 25,000,000 triangles",
    ),
    "many views": ("quad.gltf", gltf_of_parts(20_000), "720,000,000 bytes"),
    "accessor without data": (
        "quad.gltf",
        gltf(accessors=[{"componentType": 5126, "count": 10**12, "type": "VEC3"}]),
        "12,000,000,000,000 bytes",
    ),
    "nested": ("quad.gltf", lambda folder: (folder / "quad.gltf").write_text("[" * 10**6), "glTF"),
    "parts of a scene": (
        "scene.json",
        lambda folder: (folder / "scene.json").write_text(json.dumps({"parts": [{"shape": "ball"}] * 10_000})),
        "triangles",
    ),
}
"""Argument, files, and what is said."""


@pytest.mark.sweep(12)
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_never_takes_long(name: str, tmp_path: Path, refused: Callable[..., str]):
    argument, write, said = SCENES[name]
    write(tmp_path)
    sentence = refused("simulate", argument, "--output-dir", "new", *SMALL)
    assert said in sentence
