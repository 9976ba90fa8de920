"""The simulator against closed forms, OpenCV's projection and what it wrote itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.formats.registry import read_recording, writer_of
from enerf_ns.dataparsers.formats.writer import Rig
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.simulator import engine
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.trajectories import MOTIONS, sampled

WIDTH, HEIGHT = 48, 36
SHORT: dict[str, Any] = dict(duration=0.3, num_frames=12, width=WIDTH, height=HEIGHT)


def published_rig(layout: str) -> Rig:
    rig = writer_of(layout).published_rig
    assert rig is not None
    return rig


def camera_of(width: int, height: int, focal_length: float) -> Camera:
    return Camera(width, height, focal_length, focal_length, width / 2, height / 2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(SimulationSettings(scene="shapes", sensor=SensorSettings(contrast_thresholds=(0.2, 0.3)), **SHORT), folder)
    return folder


@pytest.fixture(scope="module")
def renderer(recording) -> Renderer:
    """Renderer of the recording, made again from its seed."""
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
    simulate(SimulationSettings(scene="shapes", max_displacement=0.1, **SHORT), folder)
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
    assert len(index_events(read).events()) == json.loads((recording / "simulation.json").read_text())["num_events"]


def test_the_same_seed_writes_the_same_files_and_another_seed_others(tmp_path):
    settings: dict[str, Any] = dict(
        scene="carpet", motion="spiral", duration=0.2, num_frames=11, exposure_ms=10, width=32, height=24
    )
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        simulate(SimulationSettings(sensor=SensorSettings(seed=seed), **settings), tmp_path / name)
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert len(files) == 3 + 2 * 12 + 2 * 11
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert (tmp_path / "a/images/00000.png").read_bytes() != (tmp_path / "c/images/00000.png").read_bytes()


def test_two_that_start_at_once_do_not_write_into_one_folder(tmp_path, monkeypatch):
    def other_is_faster(*arguments):
        (tmp_path / "new").mkdir()
        return view_of(*arguments)

    view_of = engine.view_of
    monkeypatch.setattr(engine, "view_of", other_is_faster)
    with pytest.raises(OutputError, match=r"new cannot be made a folder \(File exists\)"):
        simulate(SimulationSettings("shapes", width=16, height=12, duration=0.02), tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())


def test_an_existing_recording_is_not_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(OutputError, match="mine exists already"):
        simulate(SimulationSettings(scene="shapes", **SHORT), tmp_path / "mine")
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "notes.txt"]


@pytest.mark.parametrize(
    ("error", "wrong", "sentence"),
    [
        (FlagError, dict(duration=0.0), "--duration is 0.0, but must be"),
        (FlagError, dict(num_frames=10), "The layout esim needs at least 11 frames"),
        (FlagError, dict(exposure_ms=30.0), "The exposure of 30 ms does not fit frames 25 ms apart"),
        (FlagError, dict(field_of_view=180.0), "--field-of-view is 180.0, but must be"),
        (FlagError, dict(field_of_view=179.99), "--field-of-view is 179.99 degrees, which makes a camera of .* as no"),
        (FlagError, dict(field_of_view=0.001), "--field-of-view is 0.001 degrees, which makes a camera of .* as no"),
        (FlagError, dict(max_displacement=0.0), "--max-displacement is 0.0, but must be"),
        (FlagError, dict(width=0), "--width is 0, but must be"),
        (FlagError, dict(bayer_pattern="RGB"), "--bayer-pattern is RGB, but must be"),
        (RecordingError, dict(scene="nowhere"), "nowhere is neither a preset"),
        (FlagError, dict(scene=None), "Give either a scene"),
        (FlagError, dict(from_run=Path("config.yml")), "Give either a scene"),
        (FlagError, dict(layout="tum_vie"), "1280 x 720"),
        (RecordingError, dict(cameras=Path("nowhere.json"), width=None, height=None), "nowhere.json is missing"),
        (RecordingError, dict(key_frames=Path("nowhere.txt")), "nowhere.txt is missing"),
        (FlagError, dict(width=30000, height=30000), "30000 x 30000 pixels is too large"),
        (FlagError, dict(num_frames=10**9, exposure_ms=0.0), "0.3 s have no room for 1000000000 frames"),
        (FlagError, dict(duration=0.0999998, num_frames=2, exposure_ms=50.0), "s have no room for 2 frames with exp"),
        (FlagError, dict(duration=0.05, num_frames=1, exposure_ms=60.0), "have no room for 1 frame with exposures of"),
        (FlagError, dict(duration=1e-4), "--duration is 0.0001, but must be"),
        (FlagError, dict(layout="eds"), "--width changes nothing in the layout eds without --cameras"),
        (FlagError, dict(cameras=Path("nowhere.json")), "--width changes nothing beside --cameras"),
        (FlagError, dict(motion="shake", key_frames=Path("keys.txt")), "--motion changes nothing beside --key-frames"),
        (
            FlagError,
            dict(trajectory=Path("a"), key_frames=Path("b")),
            "--trajectory changes nothing beside --key-frames",
        ),
        (FlagError, dict(motion="spiral", trajectory=Path("a")), "--motion changes nothing beside --trajectory"),
        (FlagError, dict(trajectory_unit="us"), "--trajectory-unit changes nothing unless --trajectory is a text file"),
        (FlagError, dict(stamps=Path("a")), "--stamps changes nothing without a folder of images or a video"),
        (FlagError, dict(gamma=False), "--no-gamma changes nothing without a folder of images or a video"),
        (FlagError, dict(scene="a.mp4", layout="event_recording"), "--width changes nothing for pictures"),
        (FlagError, dict(scene=None, from_run=Path("a"), motion="shake"), "--motion changes nothing for a trained run"),
    ],
)
def test_settings_that_make_no_recording_are_refused(tmp_path, error, wrong, sentence):
    with pytest.raises(error, match=sentence):
        simulate(SimulationSettings(**{"scene": "shapes", **SHORT, **wrong}), tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_a_place_where_nothing_can_be_written_is_refused():
    with pytest.raises(OutputError, match=r"^/dev/null/new cannot be made a folder \(.*\); give another"):
        simulate(SimulationSettings("shapes", **SHORT), Path("/dev/null/new"))


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
    simulate(
        SimulationSettings(
            "roads",
            layout="event_recording",
            cameras=tmp_path / "cameras.json",
            sensor=sensor,
            colour=True,
            duration=0.2,
            num_frames=6,
            exposure_ms=10.0,
        ),
        tmp_path / "own",
        preview=True,
    )
    read = read_recording(tmp_path / "own")
    assert read.refractory_period == 100_000 and read.contrast_thresholds == (0.25, 0.25)
    assert read.frames is not None and read.blurred_frames is not None and len(read.frames.times) == 6
    assert len(index_events(read)) > 1000 and read.camera.model == read.frames.camera.model == "radtan"
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


@pytest.mark.parametrize("response", ["linlog", "logarithm:0.01"])
def test_the_response_is_stated_where_the_layout_has_a_place_for_it(tmp_path, response):
    sensor = SensorSettings(response=response)
    simulate(SimulationSettings("roads", layout="event_recording", sensor=sensor, **SHORT), tmp_path / "new")
    assert read_recording(tmp_path / "new").response == response


def test_a_video_of_pictures_makes_events(tmp_path):
    (tmp_path / "pictures").mkdir()
    for k in range(5):
        picture = np.full((12, 16), 40 * (k + 1), np.uint8)
        cv2.imwrite(str(tmp_path / f"pictures/{k}.png"), picture)
    simulate(
        SimulationSettings(
            str(tmp_path / "pictures"),
            layout="event_recording",
            frames_per_second=10.0,
            gamma=False,
            num_frames=3,
            exposure_ms=10.0,
        ),
        tmp_path / "own",
    )
    change = math.log((200 / 255 + 0.001) / (40 / 255 + 0.001))
    x, p = (np.load(tmp_path / f"own/events/{name}.npy") for name in "xp")
    assert len(x) == 12 * 16 * math.floor(change / 0.25) and (p > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["eds", "tum_vie"])
def test_layouts_of_data_sets_have_their_cameras_and_the_trajectory_that_was_rendered(tmp_path, layout):
    simulate(
        SimulationSettings(
            "carpet",
            layout=layout,
            motion="spiral",
            duration=0.02,
            num_frames=2,
            exposure_ms=2.0,
            max_displacement=32.0,
            max_change=9.0,
        ),
        tmp_path / "new",
    )
    read = read_recording(tmp_path / "new")
    event_camera, frame_camera, event_from_frame = published_rig(layout)
    assert read.frames is not None and (read.camera, read.frames.camera) == (event_camera, frame_camera)
    np.testing.assert_array_equal(read.frames.times, [5_000_000, 15_000_000])
    scene_rng, motion_rng = np.random.default_rng(0).spawn(2)
    scene = SCENES["carpet"](scene_rng)
    trajectory = MOTIONS["spiral"](20_000_000, scene.camera, scene.target, motion_rng)
    if layout == "tum_vie":
        trajectory = sampled(trajectory, 120)
    times = torch.linspace(0, 2e7, 50).long()
    if layout == "eds":
        with h5py.File(tmp_path / "new/events.h5") as file:
            stamps = np.loadtxt(tmp_path / "new/images_timestamps.txt")
            assert file["t"][0] < stamps[0] and file["t"][-1] < stamps[-1]  # pyright: ignore[reportIndexIssue]
    else:
        (right,) = tmp_path.glob("new/*/right_images/image_timestamps_right.txt")
        assert right.read_text() == ""
    for found, expected in (
        (read.trajectory, trajectory),
        (read.frames.trajectory, trajectory.of_mounted(event_from_frame)),
    ):
        torch.testing.assert_close(found.poses(times), expected.poses(times), atol=1e-9, rtol=0)


def test_thresholds_are_those_of_the_preset_unless_given(tmp_path):
    for given, expected in ((None, (0.2, 0.2)), ((0.3, 0.4), (0.3, 0.4))):
        folder = tmp_path / str(given)
        simulate(
            SimulationSettings(
                "spiral1", duration=0.1, num_frames=11, exposure_ms=2.0, width=32, height=24, contrast_thresholds=given
            ),
            folder,
        )
        assert read_recording(folder).contrast_thresholds == expected


def test_frames_in_colour_leave_the_events_as_they_are(tmp_path):
    """But for those at pixels that are rendered once more since one of their colours changes more than their mean."""
    counts = []
    for colour in (False, True):
        simulate(SimulationSettings("roads", colour=colour, **SHORT), tmp_path / str(colour))
        counts.append(len(index_events(read_recording(tmp_path / str(colour)))))
    assert counts[0] == pytest.approx(counts[1], rel=0.01)


@pytest.mark.parametrize(("duration", "num_frames"), [(0.3, 12), (2.3, 94)])
def test_frames_are_as_dense_whatever_the_duration(tmp_path, duration, num_frames):
    """Also where the times of rendering are found in several pieces."""
    simulate(SimulationSettings("carpet", motion="spiral", duration=duration, width=16, height=12), tmp_path / "new")
    read = read_recording(tmp_path / "new")
    assert read.frames is not None and len(read.frames.times) == num_frames
    assert read.trajectory.end == round(duration * 1e9)
    assert json.loads((tmp_path / "new/simulation.json").read_text())["motion"] == "spiral"
    stamps = np.concatenate([events.t for events in read.stream_events()])
    assert (np.diff(stamps) >= 0).all() and stamps[-1] > 0.9 * read.trajectory.end


def test_pictures_need_no_layout(tmp_path):
    (tmp_path / "pictures").mkdir()
    for number in range(30):
        picture = np.full((12, 16), 60 + 60 * (number % 3), np.uint8)
        cv2.imwrite(str(tmp_path / "pictures" / f"{number}.png"), picture)
    simulate(SimulationSettings(str(tmp_path / "pictures"), frames_per_second=30), tmp_path / "new")
    assert (tmp_path / "new/recording.json").exists()


def test_a_colour_filter_needs_colours_and_a_layout_for_it(tmp_path):
    with pytest.raises(FlagError, match=r"^--layout esim has no place for a --bayer-pattern; give"):
        simulate(SimulationSettings("roads", bayer_pattern="RGGB", layout="esim", **SHORT), tmp_path / "new")
    with pytest.raises(FlagError, match=r"^--bayer-pattern needs colours, but carpet is grey\.$"):
        simulate(SimulationSettings("carpet", bayer_pattern="RGGB", **SHORT), tmp_path / "new")
    simulate(SimulationSettings("roads", bayer_pattern="RGGB", **SHORT), tmp_path / "new")
    assert read_recording(tmp_path / "new").bayer_pattern == "RGGB"


def test_the_shortest_recordings_have_frames_enough(tmp_path):
    simulate(SimulationSettings("carpet", duration=0.1, width=16, height=12), tmp_path / "new")
    read = read_recording(tmp_path / "new")
    assert read.frames is not None and len(read.frames.times) == 11
