"""Other methods of Nerfstudio see points where they are, whatever the lens."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from known_points import points_seen, reference_poses, spot_centre, spots_image
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.datasets.depth_dataset import DepthDataset
from PIL import Image
from recordings import FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, image, poses, write_davis, write_esim
from test_eds import make_scene as make_eds_scene
from test_eds import write_raw as write_eds
from test_tum_vie import make_scene as make_tum_vie_scene
from test_tum_vie import write_raw as write_tum_vie

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.picture_files import write_pictures
from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError
from enerf_ns.method.event_dataset import EventDataset

DEPTH_RANGE = (0.3, 4.0)

LENSES: dict[str, tuple[list[float], list[float], bool]] = {
    "pinhole": ([150.0, 151.0, 80.3, 58.6], [], True),
    "radtan": ([130.0, 131.0, 84.0, 57.0], [-0.36, 0.14, 0.002, -0.003, -0.02], True),
    "fisheye": ([110.0, 111.0, 77.0, 62.0], [0.05, -0.02, 0.004, -0.001], True),
    "lookup": ([130.0, 131.0, 84.0, 57.0], [-0.36, 0.14, 0.002, -0.003], False),
}
"""Intrinsics fx fy cx cy and coefficients of lenses whose pictures have 160 x 120 pixels, and whether they are grey."""


def write_spots(folder: Path, model: str) -> np.ndarray:
    """A recording of this package's layout with five points in each of three frames; the points, [frames, 5, 3]."""
    (fx, fy, cx, cy), distortion, grey = LENSES[model]
    matrix, size = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (160, 120)
    (folder / "events").mkdir(parents=True)
    (folder / "frames").mkdir()
    for name, values in (("x", [3, 9]), ("y", [4, 8]), ("t", [10**8, 9 * 10**8]), ("p", [1, 0])):
        np.save(folder / f"events/{name}.npy", np.array(values))
    rows = zip(POSE_TIMES.tolist(), poses().tolist(), strict=True)
    (folder / "poses.txt").write_text("".join(f"{time} {' '.join(map(repr, pose))}\n" for time, pose in rows))
    camera = {"width": 160, "height": 120, "model": model, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    if model == "lookup":
        places = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1).reshape(-1, 1, 2)
        table = cv2.undistortPoints(places, matrix, np.array(distortion)).reshape(120, 160, 2)
        np.save(folder / "camera_directions.npy", table)
    else:
        camera["distortion"] = distortion
    (folder / "recording.json").write_text(json.dumps({"camera": camera}))
    rng, points = np.random.default_rng(5), []
    for i, pose in enumerate(reference_poses(POSE_TIMES, poses()[:, :3], poses()[:, 3:], FRAME_TIMES)):
        places = np.array([[30, 25], [131, 28], [83, 61], [28, 92], [129, 95]]) + rng.uniform(-4, 4, (5, 2))
        lens = "fisheye" if model == "fisheye" else "radtan"
        seen = points_seen(places, rng.uniform(0.5, 3.0, 5), np.tile(pose, (5, 1, 1)), matrix, distortion, lens)
        points.append(seen)
        picture = spots_image(places, *size)
        Image.fromarray(picture if grey else np.repeat(picture[..., None], 3, 2)).save(folder / f"frames/{i:05d}.png")
    (folder / "frames/stamps_ns.txt").write_text("".join(f"{time}\n" for time in FRAME_TIMES))
    return np.array(points)


def spots_of_eds(folder: Path, data: Path) -> np.ndarray:
    """The published calibration of EDS, radtan, on a second of a real trajectory."""
    rows = np.loadtxt(data / "eds/stamped_groundtruth_us_01_peanuts_light.txt")[2000:2150]
    rows[:, 0] -= rows[0, 0]
    camchain = (data / "eds/camchain.yaml").read_text()
    scene = make_eds_scene(rows, yaml.safe_load(camchain))
    write_eds(folder, scene)
    (folder / "camchain.yaml").write_text(camchain)
    return scene.spots


def spots_of_tum_vie(folder: Path, data: Path) -> np.ndarray:
    """The published calibration of TUM-VIE, fisheye, grey JPEG, on two seconds of a real trajectory."""
    calibration, marker = (
        json.loads((data / "tum_vie" / name).read_text())
        for name in ("camera-calibrationA.json", "mocap-imu-calibrationA.json")
    )
    rows = np.loadtxt(data / "tum_vie/mocap_data_reconstructed.txt")[1000:1200]
    scene = make_tum_vie_scene(calibration, marker, rows, "left", with_spots=True)
    write_tum_vie(folder, scene)
    return scene.frame_points


REAL: dict[str, Callable[[Path, Path], np.ndarray]] = {"eds": spots_of_eds, "tum_vie": spots_of_tum_vie}


def parser_config(folder: Path, **options: Any) -> EventDataParserConfig:
    """Trains on all but the middle frame."""
    return EventDataParserConfig(data=folder, depth_range=DEPTH_RANGE, held_out_frame_indices=(1,), **options)


