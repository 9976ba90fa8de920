from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import tyro
import yaml
from geometry import distance_to_rays, unproject
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from recordings import EVENTS, FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, poses, write_davis, write_esim
from scipy.interpolate import CubicSpline

from enerf_ns.dataparsers import event_dataparser
from enerf_ns.dataparsers.event_dataparser import (
    EventDataParserConfig,
    split_frames,
)
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.registry import formats, read_recording
from enerf_ns.dataparsers.formats.tum_vie import TumVieOptions
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, exit_with_a_sentence
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.datamanager import EnerfDataManagerConfig
from enerf_ns.method.event_dataset import EventDataset
from enerf_ns.poses.posed_camera import PosedCamera

NEAR, FAR = 0.5, 4.0

FORMATS = {"esim": write_esim, "davis": write_davis}


def parse(folder: Path, split: str = "train", **options) -> DataparserOutputs:
    config = EventDataParserConfig(data=folder, depth_range=(NEAR, FAR), **options)
    with exit_with_a_sentence():
        parser = config.setup()
        return parser.outputs(parser.recording(), split)


@pytest.mark.parametrize("format", FORMATS)
def test_a_camera_ray_through_the_projection_of_a_point_meets_the_point(tmp_path: Path, format: str):
    folder = FORMATS[format](tmp_path / format)
    outputs = parse(folder)
    camera = read_recording(folder).camera.undistorted()
    frames = outputs.metadata["frames"]
    random = np.random.default_rng(0)
    points, rays = [], []
    for i, time in enumerate(frames.times.tolist()):
        for _ in range(5):
            pixel = random.uniform([0, 0], [camera.width - 1, camera.height - 1])
            points.append(unproject(pixel, random.uniform(NEAR, FAR), time, camera))
            coordinates = torch.from_numpy(pixel[::-1] + 0.5).float()
            rays.append(outputs.cameras.generate_rays(camera_indices=i, coords=coordinates))
    bundle = RayBundle(
        origins=torch.stack([ray.origins for ray in rays]),
        directions=torch.stack([ray.directions for ray in rays]),
        pixel_area=torch.ones(len(rays), 1),
    )
    assert distance_to_rays(bundle, np.array(points), outputs).max() < 1e-5


def test_the_ray_of_a_picture_element_goes_through_its_centre(tmp_path: Path):
    """Element [row, column] of a picture is pixel (column, row) of OpenCV."""
    folder = write_esim(tmp_path / "esim")
    outputs = parse(folder)
    rays = outputs.cameras.generate_rays(camera_indices=1, keep_shape=True)
    time = int(outputs.metadata["frames"].times[1])
    camera = read_recording(folder).camera
    for row, column in ((0, 0), (17, 23), (5, 11)):
        point = unproject(np.array([column, row]), 2.0, time, camera)
        assert distance_to_rays(rays[row : row + 1, column], point[None], outputs).max() < 1e-5


@pytest.mark.parametrize("format", FORMATS)
def test_an_event_ray_meets_every_point_that_the_pixel_sees_at_that_time(tmp_path: Path, format: str):
    """With lens distortion for davis; between two poses."""
    folder = FORMATS[format](tmp_path / format)
    outputs, recording = parse(folder), read_recording(folder)
    camera = recording.camera
    posed = PosedCamera(camera, recording.trajectory, outputs.metadata["transform"], outputs.dataparser_scale)
    pixels = np.array([[0, 0], [23, 17], [3, 4], [12, 9]])
    times = np.array([0, 123_456_789, 550_000_001, 1_000_000_000])
    depths = [0.5, 1.0, 2.0, 4.0]
    points = [unproject(p, z, int(t), camera) for p, z, t in zip(pixels, depths, times, strict=True)]
    rays = posed.rays(torch.from_numpy(pixels[:, 1] * 24 + pixels[:, 0]), torch.from_numpy(times))
    assert distance_to_rays(rays, np.array(points), outputs).max() < 1e-5
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(4))


