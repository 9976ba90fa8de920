"""Tests of the sources of brightness: scenes, pictures, videos and trained runs."""

from __future__ import annotations

import importlib
import json
import math
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torchvision
from recordings import write_esim
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.sensor.response import Gamma, Logarithm
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.sources import ImageFolder, RenderedScene, TrainedRun, Video, linear_from_srgb
from enerf_ns.simulator.trajectories import look_at, spiral

WIDTH, HEIGHT, NUM_PICTURES = 24, 18, 12
SRGB = [0.0, 0.03, 0.04045, 0.0405, 0.2, 0.5, 1.0]
LINEAR = [0.0, 0.03 / 12.92, 0.0031308, 0.0031349, 0.0331048, 0.2140411, 1.0]


def picture(index: int, channels: int = 3, dtype: type = np.uint8) -> np.ndarray:
    """Smooth and another one for each index; [18, 24, channels], R G B."""
    noise = np.random.default_rng(index).uniform(0, np.iinfo(dtype).max, (HEIGHT, WIDTH, channels))
    return cv2.GaussianBlur(noise, (3, 3), 0.8).reshape(HEIGHT, WIDTH, channels).astype(dtype)


def write_picture(path: Path, pixels: np.ndarray) -> None:
    assert cv2.imwrite(str(path), pixels[..., [2, 1, 0, 3][: pixels.shape[2]]] if pixels.shape[2] > 1 else pixels)


def write_pictures(folder: Path, count: int = NUM_PICTURES, channels: int = 3, dtype: type = np.uint8) -> Path:
    folder.mkdir()
    for index in range(count):
        write_picture(folder / f"frame{index}.png", picture(index, channels, dtype))
    return folder