def parse(folder: Path, split: str = "train", **options: Any) -> DataparserOutputs:
    return parser_config(folder, **options).setup().get_dataparser_outputs(split)


def errors(outputs: DataparserOutputs, dataset: Any, index: int, points: np.ndarray) -> np.ndarray:
    """How far, in pixels, the spot of each point in a picture lies from where Nerfstudio's ray sees the point."""
    cameras, picture = dataset.cameras, (255 * dataset[index]["image"].numpy()).round().astype(np.uint8)
    assert picture.shape == (cameras.height[index, 0], cameras.width[index, 0], 3)
    transform = outputs.metadata["transform"].numpy()
    pose = cameras.camera_to_worlds[index].double().numpy()
    scene = outputs.dataparser_scale * (points @ transform[:, :3].T + transform[:, 3])
    seen = (scene - pose[:, 3]) @ pose[:, :3]
    fx, fy, cx, cy = (float(getattr(cameras, name)[index]) for name in ("fx", "fy", "cx", "cy"))
    wanted = seen[:, :2] / -seen[:, 2:]
    found = []
    for x, y in wanted:
        centre = spot_centre(picture, np.array([fx * x + cx - 0.5, -fy * y + cy - 0.5]))
        coordinates = torch.tensor([centre[1] + 0.5, centre[0] + 0.5]).float()
        ray = cameras.generate_rays(camera_indices=index, coords=coordinates).directions.double().numpy() @ pose[:, :3]
        found.append(ray[:2] / -ray[2])
    return np.linalg.norm((np.array(found) - wanted) * [fx, fy], axis=1)


@pytest.mark.parametrize("model", LENSES)
def test_points_are_found_on_the_rays_of_their_pixels(tmp_path: Path, model: str):
    points = write_spots(tmp_path / "spots", model)
    for split, numbers in (("train", (0, 2)), ("val", (1,))):
        outputs = parse(tmp_path / "spots", split)
        dataset = InputDataset(outputs)
        for i, number in enumerate(numbers):
            assert errors(outputs, dataset, i, points[number]).max() < 0.1


@pytest.mark.parametrize("format", REAL)
def test_points_are_found_with_real_calibrations(tmp_path: Path, shared_data: Path, format: str):
    points = REAL[format](tmp_path / "spots", shared_data)
    outputs = parse(tmp_path / "spots")
    for i, number in enumerate((0, 2)):
        assert errors(outputs, InputDataset(outputs), i, points[number]).max() < 0.1


def test_the_raw_files_would_show_points_far_off(tmp_path: Path):
    """So that the tests above would notice."""
    points = write_spots(tmp_path / "spots", "radtan")
    outputs = parse(tmp_path / "spots")
    outputs.image_filenames = [tmp_path / "spots/frames/00000.png", tmp_path / "spots/frames/00002.png"]
    with pytest.raises(AssertionError):
        assert errors(outputs, InputDataset(outputs), 0, points[0]).max() < 3.0


@pytest.mark.parametrize("factor", [2.0, 1.5])
def test_points_are_found_in_downscaled_pictures(tmp_path: Path, factor: float):
    points = write_spots(tmp_path / "spots", "radtan")
    outputs = parse(tmp_path / "spots", downscale_factor=factor)
    assert outputs.cameras.width[0].item() == int(160 / factor)
    assert errors(outputs, InputDataset(outputs), 0, points[0]).max() < 0.1


@pytest.mark.parametrize("model", LENSES)
def test_our_own_pictures_are_the_same(tmp_path: Path, model: str):
    write_spots(tmp_path / "spots", model)
    parser = parser_config(tmp_path / "spots").setup()
    written = InputDataset(parse(tmp_path / "spots"))
    own = EventDataset(parser.outputs(parser.recording(), "train"))
    raw = [tmp_path / "spots/frames/00000.png", tmp_path / "spots/frames/00002.png"]
    assert own.image_filenames == raw
    for i in range(2):
        np.testing.assert_array_equal(written.get_numpy_image(i), own.get_numpy_image(i))
        undistorted = read_recording(tmp_path / "spots").camera.undistort(np.atleast_3d(np.asarray(Image.open(raw[i]))))
        np.testing.assert_array_equal(own.get_numpy_image(i), np.broadcast_to(undistorted, (120, 160, 3)))
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height"):
        assert torch.equal(getattr(written.cameras, name), getattr(own.cameras, name))


def test_a_vanilla_manager_draws_the_colours_of_its_rays(tmp_path: Path):
    write_spots(tmp_path / "spots", "fisheye")
    config = VanillaDataManagerConfig(dataparser=parser_config(tmp_path / "spots"), train_num_rays_per_batch=2000)
    check_rays(config.setup())


@pytest.mark.slow
def test_a_parallel_manager_draws_the_colours_of_its_rays(tmp_path: Path):
    write_spots(tmp_path / "spots", "fisheye")
    config = ParallelDataManagerConfig(dataparser=parser_config(tmp_path / "spots"), train_num_rays_per_batch=2000)
    manager = config.setup()
    try:
        check_rays(manager)
    finally:
        for process in manager.data_procs:
            process.terminate()


