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

from enerf_ns.dataparsers.recording import RecordingError, read_recording
from enerf_ns.scripts.simulate import Simulate, render_times
from enerf_ns.simulator import textures
from enerf_ns.simulator.esim import EventGenerator
from enerf_ns.simulator.render import HAS_EMBREE, Renderer, embree_caster, numba_caster
from enerf_ns.simulator.scenes import SCENES, Scene
from enerf_ns.simulator.trajectories import MOTIONS, look_at

WIDTH, HEIGHT = 48, 36
SHORT: dict[str, Any] = dict(duration=0.3, num_frames=12, width=WIDTH, height=HEIGHT)


def plane(depth: float, image: np.ndarray) -> Scene:
    """A plane z = depth of 4 by 4 metres, whose texture coordinates are x and y."""
    corners = np.array([[-2, -2, depth], [2, -2, depth], [2, 2, depth], [-2, 2, depth]])
    triangles = corners[[[0, 1, 2], [0, 2, 3]]].astype(np.float32)
    return Scene(
        triangles,
        np.ascontiguousarray(triangles[..., :2]),
        np.ones((2, 3), np.float32),
        np.zeros(2, np.int64),
        textures.mip_pyramid(image)[None],
        np.zeros(3),
        np.array([0.0, 0.0, depth]),
    )


def pose_of(rotation: Rotation, position: list[float]) -> np.ndarray:
    return np.column_stack([rotation.as_matrix(), position])


@pytest.mark.parametrize("change", [1.03, 0.24, -0.97, -0.19, 0.0])
def test_ramp_fires_at_the_times_of_the_closed_form(change):
    on, off, start, duration = 0.25, 0.2, 5_000_000, 1_000_003
    generator = EventGenerator(np.full((3, 4), -1.5), start, (on, off))
    after = np.full((3, 4), -1.5)
    after[1, 2] += change
    events = generator.advance(after, start + duration)
    step = on if change > 0 else off
    count = math.floor(abs(change) / step)
    assert len(events) == count
    expected = [start + math.ceil(n * step / abs(change) * duration) for n in range(1, count + 1)]
    np.testing.assert_allclose(events[:, 2], expected, atol=1)
    np.testing.assert_array_equal(events[:, [0, 1, 3]], np.tile([2, 1, np.sign(change)], (count, 1)))


def test_ramp_in_pieces_fires_as_the_whole_ramp_does():
    whole = EventGenerator(np.zeros((1, 1)), 0, (0.25, 0.25)).advance(np.full((1, 1), 3.1), 700_000)
    generator = EventGenerator(np.zeros((1, 1)), 0, (0.25, 0.25))
    pieces = [generator.advance(np.full((1, 1), 3.1 * n / 7), 100_000 * n) for n in range(1, 8)]
    np.testing.assert_allclose(np.concatenate(pieces), whole, atol=1)


def test_sum_of_events_stays_within_a_threshold_of_the_log_brightness():
    rng = np.random.default_rng(0)
    on, off = 0.3, 0.17
    start = rng.normal(size=(5, 7))
    level, rebuilt, generator = start, start.copy(), EventGenerator(start, 0, (on, off))
    total = 0
    for n in range(1, 60):
        level = level + 0.4 * rng.normal(size=level.shape)
        events = generator.advance(level, 1000 * n)
        assert (events[:, 2] > 1000 * (n - 1)).all() and (events[:, 2] <= 1000 * n).all()
        assert (np.diff(events[:, 2]) >= 0).all()
        np.add.at(rebuilt, (events[:, 1], events[:, 0]), np.where(events[:, 3] > 0, on, -off))
        assert (level - rebuilt < on + 1e-9).all() and (rebuilt - level < off + 1e-9).all()
        total += len(events)
    assert total > 1000


def test_plane_seen_from_the_front_has_its_distance_as_depth_and_its_brightness():
    renderer = Renderer(plane(1.7, np.full((textures.SIZE, textures.SIZE), 0.6)), WIDTH, HEIGHT, 40.0)
    pose = pose_of(Rotation.from_euler("z", 20, degrees=True), [0.1, -0.2, 0.3])
    np.testing.assert_allclose(renderer.depth(pose), 1.4, atol=1e-5)
    np.testing.assert_allclose(renderer.brightness(pose), 0.6, atol=1e-6)


def test_rays_that_hit_nothing_have_depth_and_brightness_zero():
    renderer = Renderer(plane(1.0, textures.plain()), WIDTH, HEIGHT, 40.0)
    away = pose_of(Rotation.from_euler("y", 180, degrees=True), [0, 0, 0])
    assert (renderer.depth(away) == 0).all() and (renderer.brightness(away) == 0).all()