def test_rays_of_events_and_of_frames_agree(tmp_path: Path):
    """At a frame's time, the ray of a pixel is the ray of the picture's element, with the same bookkeeping."""
    folder = write_esim(tmp_path / "esim")
    outputs, recording = parse(folder), read_recording(folder)
    time = int(outputs.metadata["frames"].times[0])
    frame = outputs.cameras.generate_rays(camera_indices=0, keep_shape=True).flatten()
    transform, scale = outputs.metadata["transform"], outputs.dataparser_scale
    event = PosedCamera(recording.camera, recording.trajectory, transform, scale).rays(
        torch.arange(24 * 18), torch.full((24 * 18,), time)
    )
    torch.testing.assert_close(event.origins, frame.origins, rtol=0, atol=1e-6)
    torch.testing.assert_close(event.directions, frame.directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(event.metadata["directions_norm"], frame.metadata["directions_norm"])
    assert event.pixel_area[0].item() == pytest.approx(1 / 20**2)


def test_the_mean_up_direction_of_the_cameras_is_z(tmp_path: Path):
    outputs = parse(write_esim(tmp_path / "esim"))
    up = outputs.cameras.camera_to_worlds[:, :, 1].mean(dim=0)
    torch.testing.assert_close(up / up.norm(), torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=1e-5)


def test_the_transform_that_is_written_takes_the_world_to_the_scene(tmp_path: Path):
    outputs = parse(write_esim(tmp_path / "esim"))
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    written = json.loads((tmp_path / "dataparser_transforms.json").read_text())
    transform, scale = np.array(written["transform"]), written["scale"]
    centres = CubicSpline(POSE_TIMES, poses()[:, :3])(outputs.metadata["frames"].times)
    expected = scale * (centres @ transform[:, :3].T + transform[:, 3])
    np.testing.assert_allclose(outputs.cameras.camera_to_worlds[:, :, 3], expected, atol=1e-6)
    np.testing.assert_allclose(transform[:, :3] @ transform[:, :3].T, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("held_out_every", [2, 3])
def test_splits_share_no_frame_and_leave_none_out(tmp_path: Path, held_out_every: int):
    folder = write_esim(tmp_path / "esim")
    times = {
        split: parse(folder, split, held_out_every=held_out_every).metadata["frames"].times.tolist()
        for split in ("train", "val", "test")
    }
    assert times["val"] == times["test"]
    assert sorted(times["train"] + times["test"]) == FRAME_TIMES.tolist()
    assert len(times["test"]) == 1


@pytest.mark.parametrize("choice", ["blurred", "sharp"])
def test_training_frames_are_blurred_by_default_and_evaluation_is_always_on_sharp_ones(tmp_path: Path, choice):
    folder = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"))
    train = parse(folder, train_frames=choice)
    assert {file.parent.name for file in train.image_filenames} == {
        "blurred": {"images_corrupted"},
        "sharp": {"images"},
    }[choice]
    assert {file.parent.name for file in parse(folder, "test").image_filenames} == {"images"}


@pytest.mark.parametrize(("by", "folder"), [(None, "images"), ("E2VID", "images_corrupted")])
def test_other_methods_train_on_sharp_frames_or_on_those_that_were_made_of_events(tmp_path: Path, by, folder: str):
    recording = read_recording(write_esim(tmp_path / "esim", frames=("images", "images_corrupted")))
    recording = replace(recording, reconstructed_by=by)
    for held_out, expected in ((False, folder), (True, "images")):
        frames, _ = split_frames(recording, EventDataParserConfig(), held_out)
        assert {file.parent.name for file in frames.filenames} == {expected}


def test_frames_exposed_beyond_the_poses_are_not_trained_on_but_are_evaluated(tmp_path: Path):
    """Poses from 0 to 1 s; frames at 0.15, 0.45 and 0.75 s."""
    folder = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"))
    trained = {
        exposure: parse(folder, exposure_ms=exposure, held_out_every=2).metadata["frames"].times.tolist()
        for exposure in (0.0, 290.0, 310.0)
    }
    first, middle, last = FRAME_TIMES.tolist()
    assert trained == {0.0: [first, last], 290.0: [first, last], 310.0: [last]}
    assert parse(folder, "test", exposure_ms=310.0, held_out_every=2).metadata["frames"].times.tolist() == [middle]


@pytest.mark.parametrize("keep", [False, True])
def test_frames_exposed_within_gaps_of_the_poses_are_not_trained_on(keep: bool):
    """A gap from 2 to 3 s; exposures of 80 ms that end where it begins, reach into it, lie in it and begin at its
    end."""
    pose_times = np.concatenate([np.arange(0, 201), np.arange(300, 501)]) * 10_000_000
    positions = np.linspace(0, 1, len(pose_times))[:, None] * [1.0, 0.0, 0.0]
    trajectory = Trajectory(pose_times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(pose_times), 1)))
    times = np.array([1_000, 1_960, 2_500, 2_990, 3_040, 4_000]) * 1_000_000
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, 12.0, 9.0)
    frames = Frames(tuple(map(Path, map(str, times))), times, camera, trajectory).with_exposure(40_000_000)
    into = replace(frames, times=times + np.array([0, 30, 0, 0, 0, 0]) * 1_000_000)
    for given, outside in ((frames, [2, 3]), (into, [1, 2, 3])):
        recording = EventRecording(Path("r"), "test", camera, trajectory, lambda: iter([]), (), blurred_frames=given)
        recording = recording.selected(None, False, keep)
        config = EventDataParserConfig(train_frame_indices=tuple(range(6)), held_out_frame_indices=())
        kept, _ = split_frames(recording, config, held_out=False)
        assert kept.numbers.tolist() == [i for i in range(6) if keep or i not in outside]