def check_rays(manager: Any) -> None:
    """What is trained on is what the data set shows, on the rays of its cameras."""
    dataset = manager.train_dataset
    rays, batch = manager.next_train(0)
    number, row, column = batch["indices"].T
    pictures = torch.stack([dataset[i]["image"] for i in range(len(dataset))])
    torch.testing.assert_close(batch["image"], pictures[number, row, column])
    coordinates = torch.stack([row, column], dim=-1) + 0.5
    expected = dataset.cameras.generate_rays(number[:, None], coordinates)
    torch.testing.assert_close(rays.directions, expected.directions)
    torch.testing.assert_close(rays.origins, expected.origins)


@pytest.mark.parametrize("model", LENSES)
def test_a_manager_of_full_images_changes_nothing(tmp_path: Path, model: str):
    """That of splatfacto, which would undistort by itself, and crop."""
    points = write_spots(tmp_path / "spots", model)
    config = FullImageDatamanagerConfig(dataparser=parser_config(tmp_path / "spots"), cache_images_type="uint8")
    manager = config.setup(device="cpu")
    outputs = manager.train_dataparser_outputs
    for step in range(2):
        camera, data = manager.next_train(step)
        i = camera.metadata["cam_idx"]
        np.testing.assert_array_equal(data["image"].numpy(), InputDataset(outputs).get_numpy_image(i))
        assert torch.equal(camera.fx, outputs.cameras[i : i + 1].fx)
        assert errors(outputs, manager.train_dataset, i, points[(0, 2)[i]]).max() < 0.1


@pytest.mark.parametrize("mode", ["I;16", "LA", "RGBA", "P", "1"])
def test_files_of_any_kind_become_pictures_of_8_bits(tmp_path: Path, mode: str):
    folder = write_esim(tmp_path / "esim", channels=3)
    for i in range(3):
        grey = Image.fromarray(image(i, 1)[..., 0])
        pixels = np.asarray(grey).astype(np.uint16) * 257
        (Image.fromarray(pixels) if mode == "I;16" else grey.convert(mode)).save(folder / f"images/{i:05d}.png")
    outputs = parse(folder)
    own = EventDataset(parser_config(folder).setup().outputs(read_recording(folder), "train"))
    for i, file in enumerate(outputs.image_filenames):
        with Image.open(file) as written:
            assert written.mode in ("L", "RGB")
        shown = own[i]["image"]
        np.testing.assert_allclose(InputDataset(outputs)[i]["image"], shown, rtol=0, atol=1e-6)
        if mode != "1":
            np.testing.assert_allclose(shown[..., :1], image((0, 2)[i], 1) / 255, rtol=0, atol=1e-6)


def test_pictures_are_written_once_and_again_when_a_frame_changes(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    files = parse(folder).image_filenames
    assert len(set(files)) == 2 and not any(file.is_relative_to(folder) for file in files)
    written = [file.stat().st_ino for file in files]
    assert parse(folder).image_filenames == files and [file.stat().st_ino for file in files] == written
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before

    changed = folder / "images/frame_00000002.png"
    Image.fromarray(np.full((HEIGHT, WIDTH), 77, np.uint8)).save(changed)
    later = before[changed] + 10**9
    os.utime(changed, ns=(later, later))
    assert parse(folder).image_filenames == files
    assert (np.asarray(Image.open(files[1])) == 77).all() and files[0].stat().st_ino == written[0]


def test_pictures_of_another_calibration_are_others(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    files = {tuple(parse(folder, undistort=undistort).image_filenames) for undistort in (True, False)}
    files.add(tuple(parse(folder, downscale_factor=2.0).image_filenames))
    assert len(files) == 3


def test_a_cache_that_cannot_be_written_is_an_error_of_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    frames = read_recording(write_davis(tmp_path / "davis")).frames
    assert frames is not None
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "file"))
    with pytest.raises(OutputError, match=r"file.*ENERF_CACHE") as error:
        write_pictures(frames)
    assert "\n" not in str(error.value)


def test_without_frames_other_methods_are_told_what_to_do(tmp_path: Path):
    folder = write_esim(tmp_path / "esim", frames=())
    with pytest.raises(SystemExit, match=r"no frames.*ns-train enerf --data .*enerf reconstruct") as error:
        parse(folder)
    assert "\n" not in str(error.value) and error.value.code != 0


def test_a_frame_that_is_damaged_is_named(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    (folder / "images/frame_00000000.png").write_bytes(b"\x89PNG")
    with pytest.raises((SystemExit, RecordingError), match=r"frame_00000000\.png"):
        parse(folder)


def test_depth_is_that_of_the_recording(tmp_path: Path):
    """In the units of the scene, for depth-nerfacto."""
    outputs = parse(write_esim(tmp_path / "esim", depth=True))
    dataset = DepthDataset(outputs)
    for i, metres in enumerate((1.0, 3.0)):
        expected = torch.full((HEIGHT, WIDTH, 1), metres * outputs.dataparser_scale)
        torch.testing.assert_close(dataset[i]["depth_image"], expected)
