from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import tyro
from recordings import write_davis, write_esim
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers import event_dataparser
from enerf_ns.dataparsers.formats import registry
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.registry import (
    check_outside_recordings,
    format_named,
    formats,
    layouts,
    open_writer,
    read_recording,
    register,
    writer_of,
)
from enerf_ns.dataparsers.formats.writer import Setup
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.scripts.format_options import format_flags


@dataclass(frozen=True)
class BasketOptions(FormatOptions):
    """Of a format that a user adds."""

    basket: Literal["red", "blue"] = "red"
    """Which of the baskets
    is read."""
    event_camera: Literal["left", "middle"] = "left"
    """Which camera of it."""


def read_basket(folder: Path, basket: str = "red", event_camera: str = "left") -> EventRecording:
    trajectory = Trajectory(np.array([0, 100]), np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    rows = np.array([[1, 2, 5, 1], [1, 2, 6, 0]])
    notes = (f"the {basket} one, {event_camera}",)
    if (folder / "broken").exists():
        raise ValueError("a broken basket.")
    camera = Camera(24, 18, 20.0, 20.0, 12.0, 9.0)
    return EventRecording(folder, "basket", camera, trajectory, lambda: iter([Events(*rows.T)]), (), notes=notes)


BASKET = Format("basket", "basket-events", "Events in baskets.", ("*.basket", "eggs/*"), read_basket, BasketOptions)


@pytest.fixture
def basket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of a format from outside of the package, which is registered during the test."""
    monkeypatch.setattr(registry, "_FORMATS", dict(registry._FORMATS))
    register(BASKET)
    folder = tmp_path / "folder"
    (folder / "eggs").mkdir(parents=True)
    (folder / "a.basket").touch()
    (folder / "eggs/1").touch()
    yield folder
    registry._read_folder.cache_clear()


def test_read_folder_finds_the_format_and_reads_a_folder_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    davis, esim = write_davis(tmp_path / "davis"), write_esim(tmp_path / "esim")
    assert read_recording(davis).format == "davis"
    assert read_recording(esim).format == "esim"
    monkeypatch.chdir(tmp_path)
    assert read_recording("esim") is read_recording(esim)


def test_the_formats_of_the_package():
    assert [format.name for format in formats()] == [
        *("esim", "esim_npz", "esim_bag", "davis", "eds", "tum_vie", "eventnerf", "llff_events", "evimo2", "mvsec"),
        *("vector", "ros_bag", "m3ed", "dsec", "e2nerf", "event_recording"),
    ]
    assert layouts() == ("esim", "eds", "tum_vie", "event_recording")
    for format in formats():
        assert format_named(format.name) is format
        assert format.writer is None or format.writer.layout == format.name
    assert len({format.command for format in formats()}) == len(formats())


def test_a_format_that_does_not_exist(tmp_path: Path):
    with pytest.raises(FlagError, match=r"^The format 'omni' is not known; give one of esim, .*, or auto to"):
        read_recording(tmp_path, "omni")


def test_a_format_from_outside_is_found_and_named(basket: Path):
    assert formats()[-1] is BASKET
    assert read_recording(basket).notes == ("the red one, left",)
    assert read_recording(basket, "basket", basket="blue").notes == ("the blue one, left",)
    assert read_recording(basket, basket="blue", event_camera="middle").notes == ("the blue one, middle",)
    parser = event_dataparser.EventDataParserConfig(data=basket).setup()
    assert parser.recording().format == "basket"
    config = event_dataparser.specification(BASKET).config
    assert config == event_dataparser.EventDataParserConfig(format="basket", options=BasketOptions())
    assert event_dataparser.basket_events.config == config  # type: ignore[attr-defined]


@pytest.mark.parametrize("taken", [{"name": "esim"}, {"command": "eds-events"}])
def test_names_that_are_taken_are_refused(basket: Path, taken: dict):
    with pytest.raises(ValueError, match="already; give this one other names"):
        register(replace(BASKET, **{"name": "new", "command": "new-events", **taken}))


def test_no_format_is_named_as_the_search_for_one(basket: Path):
    with pytest.raises(ValueError, match=r"^A format cannot be named auto, which"):
        register(replace(BASKET, name="auto", command="auto-events"))


def test_values_that_do_not_check_as_sound_are_named_by_the_folder(basket: Path):
    (basket / "broken").touch()
    with pytest.raises(RecordingError, match=rf"^{basket} holds a broken basket\.$"):
        read_recording(basket)


def test_options_that_the_format_lacks(basket: Path, tmp_path: Path):
    esim = write_esim(tmp_path / "esim")
    with pytest.raises(FlagError, match=r"^--basket is for recordings of basket, but .*esim is read as esim; leave it"):
        read_recording(esim, basket="red")
    with pytest.raises(FlagError, match=r"^--event-camera is for recordings of tum_vie.* and basket, but .* as esim"):
        read_recording(esim, "esim", event_camera="left")
    with pytest.raises(FlagError, match=r"^--event-camera right is no choice for .* basket, .*; .* of left, middle, "):
        read_recording(basket, event_camera="right")  # a choice of other formats
    with pytest.raises(FlagError, match=r"^--lid-open is no option of any format, but .* is read as basket"):
        read_recording(basket, lid_open=True)


def test_flags_are_made_from_the_options_of_all_formats(basket: Path, capsys: pytest.CaptureFixture[str]):
    flags = format_flags()
    assert tyro.cli(flags, args=[]).given() == {}
    assert tyro.cli(flags, args=["--event-camera", "right"]).given() == {"event_camera": "right"}
    given = tyro.cli(flags, args=["--event-camera", "middle", "--basket", "blue"]).given()
    assert given == {"event_camera": "middle", "basket": "blue"}
    with pytest.raises(SystemExit):
        tyro.cli(flags, args=["--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "For a recording of basket: Which of the baskets is read. Default: red." in shown
    assert "For a recording of tum_vie: The event camera that is read" in shown


def test_a_layout_that_can_only_be_read():
    with pytest.raises(FlagError, match=r"The layout davis can only be read; give one of esim, eds, tum_vie, event_"):
        writer_of("davis")


def test_writers_state_what_their_layout_asks_for(tmp_path: Path):
    assert {layout: writer_of(layout).fewest_frames for layout in layouts()} == {
        **{"esim": 11, "eds": 1, "tum_vie": 1, "event_recording": 1},
    }
    assert [layout for layout in layouts() if writer_of(layout).poses_per_second] == ["tum_vie"]
    for layout in layouts():
        rig = writer_of(layout).published_rig
        assert (rig is not None) == (layout in ("eds", "tum_vie"))
        if rig is not None:
            times = np.arange(3) * 10**8
            setup = Setup(*rig, None, times, 0, (0.2, 0.2))
            (tmp_path / layout).mkdir()
            with open_writer(layout, tmp_path / layout, setup) as writer:
                assert writer.layout == layout


def test_the_published_cameras_of_tum_vie_are_those_of_its_calibration(shared_data):
    stated = json.loads((shared_data / "tum_vie/camera-calibrationA.json").read_text())["value0"]
    rig = writer_of("tum_vie").published_rig
    assert rig is not None
    event_camera, frame_camera, event_from_frame = rig
    poses = []
    for index, camera in ((2, event_camera), (0, frame_camera)):
        lens = stated["intrinsics"][index]["intrinsics"]
        assert [camera.width, camera.height] == stated["resolution"][index] and camera.model == "fisheye"
        assert (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion) == tuple(lens.values())
        mount, pose = stated["T_imu_cam"][index], np.eye(4)
        pose[:3, :3] = Rotation.from_quat([mount[f"q{axis}"] for axis in "xyzw"]).as_matrix()
        pose[:3, 3] = [mount[f"p{axis}"] for axis in "xyz"]
        poses.append(pose)
    np.testing.assert_allclose(poses[0] @ event_from_frame, poses[1], atol=1e-12)


@pytest.mark.parametrize("bags", [("a.bag", "b/b.db3"), ("a/a.mcap", "b/b.db3"), ("a.bag", "b.mcap")])
def test_a_folder_of_bags_may_hold_results(tmp_path: Path, bags: tuple[str, ...]):
    """Beside them, not within the folder of one."""
    for bag in bags:
        (tmp_path / bag).parent.mkdir(exist_ok=True)
        (tmp_path / bag).touch()
    check_outside_recordings("--output-dir", tmp_path / "results/new")
    for file in ("metadata.yaml", "b.db3"):
        (tmp_path / "b").mkdir(exist_ok=True)
        (tmp_path / "b" / file).touch()
    with pytest.raises(OutputError, match=r"lies within the recording .*b, which is never written to"):
        check_outside_recordings("--output-dir", tmp_path / "b/new")


def test_a_folder_that_is_removed_while_it_is_looked_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As temporary folders are, which other processes make beside an output."""
    write_esim(tmp_path / "esim")
    (tmp_path / "esim/train0").mkdir()
    scandir = os.scandir

    def removed_first(path: Path | str):
        if Path(path).name == "train0":
            Path(path).rmdir()
        return scandir(path)

    monkeypatch.setattr(os, "scandir", removed_first)
    with pytest.raises(OutputError, match="lies within the recording"):
        check_outside_recordings("--output-dir", tmp_path / "esim/new")
    assert not (tmp_path / "esim/train0").exists()