def test_a_dot_is_drawn_where_opencv_projects_it():
    spot = np.array([0.25, -0.125])
    image = np.zeros((textures.SIZE, textures.SIZE))
    column, row = np.round(spot * textures.TEXELS_PER_METRE).astype(int)
    image[row - 4 : row + 4, column - 4 : column + 4] = 1
    renderer = Renderer(plane(2.0, image), 160, 120, 150.0)
    rotation, position = Rotation.from_euler("xyz", [6, -8, 15], degrees=True), np.array([0.2, 0.1, 0.4])
    drawn = renderer.brightness(pose_of(rotation, position.tolist()))
    centre = [(drawn * grid).sum() / drawn.sum() for grid in np.meshgrid(np.arange(160), np.arange(120))]
    matrix = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
    world_to_camera = rotation.inv()
    expected, _ = cv2.projectPoints(
        np.array([[*spot, 2.0]]), world_to_camera.as_rotvec(), -world_to_camera.apply(position), matrix, np.zeros(4)
    )
    np.testing.assert_allclose(centre, expected.ravel(), atol=0.05)


def test_a_minified_texture_keeps_its_mean():
    checks = (np.indices((textures.SIZE, textures.SIZE)) // 2).sum(0) % 2
    renderer = Renderer(plane(1.5, checks), WIDTH, HEIGHT, 24.0)
    np.testing.assert_allclose(renderer.brightness(pose_of(Rotation.identity(), [0, 0, 0])), 0.5, atol=0.01)


@pytest.mark.skipif(not HAS_EMBREE, reason="embreex is not installed")
def test_embree_and_numba_hit_the_same():
    scene = SCENES["shapes"](np.random.default_rng(0))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(2000, 3)).astype(np.float32)
    origins = rng.uniform(-0.3, 0.3, (2000, 3)).astype(np.float32)
    embree, numba = embree_caster(scene)(origins, directions), numba_caster(scene)(origins, directions)
    same = embree[0] == numba[0]  # rays along a shared edge may be given to either side
    assert same.mean() > 0.995 and (embree[0] >= 0).all()
    for of_embree, of_numba in zip(embree[1:], numba[1:], strict=True):
        np.testing.assert_allclose(of_embree[same], of_numba[same], atol=1e-3)
    np.testing.assert_allclose(embree[3], numba[3], rtol=1e-4)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_ray_of_every_motion_hits_something(scene, motion):
    made = SCENES[scene](np.random.default_rng(0))
    renderer = Renderer(made, WIDTH, HEIGHT, WIDTH / 2 / math.tan(math.radians(30)))
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
    renderer = Renderer(made, WIDTH, HEIGHT, 40.0)
    trajectory = MOTIONS["shake"](2 * 10**8, made.camera, made.target, np.random.default_rng(1))
    stops = np.array([0, 12_345_678, 2 * 10**8])
    times = render_times(renderer, trajectory, stops, 0.5)
    assert np.isin(stops, times).all() and (np.diff(times) > 0).all()
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    rays = renderer.rays(*np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))).reshape(-1, 3)
    furthest = []
    for pose, following in pairwise(poses):
        world = rays * renderer.depth(pose).reshape(-1, 1) @ pose[:, :3].T + pose[:, 3]
        seen = (world - following[:, 3]) @ following[:, :3]
        furthest.append(np.linalg.norm(40 * (seen / seen[:, 2:] - rays), axis=1).max())
    assert 0.4 < max(furthest) < 0.55


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    Simulate(scene="shapes", output_dir=folder, contrast_thresholds=(0.2, 0.3), **SHORT).main()
    return folder


@pytest.fixture(scope="module")
def renderer(recording) -> Renderer:
    """What the recording was rendered with, made again from its seed."""
    scene_rng, _ = np.random.default_rng(0).spawn(2)
    focal_length = json.loads((recording / "simulation.json").read_text())["camera"]["fx"]
    return Renderer(SCENES["shapes"](scene_rng), WIDTH, HEIGHT, focal_length)


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
    rebuilt = np.log(0.001 + renderer.brightness(poses[0]))
    for k in range(len(times) - 1):
        x, y, t, p = np.load(recording / f"events/{k:05d}.npy").T
        assert len(t) and (t > times[k]).all() and (t <= times[k + 1]).all()
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
        Simulate(output_dir=tmp_path / name, seed=seed, **settings).main()
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


def test_a_simulation_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    with pytest.raises(RecordingError, match="could not be written"):
        Simulate(scene="shapes", output_dir=tmp_path / "new", **SHORT).main()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "wrong",
    [
        dict(duration=0.0),
        dict(num_frames=10),
        dict(exposure_ms=30.0),
        dict(contrast_thresholds=(0.25, 0.0)),
        dict(field_of_view=180.0),
        dict(max_displacement=0.0),
        dict(width=0),
        dict(log_eps=0.0),
    ],
)
def test_settings_that_make_no_recording_are_refused(tmp_path, wrong):
    flag = "--" + next(iter(wrong)).replace("_", "-")
    with pytest.raises(RecordingError, match=f"^{flag} is .* but must be"):
        Simulate(scene="shapes", output_dir=tmp_path / "new", **{**SHORT, **wrong}).main()
    assert not list(tmp_path.iterdir())