def test_frames_none_of_which_has_poses_throughout_are_an_error_of_one_sentence(tmp_path: Path):
    folder = write_esim(tmp_path / "esim", frames=("images_corrupted",))
    frames = read_recording(folder).blurred_frames
    assert frames is not None
    alone = replace(read_recording(folder), blurred_frames=frames.subset(np.array([0])))
    with pytest.raises(RecordingError, match=r"reach beyond the poses.*--exposure-ms 0") as error:
        split_frames(alone, EventDataParserConfig(exposure_ms=5000.0), held_out=False)
    assert "\n" not in str(error.value)


def test_a_recording_without_frames_has_cameras_along_its_trajectory_with_pictures_of_events(tmp_path: Path):
    folder = write_esim(tmp_path / "esim", frames=())
    outputs = {split: parse(folder, split) for split in ("train", "test")}
    for parsed in outputs.values():
        assert len({file.parent for file in parsed.image_filenames}) == 1 and len(parsed.image_filenames) > 1
        assert len(parsed.cameras) == len(parsed.image_filenames)
    assert not set(outputs["train"].image_filenames) & set(outputs["test"].image_filenames)

    dataset = EventDataset(outputs["train"])
    times = outputs["train"].metadata["frames"].times
    late = int(np.flatnonzero(times > EVENTS[-1, 2])[0])
    picture = dataset[late]["image"]
    assert picture.shape == (18, 24, 3)
    drawn = {(x, y): p for x, y, _, p in EVENTS.tolist()}  # the latest event of a pixel is what is seen
    for row, column in np.ndindex(18, 24):
        red, _, blue = picture[row, column].tolist()
        assert np.sign(red - blue) == drawn.get((column, row), 0)
    assert (dataset[0]["image"] == 1).all(), "no event lies before this picture"


def test_frames_are_undistorted_colour_pictures_with_depth_where_there_is(tmp_path: Path):
    davis = write_davis(tmp_path / "davis")
    picture = EventDataset(parse(davis)).get_numpy_image(0)
    recorded = cv2.imread(str(davis / "images/frame_00000000.png"))
    matrix, distortion = (
        np.array([[330.0, 0, 11.5], [0, 340, 8.5], [0, 0, 1]]),
        np.array([-0.14, 0.09, -0.0003, 0.0002]),
    )
    new, _ = cv2.getOptimalNewCameraMatrix(matrix, distortion, (24, 18), 0.0)
    np.testing.assert_array_equal(picture, cv2.undistort(recorded, matrix, distortion, newCameraMatrix=new))

    esim = write_esim(tmp_path / "esim", channels=1, depth=True)
    data = EventDataset(parse(esim, "test"))[0]
    assert data["image"].shape == (18, 24, 3) and data["depth"].shape == (18, 24, 1)
    assert (data["depth"] == 3.0).all()  # the third frame is held out
    assert "depth" not in EventDataset(parse(davis))[0]


@pytest.mark.parametrize(("format", "write"), FORMATS.items())
def test_a_named_format_reads_its_folders_and_no_others(tmp_path: Path, format: str, write):
    folder = write(tmp_path / "recording")
    assert len(parse(folder, format=format).image_filenames) == 2
    other = (write_davis if write is write_esim else write_esim)(tmp_path / "other")
    with pytest.raises(SystemExit, match=str(other)):
        parse(other, format=format)


@pytest.mark.parametrize("format", formats(), ids=lambda format: format.name)
def test_each_format_has_a_sub_command(format: Format):
    found = getattr(event_dataparser, format.command.replace("-", "_"))
    assert isinstance(found, DataParserSpecification) and found.description == format.description
    config = found.config
    assert isinstance(config, EventDataParserConfig)
    assert config == EventDataParserConfig(format=format.name, options=format.options())