def write_video(path: Path, count: int = NUM_PICTURES) -> Path:
    """Without loss, at 25 frames a second."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.ascontiguousarray(picture(index)[..., ::-1]))
    writer.release()
    return path


def slow_linear(pixels: np.ndarray) -> np.ndarray:
    """sRGB to linear, a value at a time."""
    top = np.iinfo(pixels.dtype).max
    values = (int(value) / top for value in pixels.ravel())
    linear = [value / 12.92 if value <= 0.04045 else math.pow((value + 0.055) / 1.055, 2.4) for value in values]
    return np.array(linear).reshape(pixels.shape)


def test_srgb_values_become_those_of_the_standard():
    np.testing.assert_allclose(linear_from_srgb(np.array(SRGB)), LINEAR, atol=1e-6)


def test_a_rendered_scene_is_what_its_renderer_shows_from_the_trajectory():
    scene = SCENES["shapes"](np.random.default_rng(0))
    renderer = Renderer(scene, Camera(WIDTH, HEIGHT, 20.0, 20.0, 12.0, 9.0))
    source = RenderedScene(renderer, spiral(10**9, scene.camera, scene.target, np.random.default_rng(1)))
    assert (source.start, source.end) == (0, 10**9)
    pose = source.trajectory.poses(torch.tensor([123_456_789])).numpy()[0]
    np.testing.assert_array_equal(source.brightness(123_456_789), renderer.brightness(pose))
    np.testing.assert_array_equal(source.depth(123_456_789), renderer.depth(pose))
    assert np.ptp(source.brightness(123_456_789)) > 0.2


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("gamma", [True, False])
def test_pictures_are_linear_brightness_at_their_times(tmp_path: Path, dtype: type, channels: int, gamma: bool):
    source = ImageFolder(write_pictures(tmp_path / "a", 3, channels, dtype), frames_per_second=40.0, gamma=gamma)
    assert (source.width, source.height, source.start, source.end) == (WIDTH, HEIGHT, 0, 50_000_000)
    for index, time in enumerate(source.times.tolist()):
        assert time == 25_000_000 * index
        stored = picture(index, channels, dtype)
        expected = slow_linear(stored) if gamma else stored / np.iinfo(dtype).max
        shown = source.brightness(time)
        assert shown.dtype == np.float32
        np.testing.assert_allclose(shown, expected[..., 0] if channels == 1 else expected, atol=1e-6)


def test_numbers_in_names_count_as_numbers(tmp_path: Path):
    source = ImageFolder(write_pictures(tmp_path / "a"), frames_per_second=10.0)
    for index in range(NUM_PICTURES):
        np.testing.assert_allclose(source.brightness(10**8 * index), slow_linear(picture(index)), atol=1e-6)


def test_between_two_pictures_log_brightness_is_linear(tmp_path: Path):
    folder, eps = write_pictures(tmp_path / "a", 3), 0.02
    (tmp_path / "times.txt").write_text("70.000\n70.010\n70.050\n")
    source = ImageFolder(folder, stamps=tmp_path / "times.txt", response=Logarithm(eps))
    np.testing.assert_array_equal(source.times, [0, 10_000_000, 50_000_000])
    first, second = (np.log(eps + slow_linear(picture(index))) for index in (1, 2))
    for share in (0.0, 0.25, 0.6, 1.0):
        shown = source.brightness(10_000_000 + round(40_000_000 * share))
        np.testing.assert_allclose(np.log(eps + shown), first + share * (second - first), atol=1e-5)
        assert shown.min() >= 0


def test_what_is_transparent_is_laid_over_white(tmp_path: Path):
    stored = picture(0, 4, np.uint16)
    (tmp_path / "a").mkdir()
    for name in ("a/0.png", "a/1.png"):
        write_picture(tmp_path / name, stored)
    shown = ImageFolder(tmp_path / "a", frames_per_second=1.0, gamma=False).brightness(0)
    colour, opacity = stored[..., :3] / 65535, stored[..., 3:] / 65535
    np.testing.assert_allclose(shown, colour * opacity + 1 - opacity, atol=2e-5)


def test_a_picture_that_is_asked_for_may_be_written_to(tmp_path: Path):
    source = ImageFolder(write_pictures(tmp_path / "a", 2), frames_per_second=1.0)
    source.brightness(0)[:] = 7
    assert source.brightness(0).max() <= 1


def test_other_files_beside_pictures_are_passed_over(tmp_path: Path):
    folder = write_pictures(tmp_path / "a", 2)
    (folder / "stamps.txt").write_text("0\n1\n")
    assert ImageFolder(folder, stamps=folder / "stamps.txt").end == 10**9


def test_times_outside_are_refused(tmp_path: Path):
    source = ImageFolder(write_pictures(tmp_path / "a", 2), frames_per_second=1.0)
    for time in (-1, 10**9 + 1):
        with pytest.raises(ValueError, match="lasts from 0 to 1000000000 ns"):
            source.brightness(time)


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (shutil.rmtree, dict(frames_per_second=1.0), "a is no folder"),
        (lambda folder: [file.unlink() for file in folder.iterdir()], dict(frames_per_second=1.0), "holds no pictures"),
        (lambda folder: [file.unlink() for file in list(folder.iterdir())[1:]], dict(frames_per_second=1.0),
         "holds only one picture"),
        (lambda _: None, dict(frames_per_second=0.0), "has 0 frames per second"),
        (lambda _: None, dict(frames_per_second=math.nan), "has nan frames per second"),
        (lambda _: None, dict(frames_per_second=1e10), r"has 1e\+10 frames per second"),
        (lambda _: None, dict(stamps=Path("no/times.txt")), r"no/times\.txt is missing"),
        (lambda folder: write_picture(folder / "frame2.png", picture(0)[:, :7]), dict(frames_per_second=1.0),
         r"frame2\.png has 7 x 18 pixels, but the first picture, frame0\.png, has 24 x 18"),
        (lambda folder: damage(folder / "frame0.png"), dict(frames_per_second=1.0), r"frame0\.png cannot be read"),
        (lambda folder: (folder / "frame1.png").write_bytes(b""), dict(frames_per_second=1.0), r"frame1\.png is empty"),
        (lambda folder: cv2.imwrite(str(folder / "a.tif"), np.full((HEIGHT, WIDTH), -1, np.float32)),
         dict(frames_per_second=1.0), r"a\.tif holds a brightness of -1"),
    ],
)  # fmt: skip
def test_folders_that_are_no_pictures_are_refused(tmp_path: Path, change, settings: dict, message: str):
    folder = write_pictures(tmp_path / "a", 3)
    change(folder)
    with pytest.raises(RecordingError, match=message) as refused:
        ImageFolder(folder, **settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("times", [{}, dict(frames_per_second=1.0, stamps=Path("times.txt"))])
def test_either_a_frame_rate_or_times_are_needed(tmp_path: Path, times: dict):
    with pytest.raises(FlagError, match=r"needs either --frames-per-second or --stamps, the times of its pictures\.$"):
        ImageFolder(write_pictures(tmp_path / "a", 3), **times)


def test_a_time_for_each_picture_is_needed(tmp_path: Path):
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(RecordingError, match=r"times\.txt holds 2 times, but .*a 3 pictures"):
        ImageFolder(write_pictures(tmp_path / "a", 3), stamps=tmp_path / "times.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damage, r"frame1\.png cannot be read as an image"),
        (
            lambda path: write_picture(path, picture(1, 1, np.uint16)),
            r"frame1\.png is grey with 16 bits, but .* is in colour with",
        ),
        (lambda path: write_picture(path, picture(1)), r"frame1\.png is in colour with 8 bits, but .* 16 bits"),
    ],
)
def test_a_picture_unlike_the_first_is_refused_when_it_is_reached(tmp_path: Path, change, message: str):
    folder = write_pictures(tmp_path / "a", 3, 3, np.uint16)
    change(folder / "frame1.png")
    source = ImageFolder(folder, frames_per_second=1.0)
    source.brightness(2 * 10**9)
    for time in (5 * 10**8, 10**9):
        with pytest.raises(RecordingError, match=message):
            source.brightness(time)


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_video_shows_its_frames_at_the_times_of_its_rate(tmp_path: Path, rate: float | None):
    source = Video(write_video(tmp_path / "a.avi"), frames_per_second=rate)
    assert (source.width, source.height, source.start) == (WIDTH, HEIGHT, 0)
    np.testing.assert_array_equal(source.times, np.arange(NUM_PICTURES) * round(1e9 / (rate or 25)))
    for index, time in enumerate(source.times.tolist()):
        np.testing.assert_allclose(source.brightness(time), slow_linear(picture(index)), atol=1e-6)
    first, second = (np.log(0.001 + slow_linear(picture(index))) for index in (2, 3))
    between = source.brightness(int(source.times[2] + source.times[3]) // 2)
    np.testing.assert_allclose(np.log(0.001 + between), (first + second) / 2, atol=1e-4)


def test_a_video_is_seen_in_any_order_and_by_several_threads(tmp_path: Path):
    count = 40
    source = Video(write_video(tmp_path / "a.avi", count), gamma=False)
    order = [0, 39, 38, 5, *np.random.default_rng(0).permutation(count).tolist()]
    with ThreadPoolExecutor(4) as threads:
        shown = list(threads.map(lambda index: source.brightness(int(source.times[index])), order))
    for index, brightness in zip(order, shown, strict=True):
        np.testing.assert_allclose(brightness, picture(index) / 255, atol=1e-6)


def test_a_video_is_decoded_once_where_its_frames_are_asked_for_nearly_in_order(tmp_path: Path, monkeypatch):
    source = Video(write_video(tmp_path / "a.avi", 40))
    monkeypatch.setattr(source, "_open", lambda: pytest.fail("it was opened again"))
    for index in range(0, 36, 4):
        for step in (3, 1, 2, 0):
            source.brightness(int(source.times[index + step]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Path.unlink, r"a\.avi is missing"),
        (lambda path: path.write_bytes(b""), r"a\.avi cannot be decoded as a video"),
        (lambda path: path.write_bytes(b"no video" * 100), r"a\.avi cannot be decoded as a video"),
        (lambda path: write_video(path, 1), r"a\.avi should hold 2 frames or more, but only 1 can be decoded"),
        (lambda path: damage(write_video(path, 60)), r"a\.avi should hold 60 frames, but only \d+ can be decoded"),
    ],
)
def test_files_that_are_no_video_are_refused(tmp_path: Path, change, message: str):
    path = write_video(tmp_path / "a.avi")
    change(path)
    with pytest.raises(RecordingError, match=message) as refused:
        Video(path)
    assert "\n" not in str(refused.value)


def test_a_frame_rate_that_is_none_is_refused_for_a_video(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"has -1 frames per second, .* give it with --frames-per-second"):
        Video(write_video(tmp_path / "a.avi"), frames_per_second=-1.0)


def test_a_run_that_is_missing_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"config\.yml does not exist; give the config.yml of a trained run"):
        TrainedRun(tmp_path / "config.yml")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "cannot be loaded as a trained run"),
        ("[1, 2", "cannot be loaded as a trained run"),
        ("method_name: enerf", "cannot be loaded as a trained run"),
        ("!!python/object:no.such.Thing {}", "cannot be loaded as a trained run .*no"),
    ],
)
def test_files_that_are_no_run_are_refused(tmp_path: Path, content: str, message: str):
    (tmp_path / "config.yml").write_text(content)
    with pytest.raises(RecordingError, match=message) as refused:
        TrainedRun(tmp_path / "config.yml")
    assert "\n" not in str(refused.value)


def train(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: object) -> Path:
    """config.yml of a run of a few steps."""
    command = ["ns-train", *arguments[:1], "--vis", "tensorboard", "--max-num-iterations", 3, *arguments[1:]]
    monkeypatch.chdir(folder)
    monkeypatch.setattr(
        sys, "argv", [str(part) for part in (*command[:4], "--machine.device-type", "cpu", *command[4:])]
    )
    importlib.import_module("nerfstudio.scripts.train").entrypoint()
    (config,) = folder.glob("outputs/*/*/*/config.yml")
    return config


@pytest.mark.slow
def test_a_run_of_this_package_is_rendered_as_its_own_evaluation_does(tmp_path: Path, monkeypatch):
    from nerfstudio.utils.eval_utils import eval_setup

    write_esim(tmp_path / "recording")
    config = train(
        *(monkeypatch, tmp_path, "enerf", "--pipeline.datamanager.event-pairs", 64),
        *("--pipeline.model.log2-table-size", 12),
        *("event-data", "--data", "recording", "--depth-range", 0.5, 4, "--held-out-every", 1),
    )
    pipeline: Any = eval_setup(config)[1]
    views, _ = held_out_views(pipeline)
    run = TrainedRun(config)
    recording = read_recording(tmp_path / "recording")
    assert (run.camera.width, run.camera.height, run.start) == (WIDTH, HEIGHT, 0)
    assert run.camera == recording.camera
    np.testing.assert_array_equal(run.trajectory.positions, recording.trajectory.positions)
    for view in views:
        time = view.time - recording.trajectory.start
        np.testing.assert_allclose(run.brightness(time), view.rendered[..., 0].numpy(), atol=1e-4)
        assert view.depth is not None
        np.testing.assert_allclose(run.depth(time), view.depth[..., 0].numpy(), rtol=1e-3)

    run._model.sensor.response = Gamma(2.2)  # as if brightness were encoded
    encoded = views[0].rendered[..., 0].clamp(min=0).numpy()
    np.testing.assert_allclose(run.brightness(views[0].time - recording.trajectory.start), encoded**2.2, atol=1e-4)
    run = TrainedRun(config)

    time = views[0].time - recording.trajectory.start
    pose = recording.trajectory.poses(torch.tensor([views[0].time])).numpy()[0]
    quaternion = Rotation.from_matrix(pose[:, :3]).as_quat()
    standing = Trajectory(np.array([0, 10]), np.stack([pose[:, 3]] * 2), np.stack([quaternion] * 2))
    crop = replace(run.camera, width=9, height=7)
    there = TrainedRun(config, standing)
    there.camera = crop
    np.testing.assert_allclose(there.brightness(4), run.brightness(time)[:7, :9], atol=1e-4)

    checkpoints = config.parent / "nerfstudio_models"
    for remove, reason in (
        (lambda: [file.unlink() for file in checkpoints.iterdir()], r".* holds no whole checkpoint.*"),
        (checkpoints.rmdir, "its checkpoints are not found"),
    ):
        remove()
        with pytest.raises(RecordingError, match=rf"config\.yml cannot be .* \({reason}\)"):
            TrainedRun(config)
    config.write_text(config.read_text().replace("- recording\n", "- nowhere\n"))
    with pytest.raises(RecordingError, match=r"config\.yml cannot be .* \(.*nowhere does not exist; .*\); give the"):
        TrainedRun(config)


@pytest.mark.slow
def test_a_run_of_another_method_is_rendered_past_its_cameras(tmp_path: Path, monkeypatch):
    """In the world of its data, whatever Nerfstudio turned, moved and scaled it by; without the weights of LPIPS."""
    from nerfstudio.utils.eval_utils import eval_setup

    perceptual_metric = "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity"
    no_weights = (tmp_path / "alexnet.pth").as_uri()
    monkeypatch.setattr(torchvision.models.AlexNet_Weights.DEFAULT.value, "url", no_weights)
    write_pictures(tmp_path / "data")
    eyes = np.array([3.0, -2.0, 5.0]) + np.random.default_rng(0).normal(size=(NUM_PICTURES, 3))
    looks = look_at(eyes, np.array([2.0, 9.0, 4.0]))
    frames = []
    for index, (eye, look) in enumerate(zip(eyes, looks, strict=True)):
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([look.as_matrix() @ np.diag([1, -1, -1]), eye])
        frames.append({"file_path": f"frame{index}.png", "transform_matrix": matrix.tolist()})
    camera = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 31.0, "cx": 12.5, "cy": 8.0, "camera_model": "OPENCV"}
    (tmp_path / "data/transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    with monkeypatch.context() as patch:
        patch.setattr(perceptual_metric, lambda **_: torch.nn.Identity())  # it would download its weights
        config = train(
            *(patch, tmp_path, "nerfacto", "--pipeline.model.implementation", "torch"),
            *("--pipeline.model.log2-hashmap-size", 12, "--pipeline.datamanager.train-num-rays-per-batch", 64),
            *("nerfstudio-data", "--data", "data", "--eval-mode", "all"),
        )
    monkeypatch.chdir(tmp_path)
    run = TrainedRun(config, duration=11 * 10**6)
    assert (run.camera.width, run.camera.height, run.start, run.end) == (WIDTH, HEIGHT, 0, 11 * 10**6)
    assert (run.camera.fx, run.camera.fy, run.camera.cx, run.camera.cy) == (30.0, 31.0, 12.0, 7.5)
    pipeline: Any = eval_setup(config)[1]
    outputs = pipeline.datamanager.train_dataparser_outputs
    for index, name in enumerate(outputs.image_filenames):
        number = int(name.stem.removeprefix("frame"))
        pose = run.trajectory.poses(torch.tensor([index * 10**6])).numpy()[0]
        np.testing.assert_allclose(pose, np.column_stack([looks[number].as_matrix(), eyes[number]]), atol=1e-5)
        rendered = pipeline.model.get_outputs_for_camera(outputs.cameras[index : index + 1])
        expected = linear_from_srgb(rendered["rgb"].numpy())
        np.testing.assert_allclose(run.brightness(index * 10**6), expected, atol=1e-3)
        assert (run.depth(index * 10**6) * outputs.dataparser_scale <= rendered["depth"][..., 0].numpy() + 1e-3).all()
    slow = TrainedRun(config, duration=11 * 10**8).trajectory
    assert np.diff(slow.times).max() == 10**6  # the recording has poses that are close enough to be interpolated
    np.testing.assert_allclose(slow.poses(torch.tensor([3 * 10**8])), run.trajectory.poses(torch.tensor([3 * 10**6])))
