"""Tables and the page of pictures of a recording."""

from __future__ import annotations

import base64
import html
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import torch
from browsers import BROWSER, told_by
from PIL import Image
from recordings import FRAME_TIMES, HEIGHT, WIDTH, image, poses, write_davis, write_esim
from rich.console import Console
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from stripes import recording_of_stripes

from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.event_index import event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.edge_depth import edge_depth
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

"""A browser that draws pages without a screen."""

VOID = {"meta", "img", "br", "input"}


class Page(HTMLParser):
    """What a page holds; fails where a tag is not closed."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.images: list[tuple[str, bytes]] = []
        self.text = ""
        self.references: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        self.references += [
            values[name] or "" for name in ("src", "href", "srcset", "data", "action") if name in values
        ]
        if tag == "img":
            coded = re.fullmatch(r"data:image/(?:png|jpeg);base64,([A-Za-z0-9+/=]+)", values["src"] or "")
            assert coded, "an image that is not within the page"
            self.images.append((values["alt"] or "", base64.b64decode(coded[1])))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def picture(self, name: str) -> np.ndarray:
        (found,) = (content for alt, content in self.images if alt == name)
        return np.asarray(Image.open(io.BytesIO(found)))


def page_of(folder: Path) -> Page:
    return Page(Inspection.of(read_recording(folder)).page())


def as_jpeg(pixels: np.ndarray) -> np.ndarray:
    coded = io.BytesIO()
    Image.fromarray(pixels).save(coded, format="JPEG")
    return np.asarray(Image.open(coded))


def seconds(time: int) -> str:
    return f"{time * 1e-9:.3f} s"


def test_the_page_shows_each_frame_beside_the_events_of_its_time_both_undistorted(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    page = page_of(folder)
    recording = read_recording(folder)
    assert recording.camera.model == "radtan"
    names = [name for name, _ in page.images]
    for i, time in enumerate(FRAME_TIMES.tolist()):
        assert names.index(f"events at {seconds(time)}") == names.index(f"frame at {seconds(time)}") + 1
        matrix, coefficients = recording.camera.matrix, np.array(recording.camera.distortion)
        new_matrix = cv2.getOptimalNewCameraMatrix(matrix, coefficients, (WIDTH, HEIGHT), 0.0)[0]
        expected = cv2.undistort(image(i), matrix, coefficients, newCameraMatrix=new_matrix)
        np.testing.assert_array_equal(page.picture(f"frame at {seconds(time)}"), as_jpeg(expected))
        events = event_picture(index_events(recording), recording.camera, time)
        np.testing.assert_array_equal(page.picture(f"events at {seconds(time)}"), events)
        assert f"frame_{i:08d}.png" in page.text
    assert len(page.images) == 2 * len(FRAME_TIMES) + 3
    assert all(name in " ".join(names) for name in ("event rate over time", "seen from above", "each pixel"))


def test_the_page_loads_nothing(tmp_path: Path):
    folder = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"), channels=3)
    text = Inspection.of(read_recording(folder)).page()
    page = Page(text)
    assert all(reference.startswith("data:") for reference in page.references)
    without_pictures = re.sub(r'"data:[^"]*"', "", text)
    assert not re.search(r"https?:|//|url\(|@import|<script|<link", without_pictures.replace("</", ""))
    assert page.picture(f"frame at {seconds(FRAME_TIMES[0])}").shape == (HEIGHT, WIDTH, 3)


def test_names_are_text_and_never_tags(tmp_path: Path):
    folder = write_esim(tmp_path / "a<b> & [c]")
    text = Inspection.of(read_recording(folder)).page()
    assert "a<b>" not in text and html.escape(str(folder)) in text
    assert Page(text).text.count("a<b> & [c]") >= 2


def test_without_frames_events_are_shown_alone(tmp_path: Path):
    page = page_of(write_esim(tmp_path / "esim", frames=()))
    pictures = [name for name, _ in page.images if " at " in name]
    assert len(pictures) == 6 and all(name.startswith("events at ") for name in pictures)


def shown_in_terminal(inspection: Inspection) -> str:
    shown = io.StringIO()
    inspection.print_tables(Console(file=shown, force_terminal=True, color_system="standard", width=1000))
    return shown.getvalue()


def test_problems_are_on_the_page_and_red_in_the_terminal(tmp_path: Path):
    inspection = Inspection.of(read_recording(write_esim(tmp_path / "esim")))
    page, shown = Page(inspection.page()), shown_in_terminal(inspection)
    problems = find_problems(inspection.recording)
    assert len(problems) > 2 and f"{len(problems)} problems" in page.text
    for problem in problems:
        assert problem.what in page.text and problem.advice in page.text
        assert f"\x1b[31m{problem.what}" in shown and problem.advice in shown


def test_one_problem_is_not_two(tmp_path: Path):
    inspection = Inspection.of(read_recording(write_esim(tmp_path / "esim")))
    page = Page(replace(inspection, problems=inspection.problems[:1]).page())
    assert "1 problem\n" in page.text and inspection.problems[1].what not in page.text


def test_the_absence_of_problems_is_stated(tmp_path: Path):
    inspection = replace(Inspection.of(read_recording(write_esim(tmp_path / "esim"))), problems=[])
    assert len(inspection.unknown) == 2
    for whole in (inspection, replace(inspection, unknown=())):
        page, shown = Page(whole.page()).text, " ".join(shown_in_terminal(whole).split())
        for text in (page, shown):
            assert ("No problems were found." in text) == (not whole.unknown)
            assert ("No problems were found in what can be measured." in text) == bool(whole.unknown)
            assert all(one.sentence in text for one in whole.unknown)


def test_what_is_unknown_about_depth_is_a_problem_and_not_the_end(tmp_path: Path):
    page = page_of(write_davis(tmp_path / "davis"))
    assert "depth range of the scene cannot be measured" in page.text and "--depth-range NEAR FAR" in page.text


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ('{"finished":false}', "was stopped before its end"),
        ('{"note": "\\"finished\\": false", "finished": true}', None),
        ("{}", None),
        ("{", "simulation.json cannot be read as JSON"),
        ("[]", "simulation.json holds a list"),
    ],
)
def test_whether_a_simulation_was_stopped_is_read_and_not_guessed(tmp_path: Path, content: str, what: str | None):
    folder = write_davis(tmp_path / "davis")
    before = find_problems(read_recording(folder))
    (folder / "simulation.json").write_text(content)
    inspection = Inspection.of(read_recording(folder))
    found = [problem.what for problem in inspection.problems]
    assert len(found) == len(before) + 1 + (what is not None), "the depth range is unknown, too"
    assert what is None or what in found[0]
    Page(inspection.page())


def test_numbers_of_a_small_recording(tmp_path: Path):
    inspection = Inspection.of(read_recording(write_esim(tmp_path / "esim", depth=True)))
    found, numbers = inspection.found(), inspection.numbers()
    assert found["format"] == "esim"
    assert found["events"] == "6, 0.110 s to 0.900 s"
    assert found["poses"] == "11, 0.000 s to 1.000 s, usually every 100 ms"
    assert found["frames"] == "3, 0.150 s to 0.750 s, with depth"
    assert (
        found["event camera"] == "24 x 18 pixels, pinhole, field of view 62 x 48 degrees"
    )  # 2 atan(12 / 20), 2 atan(9 / 20)
    assert found["frame camera"] == "the same"
    sensor = inspection.sensor.rows()
    assert sensor["thresholds"].startswith("C_on = 0.5 ± ") and sensor["refractory"] == "the events show none"
    assert sensor["spread"].endswith("not significantly different from 0") and sensor["noise"].startswith("unknown")
    assert sensor["frame bursts"].startswith("none")
    assert numbers["event rate"].startswith("8 per second")
    assert numbers["polarity"] == "66.7 % on, 33.3 % off"
    assert numbers["per pixel"] == "0.0139 events; 99.5 % of the pixels have fewer than two"
    assert numbers["path"] == "0.79 m long, spans 0.79 m"
    assert numbers["near and far"].startswith("0.5 m and 4 m, stated")


def two_cameras(frame_trajectory: Trajectory, trajectory: Trajectory, frame: Path = Path("0.png")) -> EventRecording:
    """A recording without files but for a frame, which comes from a camera of its own."""
    generator = np.random.default_rng(0)
    number = 5000
    times = np.sort(generator.integers(0, 10**9, number))
    events = Events(
        generator.integers(0, 24, number), generator.integers(0, 18, number), times, generator.integers(0, 2, number)
    )
    camera = Camera(24, 18, 20.0, 20.0, 11.5, 8.5)
    frames = Frames((frame,), np.array([500_000_000]), Camera(48, 36, 40.0, 40.0, 23.5, 17.5), frame_trajectory)
    return EventRecording(
        Path("memory"), "test", camera, trajectory, lambda: iter([events]), (), frames=frames, depth_range=(1.0, 3.0)
    )


@pytest.mark.parametrize("amplitude", [0.2, 0.0])
def test_the_depth_of_edges_is_drawn_where_a_camera_moves(amplitude: float):
    events, trajectory, _ = recording_of_points(points_between(1.0, 3.0), shaking(amplitude), TURNING)
    recording = EventRecording(
        Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), (), depth_range=(0.7, 4.0)
    )
    figure = Inspection.of(recording).edge_depth()
    if not amplitude:
        assert figure is None
        return
    assert figure is not None
    views = [view for view in edge_depth(recording, (0.7, 4.0)) if view.depth.any()]
    drawn = [np.ma.asanyarray(axis.images[0].get_array()) for axis in figure.axes if axis.images]
    assert len(drawn) == 3
    for picture, view in zip(drawn, (views[0], views[round((len(views) - 1) / 2)], views[-1]), strict=True):
        np.testing.assert_array_equal(picture.filled(0), view.depth)


def path_drawn(inspection: Inspection) -> np.ndarray:
    """Points of the plot of the trajectory, (n, 2); not a number where nothing is drawn."""
    offsets = [np.ma.asanyarray(points.get_offsets()) for points in inspection.trajectory().axes[0].collections]
    (path,) = (points for points in offsets if len(points) > 100)
    return path.astype(float).filled(np.nan)


def test_extrinsics_are_where_the_frame_camera_is_mounted(tmp_path: Path):
    Image.new("L", (48, 36)).save(tmp_path / "0.png")
    rows = poses()
    trajectory = Trajectory(np.arange(11) * 10**8, rows[:, :3], rows[:, 3:])
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.radians(7.0)]).as_matrix()
    mount[:3, 3] = [0.045, -0.012, 0.003]
    inspection = Inspection.of(two_cameras(trajectory.of_mounted(mount), trajectory, tmp_path / "0.png"))
    numbers = re.findall(r"-?[\d.]+", inspection.found()["extrinsics"])
    np.testing.assert_allclose(np.array(numbers, float), [45.0, -12.0, 3.0, 7.0], atol=0.05)


def test_the_path_is_seen_from_above():
    """On the plane across the cameras' mean up direction, distances are those of the world without the heights."""
    generator = np.random.default_rng(1)
    times = np.arange(0, 21) * 50_000_000
    places = np.cumsum(generator.normal(size=(21, 3)), axis=0)
    upright = Rotation.from_rotvec(np.linspace(0, 1, 21)[:, None] * [0.0, 0.0, 1.0]) * Rotation.from_matrix(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    )  # x right, z ahead along the world's y, y down along the world's -z
    tilt = Rotation.from_rotvec([0.3, -0.2, 0.1])
    trajectory = Trajectory(times, tilt.apply(places), (tilt * upright).as_quat())
    inspection = Inspection.of(replace(two_cameras(trajectory, trajectory), frames=None))
    drawn = path_drawn(inspection)
    first, last = inspection.statistics.edges[[0, -1]]
    seen = torch.from_numpy(np.linspace(first, last, len(drawn)).astype(np.int64))
    world = tilt.inv().apply(trajectory.poses(seen)[:, :, 3].numpy())
    np.testing.assert_allclose(pdist(drawn), pdist(world[:, :2]), atol=1e-9)