def test_a_sub_command_of_no_format_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'omni_events'"):
        _ = event_dataparser.omni_events  # type: ignore[attr-defined]


def test_flags_of_the_data_parser():
    config = tyro.cli(EnerfDataManagerConfig, args=[]).dataparser
    assert config == EventDataParserConfig()
    config = tyro.cli(
        EnerfDataManagerConfig, args=["tumvie-events", "--event-camera", "right", "--data", "x"]
    ).dataparser
    assert config == EventDataParserConfig(data=Path("x"), format="tum_vie", options=TumVieOptions("right"))
    for wrong in (["eds-events", "--event-camera", "right"], ["tumvie-events", "--event-camera", "middle"]):
        with pytest.raises(SystemExit):
            tyro.cli(EnerfDataManagerConfig, args=wrong)


def test_options_are_written_with_a_run(tmp_path: Path):
    config = EventDataParserConfig(data=tmp_path, format="tum_vie", options=TumVieOptions("right"))
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config
    assert yaml.load(yaml.dump(EventDataParserConfig()), Loader=yaml.Loader) == EventDataParserConfig()


def test_a_frame_that_vanished_is_an_error_and_no_picture_of_events(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    recording = read_recording(folder)
    assert recording.frames is not None
    recording.frames.filenames[0].unlink()
    outputs = parse(folder)
    assert outputs.metadata["are_frames"] is True
    with pytest.raises(RecordingError, match=r"00000\.png is missing; an image was expected there"):
        EventDataset(outputs)[0]


@pytest.mark.parametrize("split", ["train", "val"])
def test_a_recording_without_frames_is_known_as_one(tmp_path: Path, split: str):
    outputs = parse(write_esim(tmp_path / "esim", frames=()), split)
    assert outputs.metadata["are_frames"] is False
    assert EventDataset(outputs)[0]["image"].shape == (18, 24, 3)


def test_depth_that_cannot_be_measured_is_an_error_of_one_sentence_that_names_the_flag(tmp_path: Path):
    parser = EventDataParserConfig(data=write_davis(tmp_path / "davis")).setup()
    with pytest.raises(RecordingError, match=r"davis.*depth-range") as error:
        parser.outputs(parser.recording(), "train")
    assert "\n" not in str(error.value)
    with pytest.raises(SystemExit, match="depth-range"):
        parser.get_dataparser_outputs("train")


@pytest.mark.parametrize("flag", [(4.0, 0.5), (0.0, 4.0), (1.0, 1.0), (0.5, float("inf")), (float("nan"), 4.0)])
def test_a_depth_range_that_is_none_is_an_error(tmp_path: Path, flag: tuple[float, float]):
    parser = EventDataParserConfig(data=write_esim(tmp_path / "esim"), depth_range=flag).setup()
    with pytest.raises(FlagError, match="--depth-range is"):
        parser.outputs(parser.recording(), "train")


def frame_numbers(outputs: DataparserOutputs) -> list[int]:
    return [int(path.stem) for path in outputs.image_filenames]


def test_frames_are_chosen_by_number(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    assert frame_numbers(parse(folder)) == [0, 1] and frame_numbers(parse(folder, "val")) == [2]
    chosen = {"train_frame_indices": (1,), "held_out_frame_indices": (0, 2)}
    assert frame_numbers(parse(folder, **chosen)) == [1]
    assert frame_numbers(parse(folder, "val", **chosen)) == [0, 2]
    assert frame_numbers(parse(folder, held_out_frame_indices=(0,))) == [1, 2]


def test_frame_numbers_count_those_without_a_pose(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    rows = (folder / "0_poses_all.txt").read_text().splitlines()
    (folder / "0_poses_all.txt").write_text("\n".join([rows[0], *rows[4:]]))  # begin after the first frame
    assert frame_numbers(parse(folder, train_frame_indices=(0, 1), held_out_frame_indices=(2,))) == [1]


def test_a_time_range_limits_events_and_frames(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    outputs = parse(folder, time_range=(0.2, 0.8), held_out_every=2)
    recording = outputs.metadata["recording"]
    assert index_events(recording).events().t.tolist() == [t for t in EVENTS[:, 2] if 2e8 <= t <= 8e8]
    assert frame_numbers(outputs) == [1] and frame_numbers(parse(folder, "val", time_range=(0.2, 0.8))) == [1, 2]
    with pytest.raises(FlagError, match=r"--time-range 7 9 \(seconds\) holds none of the poses"):
        read_recording(folder, time_range=(7.0, 9.0))


def test_frames_that_are_stated_for_training_are_not_held_out_by_default(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    assert frame_numbers(parse(folder, train_frame_indices=(2,))) == [2]
    assert frame_numbers(parse(folder, "val", train_frame_indices=(2,))) == [0, 1]


def test_stated_numbers_choose_among_frames_beside_held_out_views(tmp_path: Path):
    """The views lie on a trajectory of their own, and are evaluated if no numbers are stated."""
    recording = read_recording(write_esim(tmp_path / "esim"))
    assert recording.frames is not None
    recording = replace(recording, held_out_frames=recording.frames.subset(np.array([1])))
    for stated, expected in (((0, 2), [0, 2]), (None, [1])):
        frames, _ = split_frames(recording, EventDataParserConfig(held_out_frame_indices=stated), held_out=True)
        assert frames.numbers.tolist() == expected
    frames, are_frames = split_frames(
        replace(recording, frames=None), EventDataParserConfig(held_out_frame_indices=(0, 2)), held_out=True
    )
    assert frames.numbers.tolist() == [1] and are_frames, "there are no other frames to choose among"


@pytest.mark.parametrize(
    ("split", "options", "message"),
    [
        ("train", {"train_frame_indices": (98, 99)}, r"train-frame-indices 98 99 chooses none .* numbers from 0 to 2;"),
        ("val", {"held_out_frame_indices": (99,)}, r"held-out-frame-indices 99 chooses none .* numbers from 0 to 2;"),
        ("val", {"train_frame_indices": (0, 1, 2)}, r"train-frame-indices takes all frames of .*none is held out;"),
        ("train", {"held_out_frame_indices": (0, 1, 2)}, r"held-out-frame-indices takes all .*none is left to train"),
        ("train", {"time_range": (0.2, 0.4)}, r"time-range holds none .* lie from 0\.150000 s to 0\.\d+ s;"),
    ],
)
def test_frames_that_a_flag_does_not_leave_are_one_sentence(tmp_path: Path, split: str, options: dict, message: str):
    """In place of a split with frames of the other one, or of other times."""
    config = EventDataParserConfig(data=write_esim(tmp_path / "esim"), depth_range=(NEAR, FAR), **options)
    with pytest.raises(SystemExit, match=rf"^enerf: event-data --{message}[^.]*\.$"):
        config.setup().get_dataparser_outputs(split)


def test_events_alone_need_no_frame_in_the_time_range(tmp_path: Path):
    """Their cameras are shown, and nothing is learnt from their pictures."""
    outputs = parse(write_esim(tmp_path / "esim"), time_range=(0.2, 0.4), picture_files=False)
    assert len(index_events(outputs.metadata["recording"])) and len(outputs.cameras)


OUTSIDE = {
    **{
        f"{name} {value}": {name: value}
        for name in ("exposure_ms", "downscale_factor")
        for value in (np.nan, np.inf, -1)
    },
    **{f"contraction_depth {value}": {"contraction_depth": value} for value in (np.nan, np.inf, 0)},
    **{f"held_out_every {value}": {"held_out_every": value} for value in (0, -3)},
    **{f"box {side}": {"box": (0.0, 0.0, 0.0, side)} for side in (0.0, -1.0, np.nan)},
    **{f"{name} {value}": {name: value} for name in ("time_range", "depth_range") for value in ((0.1, np.inf), (2, 1))},
    "frames": {"held_out_frame_indices": (0, -1)},
    "two": {"box": (0.0, 0.0, 0.0, 1.0), "contraction_depth": 1.0},
}


@pytest.mark.parametrize("options", OUTSIDE.values(), ids=OUTSIDE.keys())
def test_numbers_outside_their_range_are_one_sentence_for_every_method(tmp_path: Path, options: dict):
    config = EventDataParserConfig(data=write_esim(tmp_path / "esim"), **options)
    flag = f"event-data --{[*options][-1].replace('_', '-')}"
    with pytest.raises(SystemExit, match=rf"^enerf: {flag} (is .*, but .*must be .*|contradicts .*)\.$"):
        config.setup().get_dataparser_outputs("train")


def test_a_range_of_time_that_is_not_finite_is_refused_from_python(tmp_path: Path):
    with pytest.raises(FlagError, match="--time-range is 0 inf, but must be from"):
        read_recording(write_esim(tmp_path / "esim"), time_range=(0, np.inf))
