"""The simulator against closed forms, OpenCV's projection and what it wrote itself."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.calibration import Camera
from enerf_ns.dataparsers.recording import RecordingError, read_recording
from enerf_ns.scripts.simulate import Simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.render import Renderer
from enerf_ns.simulator.sampling import render_times
from enerf_ns.simulator.scenes import SCENES
from enerf_ns.simulator.trajectories import MOTIONS, look_at

WIDTH, HEIGHT = 48, 36
SHORT: dict[str, Any] = dict(duration=0.3, num_frames=12, width=WIDTH, height=HEIGHT)


def camera_of(width: int, height: int, focal_length: float) -> Camera:
    return Camera(width, height, focal_length, focal_length, width / 2, height / 2)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_ray_of_every_motion_hits_something(scene, motion):
    made = SCENES[scene](np.random.default_rng(0))
    renderer = Renderer(made, camera_of(WIDTH, HEIGHT, WIDTH / 2 / math.tan(math.radians(30))))
    trajectory = MOTIONS[motion](2 * 10**9, made.camera, made.target, np.random.default_rng(1))
    poses = trajectory.poses(torch.linspace(0, 2e9, 40).long()).numpy()
    assert min(renderer.depth(pose).min() for pose in poses) > 0.3


def test_shake_moves_sideways_and_in_height_and_keeps_looking_at_the_target():
    camera, target = np.array([0.0, 0, 0]), np.array([0.0, 2, 0])
    trajectory = MOTIONS["shake"](3 * 10**9, camera, target, np.random.default_rng(0))
    extent = np.ptp(trajectory.positions, axis=0)
    assert (extent[[0, 2]] > 0.4).all() and (extent <= 0.6).all()
    forward = Rotation.from_quat(trajectory.quaternions).apply([0, 0, 1])
    assert forward[:, 1].min() > math.cos(math.radians(15))


def test_look_at_is_upright_with_opencv_axes():
    rotation = look_at(np.array([1.0, 2, 3]), np.array([1.0, 5, 3])).as_matrix()
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


def test_no_pixel_moves_further_than_asked_between_two_renders():
    made = SCENES["shapes"](np.random.default_rng(0))
    camera = camera_of(WIDTH, HEIGHT, 40.0)
    renderer = Renderer(made, camera)
    trajectory = MOTIONS["shake"](2 * 10**8, made.camera, made.target, np.random.default_rng(1))
    stops = np.array([0, 12_345_678, 2 * 10**8])

    def depth(time: int) -> np.ndarray:
        return renderer.depth(trajectory.poses(torch.tensor(time)).numpy())

    times = render_times(camera, trajectory, depth, stops, 0.5)
    assert np.isin(stops, times).all() and (np.diff(times) > 0).all()
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    rays = camera.pixel_directions().reshape(-1, 3)
    furthest = []
    for pose, following in pairwise(poses):
        world = rays * renderer.depth(pose).reshape(-1, 1) @ pose[:, :3].T + pose[:, 3]
        seen = (world - following[:, 3]) @ following[:, :3]
        furthest.append(np.linalg.norm(40 * (seen / seen[:, 2:] - rays), axis=1).max())
    assert 0.4 < max(furthest) < 0.55


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    Simulate(scene="shapes", output_dir=folder, sensor=SensorSettings(contrast_thresholds=(0.2, 0.3)), **SHORT).main()
    return folder


@pytest.fixture(scope="module")
def renderer(recording) -> Renderer:
    """What the recording was rendered with, made again from its seed."""
    scene_rng, _ = np.random.default_rng(0).spawn(2)
    focal_length = json.loads((recording / "simulation.json").read_text())["camera"]["fx"]
    return Renderer(SCENES["shapes"](scene_rng), camera_of(WIDTH, HEIGHT, focal_length))


def written_poses(recording: Path, times: np.ndarray) -> np.ndarray:
    """Interpolated by SciPy from the file."""
    rows = np.loadtxt(recording / "poses_all.txt", skiprows=1)
    rotations = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:]))(times).as_matrix()
    return np.concatenate([rotations, CubicSpline(rows[:, 0], rows[:, 1:4])(times)[..., None]], axis=-1)


def stamps(recording: Path) -> np.ndarray:
    return np.loadtxt(recording / "images" / "image_stamps_ns.txt")


def test_sharp_frames_and_depth_are_seen_from_the_written_trajectory(recording, renderer):
    for k, pose in enumerate(written_poses(recording, stamps(recording))):
        frame = cv2.imread(str(recording / f"images/{k:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert frame is not None and frame.shape == (HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(frame[..., 1] / 255, renderer.brightness(pose), atol=0.51 / 255)
        depth = np.load(recording / f"depth/{k:05d}.npy")
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, renderer.depth(pose), atol=1e-4)


def test_blurred_frames_are_the_mean_of_sharp_ones_over_the_exposure(tmp_path, renderer):
    folder = tmp_path / "fine"
    Simulate(scene="shapes", output_dir=folder, max_displacement=0.1, **SHORT).main()
    for k in (0, 5, 11):
        times = stamps(folder)[k] + 20e6 * ((np.arange(200) + 0.5) / 200 - 0.5)
        mean = np.mean([renderer.brightness(pose) for pose in written_poses(folder, times)], axis=0)
        blurred = cv2.imread(str(folder / f"images_corrupted/{k:05d}.png"), cv2.IMREAD_GRAYSCALE)
        assert blurred is not None
        np.testing.assert_allclose(blurred / 255, mean, atol=3 / 255)
        sharp = renderer.brightness(written_poses(folder, stamps(folder)[k : k + 1])[0])
        assert np.abs(sharp - mean).max() > 20 / 255


def test_events_from_frame_to_frame_rebuild_the_brightness_within_a_threshold(recording, renderer):
    times = stamps(recording)
    poses = written_poses(recording, times)
    rebuilt = np.log(0.001 + renderer.brightness(written_poses(recording, np.zeros(1))[0]))
    for k in range(len(times) - 1):
        x, y, t, p = np.load(recording / f"events/{k:05d}.npy").T
        assert len(t) and (k == 0 or (t > times[k]).all()) and (t <= times[k + 1]).all()
        np.add.at(rebuilt, (y, x), np.where(p > 0, 0.2, -0.3))
        true = np.log(0.001 + renderer.brightness(poses[k + 1]))
        assert (true - rebuilt < 0.2 + 1e-4).all() and (rebuilt - true < 0.3 + 1e-4).all()


def test_layout_is_what_the_reference_code_of_enerf_checks(recording):
    rows = np.load(recording / "poses_bounds.npy")
    assert rows.shape == (12, 17)
    matrices = rows[:, :15].reshape(12, 3, 5)
    np.testing.assert_allclose(np.linalg.det(matrices[:, :, :3]), 1, atol=1e-9)
    np.testing.assert_array_equal(matrices[0, :2, 4], [HEIGHT, WIDTH])
    poses = written_poses(recording, stamps(recording))
    np.testing.assert_allclose(matrices[:, :, 1], poses[:, :, 0], atol=1e-9)
    np.testing.assert_allclose(matrices[:, :, :4:3], np.stack([poses[:, :, 1], poses[:, :, 3]], -1), atol=1e-9)
    assert len(np.loadtxt(recording / "poses_all.txt", skiprows=1)) > 100
    for folder in ("images", "images_corrupted"):
        assert len(list((recording / folder).glob("*.png"))) == len(stamps(recording)) == 12
    files = sorted((recording / "events").glob("*.npy"))
    assert [file.stem for file in files] == [f"{k:05d}" for k in range(12)]
    assert set(np.concatenate([np.load(file)[:, 3] for file in files])) == {-1, 1}


def test_the_recording_is_read_back(recording):
    read = read_recording(recording)
    assert read.contrast_thresholds == (0.2, 0.3)
    assert read.frames is not None and read.blurred_frames is not None and read.depth_range is not None
    np.testing.assert_array_equal(read.frames.times, stamps(recording))
    times = torch.linspace(0, 3e8, 50).long()
    written = torch.from_numpy(written_poses(recording, times.numpy()))
    torch.testing.assert_close(read.trajectory.poses(times), written, atol=1e-9, rtol=0)
    assert len(read.index.events()) == json.loads((recording / "simulation.json").read_text())["num_events"]


def test_the_same_seed_writes_the_same_files_and_another_seed_others(tmp_path):
    settings: dict[str, Any] = dict(
        scene="carpet", motion="spiral", duration=0.2, num_frames=11, exposure_ms=10, width=32, height=24
    )
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        Simulate(output_dir=tmp_path / name, sensor=SensorSettings(seed=seed), **settings).main()
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert len(files) == 3 + 2 * 12 + 2 * 11
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert (tmp_path / "a/images/00000.png").read_bytes() != (tmp_path / "c/images/00000.png").read_bytes()


def test_an_existing_recording_is_not_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(RecordingError, match="mine exists already"):
        Simulate(scene="shapes", output_dir=tmp_path / "mine", **SHORT).main()
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "notes.txt"]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (dict(duration=0.0), "--duration is 0.0, but must be"),
        (dict(num_frames=10), "The layout esim needs at least 11 frames"),
        (dict(exposure_ms=30.0), "The exposure of 30 ms does not fit frames 25 ms apart"),
        (dict(field_of_view=180.0), "--field-of-view is 180.0, but must be"),
        (dict(max_displacement=0.0), "--max-displacement is 0.0, but must be"),
        (dict(width=0), "--width is 0, but must be"),
        (dict(bayer_pattern="RGB"), "--bayer-pattern is RGB, but must be"),
        (dict(scene="nowhere"), "nowhere is neither a preset"),
        (dict(scene=None), "Give either what is to be seen"),
        (dict(from_run=Path("config.yml")), "Give either what is to be seen"),
        (dict(layout="tum_vie"), "1280 x 720"),
        (dict(cameras=Path("nowhere.json"), width=None, height=None), "nowhere.json is missing"),
        (dict(key_frames=Path("nowhere.txt")), "nowhere.txt is missing"),
    ],
)
def test_settings_that_make_no_recording_are_refused(tmp_path, wrong, sentence):
    with pytest.raises(RecordingError, match=sentence):
        Simulate(**{"scene": "shapes", "output_dir": tmp_path / "new", **SHORT, **wrong}).main()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", [dict(contrast_thresholds=(0.25, 0.0)), dict(log_eps=0.0), dict(leak_rate=-1.0)])
def test_sensors_that_cannot_be_are_refused(wrong):
    with pytest.raises(RecordingError, match=f"^{next(iter(wrong))} is .* but must be"):
        SensorSettings(**wrong)


def test_every_layout_is_written_and_read_back(tmp_path):
    camera = {"width": 64, "height": 48, "model": "radtan", "fx": 55.0, "fy": 55.0, "cx": 31.5, "cy": 23.5}
    pose = np.eye(4)
    pose[:3, 3] = 0.05, 0.0, 0.01
    frame_camera = {**camera, "fx": 60.0, "fy": 60.0, "distortion": [0.1, 0.0, 0.0, 0.0]}
    frame_camera["event_camera_from_frame_camera"] = pose.tolist()
    (tmp_path / "cameras.json").write_text(
        json.dumps({"camera": {**camera, "distortion": [-0.1, 0.05, 0.0, 0.0]}, "frame_camera": frame_camera})
    )
    sensor = SensorSettings(refractory_period=100_000, threshold_spread=0.03)
    Simulate(
        tmp_path / "own", "roads", layout="event_recording", cameras=tmp_path / "cameras.json", sensor=sensor,
        color=True, duration=0.2, num_frames=6, exposure_ms=10.0, preview=True,
    ).main()  # fmt: skip
    read = read_recording(tmp_path / "own")
    assert read.refractory_period == 100_000 and read.contrast_thresholds == (0.25, 0.25)
    assert read.frames is not None and read.blurred_frames is not None and len(read.frames.times) == 6
    assert len(read.index) > 1000 and read.camera.model == read.frames.camera.model == "radtan"
    thresholds = np.load(tmp_path / "own/thresholds.npy")
    assert thresholds.shape == (2, 48, 64) and 0.02 < thresholds.std() / thresholds.mean() < 0.04
    scene = SCENES["roads"](np.random.default_rng(0).spawn(2)[0])
    renderer = Renderer(scene, read.frames.camera)
    for file, time in zip(read.frames.filenames, read.frames.times.tolist(), strict=True):
        seen = renderer.brightness(read.frames.trajectory.poses(torch.tensor(time)).numpy())
        picture = cv2.imread(str(file))
        assert picture is not None
        np.testing.assert_allclose(picture[..., ::-1] / 255, seen.clip(0, 1), atol=0.51 / 255)
    assert (tmp_path / "own/preview.mp4").stat().st_size > 1000


def test_a_video_of_pictures_makes_events(tmp_path):
    (tmp_path / "pictures").mkdir()
    for k in range(5):
        picture = np.full((12, 16), 40 * (k + 1), np.uint8)
        cv2.imwrite(str(tmp_path / f"pictures/{k}.png"), picture)
    Simulate(
        tmp_path / "own", str(tmp_path / "pictures"), layout="event_recording", frames_per_second=10.0, gamma=False,
        num_frames=3, exposure_ms=10.0,
    ).main()  # fmt: skip
    change = math.log((200 / 255 + 0.001) / (40 / 255 + 0.001))
    x, p = (np.load(tmp_path / f"own/events/{name}.npy") for name in "xp")
    assert len(x) == 12 * 16 * math.floor(change / 0.25) and (p > 0).all()


@pytest.mark.slow
def test_twice_as_many_renders_make_the_same_events_but_for_a_few(tmp_path):
    """Both rebuild the same brightness, so that a pixel's net count differs by one at most; extrema between renders
    cost the coarser one some pairs of an on and an off event."""
    counts, net = [], []
    for name, displacement in (("coarse", 0.5), ("fine", 0.25)):
        Simulate(tmp_path / name, "shapes", max_displacement=displacement, **SHORT).main()
        x, y, _, p = np.concatenate([np.load(file) for file in sorted((tmp_path / name / "events").glob("*"))]).T
        counts.append(len(x))
        net.append(np.zeros((HEIGHT, WIDTH)))
        np.add.at(net[-1], (y, x), p)
    assert np.abs(net[0] - net[1]).max() <= 1
    assert 0.97 < counts[0] / counts[1] < 1.01