def test_no_path_is_drawn_where_there_are_no_poses():
    rows = poses()
    times = np.arange(0, 1_000_000_001, 10_000_000)
    keep = (times < 301_000_000) | (times > 699_000_000)
    path = np.stack([np.interp(times, np.arange(11) * 10**8, column) for column in rows.T], axis=1)[keep]
    trajectory = Trajectory(times[keep], path[:, :3], path[:, 3:])
    inspection = Inspection.of(replace(two_cameras(trajectory, trajectory), frames=None))
    hidden = np.isnan(path_drawn(inspection)).any(axis=1)
    assert 0.38 < hidden.mean() < 0.42
    assert inspection.numbers()["pose coverage"].endswith("1 gap")


MEASURE = """  document.getAnimations().forEach(animation => animation.pause());
  const shown = () => [...document.querySelectorAll(".stack")].map(stack =>
    [...stack.querySelectorAll(".events")].map(picture => Number(getComputedStyle(picture).opacity)));
  const seen = { flick: shown(), flicking: document.getAnimations().length, page: document.documentElement.scrollWidth,
    width: innerWidth, images: [...document.images].map(i => [i.alt, i.complete, i.naturalWidth, i.clientWidth]) };
  document.querySelector("[for=delay-2]").click();
  seen.chosen = shown(); seen.left = document.getAnimations().length;"""


@pytest.mark.sweep(1)
@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
@pytest.mark.parametrize("width", [500, 1280])
def test_a_browser_flicks_between_right_and_wrong_times(tmp_path: Path, width: int):
    """One picture of events is over each frame at a time, and the one whose time is chosen."""
    inspection = Inspection.of(recording_of_stripes(tmp_path, 12_000_000))
    assert inspection.agreement and inspection.agreement.frame_delay
    assert inspection.agreement.frame_delay.value == pytest.approx(12, abs=1)
    assert any("the frames are stamped 1" in problem.what for problem in inspection.problems)
    page = tmp_path / "page.html"
    page.write_text(inspection.page())
    seen = told_by(page, MEASURE, width, tmp_path / "browser")
    assert seen["page"] <= seen["width"]
    assert all(complete and natural and shown for _, complete, natural, shown in seen["images"])
    assert len(seen["flick"]) == 4 and all(sum(shown) == 1 and shown[0] + shown[5] == 1 for shown in seen["flick"])
    assert seen["flicking"] == 8 and seen["left"] == 0 and seen["chosen"] == 4 * [[0, 0, 1, 0, 0, 0]]


@pytest.mark.slow
def test_slider_depth_has_no_problems(slider_depth: Inspection):
    """Its authors state depths of 0.45 to 2.07 m."""
    page = Page(slider_depth.page())
    assert "No problems were found in what can be measured." in page.text
    names = [name for name, _ in page.images]
    assert sum(name.startswith("events on the frame at") for name in names) == 4 * 6
    assert sum(name.startswith("events as stated: 100 %") for name in names) == 3
    assert "clock of poses" in page.text and "agree with the events to 0.8 pixels" in page.text
    depths = re.search(r"near and far([\d.]+) m and ([\d.]+) m, measured", page.text)
    assert depths and 0.2 < float(depths[1]) < 0.45 and 2.07 < float(depths[2]) < 4.0


@pytest.mark.sweep(2)
@pytest.mark.slow
@pytest.mark.parametrize("scene", ["shapes", "carpet"])
@pytest.mark.parametrize("motion", ["shake", "spiral"])
def test_simulated_recordings_have_no_problems(
    tmp_path: Path, scene: Literal["shapes", "carpet"], motion: Literal["shake", "spiral"]
):
    folder = tmp_path / "recording"
    simulate(SimulationSettings(scene, motion=motion, duration=0.6, num_frames=24, width=80, height=60), folder)
    assert find_problems(read_recording(folder)) == []
