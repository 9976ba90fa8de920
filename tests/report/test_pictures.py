from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from nerfstudio.cameras.cameras import Cameras
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.event_index import EventIndex, event_picture
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.evaluation.display import shown_numbers
from enerf_ns.evaluation.metrics import KNOWN
from enerf_ns.evaluation.views import HeldOutView
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import Run
from enerf_ns.report.pictures import camera_path, columns_of, side_by_side


def figure_of(views: list[HeldOutView], recording: EventRecording, exponent: float = 1.0) -> Figure:
    return side_by_side(columns_of(views, recording, exponent), views)


def shown(run: Run) -> list[HeldOutView]:
    return held_out_views(run.pipeline)[0]


@pytest.mark.parametrize(("number", "expected"), [(1, [0]), (2, [0, 1]), (3, [0, 1, 2]), (11, [0, 5, 10])])
def test_the_shown_views_are_the_first_the_last_and_those_between(number: int, expected: list[int]):
    assert shown_numbers(number) == expected


ALL = ["held-out frame", "blurred frame", "render", "error", "rendered depth", "spread depth", "true depth", "events"]


def test_the_picture_has_a_column_for_each_thing_that_there_is(run: Run):
    recording, views = run.pipeline.datamanager.eval_dataset.recording, shown(run)

    def titles(views: list[HeldOutView], recording: EventRecording) -> list[str]:
        figure = figure_of(views, recording)
        named = [axis.get_title() for axis in figure.axes if axis.get_title()]
        assert sum(bool(axis.images) for axis in figure.axes) == len(named) * len(views)
        return named

    assert titles(views, recording) == ALL
    assert titles(views[:1], replace(recording, blurred_frames=None)) == [name for name in ALL if name[0] != "b"]
    other_clock = replace(recording, held_out_frames=recording.frames)
    assert titles(views, other_clock) == [name for name in ALL if name not in ("blurred frame", "events")]
    without_depth = [replace(view, recorded_depth=None) for view in views]
    assert titles(without_depth, recording) == [name for name in ALL if name != "true depth"]
    without_frames = [replace(view, recorded=None) for view in without_depth]
    assert titles(without_frames, replace(recording, frames=None, blurred_frames=None)) == ALL[2:3] + ALL[4:6] + ALL[7:]
    unsure = [replace(view, confidence=None, spread_depth=None) for view in views]
    assert titles(unsure, recording) == [name for name in ALL if name != "spread depth"]


def test_the_error_is_render_less_frame_and_both_depths_have_one_scale(run: Run):
    views = shown(run)
    figure = figure_of(views, run.pipeline.datamanager.eval_dataset.recording)
    pictures: Any = [axis.images[0] for axis in figure.axes[: 8 * len(views)]]
    for number, view in enumerate(views):
        row = pictures[8 * number : 8 * number + 8]
        assert view.recorded is not None and view.recorded_depth is not None
        expected = (view.rendered - view.recorded.clamp(0, 1)).mean(-1).numpy()
        np.testing.assert_allclose(row[3].get_array(), expected, atol=1e-6)
        low, high = row[3].get_clim()
        assert low == -high and 0 < high <= np.abs(expected).max() + 1
        depth = np.ma.filled(row[6].get_array(), np.nan)
        np.testing.assert_array_equal(np.isnan(depth), view.recorded_depth[..., 0].numpy() <= 0)
        assert row[4].get_clim() == row[5].get_clim() == row[6].get_clim()


def test_depth_that_is_not_known_is_pale(run: Run):
    view = shown(run)[0]
    assert view.depth is not None
    confidence = torch.linspace(0.0, 1.0, view.depth.numel()).view(view.depth.shape)
    figure = figure_of([replace(view, confidence=confidence)], run.pipeline.datamanager.eval_dataset.recording)
    (depth,) = [axis.images[0] for axis in figure.axes if axis.get_title() == "rendered depth"]
    opacity = np.asarray(depth.get_alpha())
    assert (opacity[confidence[..., 0].numpy() >= KNOWN] == 1).all() and opacity[0, 0] < 0.3
    assert (np.diff(opacity.ravel()) >= 0).all()
    assert "uncertain" in "".join(axis.get_xlabel() for axis in figure.findobj(Axes) if isinstance(axis, Axes))


def test_brightness_is_shown_to_a_power_and_nothing_else_is(run: Run):
    recording, views = run.pipeline.datamanager.eval_dataset.recording, shown(run)[:1]
    as_it_is, brighter = (figure_of(views, recording, exponent).axes for exponent in (1.0, 0.5))
    for title, one, other in zip(ALL, as_it_is, brighter, strict=False):
        expected = np.asarray(one.images[0].get_array())
        if title in ("held-out frame", "blurred frame", "render"):
            expected = np.sqrt(expected)
        np.testing.assert_allclose(np.asarray(other.images[0].get_array()), expected, atol=1e-6)


def test_pictures_on_the_page_have_the_colours_of_the_figure(run: Run):
    """Drawn by matplotlib at the size of the pixels, over the grey of unknown values."""
    views = shown(run)[:1]
    for column in columns_of(views, run.pipeline.datamanager.eval_dataset.recording):
        (picture,) = column.pictures
        assert picture is not None
        height, width = picture.shape[:2]
        figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="#c9ced8")
        opacity: Any = None if column.opacities is None else column.opacities[0]
        kept = {"cmap": column.colours, "vmin": column.limits[0], "vmax": column.limits[1]} if column.bar else {}
        figure.figimage(picture, alpha=opacity, origin="upper", **kept)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        expected = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
        assert np.abs(expected - column.coloured(0)).max() <= 2, column.title


def test_the_legend_has_the_colours_of_brighter_and_darker(run: Run):
    """By a picture of one event of each polarity."""
    events = Events(np.array([1, 2]), np.array([1, 1]), np.array([5, 6]), np.array([1, -1]))
    camera = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
    picture = event_picture(EventIndex.from_events(events, 4, 3), camera, 10)
    figure = figure_of(shown(run)[:1], run.pipeline.datamanager.eval_dataset.recording)
    (legend,) = [legend for axis in figure.axes if (legend := axis.get_legend())]
    colours = {
        text.get_text(): tuple(np.round(255 * np.array(patch.get_facecolor()[:3])).astype(int).tolist())
        for text, patch in zip(legend.get_texts(), legend.get_patches(), strict=True)
    }
    on, off, none = (tuple(picture[1, x].tolist()) for x in (1, 2, 3))
    assert colours == {"brighter (on)": on, "darker (off)": off, "no event": none} and len({on, off, none}) == 3


def cameras(number: int) -> Cameras:
    """Along a curve, looking about; of odd width and height."""
    turns = Rotation.from_rotvec(np.linspace(0, 1, number)[:, None] * [0.0, 1.0, 0.2]).as_matrix()
    places = np.stack([np.arange(number), np.arange(number) ** 2, np.ones(number)], axis=1)
    poses = np.concatenate([turns, places[:, :, None]], axis=2)
    return Cameras(torch.from_numpy(poses).float(), fx=30.0, fy=32.0, cx=16.5, cy=12.5, width=33, height=25)


def test_the_flight_begins_and_ends_at_held_out_cameras_and_passes_those_between():
    flown = camera_path(cameras(13))
    matrices = np.array([pose["camera_to_world"] for pose in flown["camera_path"]]).reshape(-1, 4, 4)
    assert len(matrices) == flown["fps"] * flown["seconds"] == 100
    poses = cameras(13).camera_to_worlds.numpy()
    np.testing.assert_allclose(matrices[[0, -1], :3], poses[[0, -1]], atol=1e-6)
    np.testing.assert_array_equal(matrices[:, 3], [[0, 0, 0, 1]] * 100)
    np.testing.assert_allclose(matrices[33, :3], poses[4], atol=1e-6)  # a third of the way is the third of 7 places
    np.testing.assert_allclose(matrices[:, 1, 3], matrices[:, 0, 3] ** 2, atol=0.5)


def test_the_picture_of_the_flight_has_even_sides():
    flown = camera_path(cameras(3))
    assert (flown["render_width"], flown["render_height"]) == (32, 24)
    assert flown["camera_path"][0]["fov"] == pytest.approx(math.degrees(2 * math.atan(12 / 32)))
    assert flown["camera_path"][0]["aspect"] == 32 / 24


def test_the_flight_of_a_large_camera_is_reduced_and_sees_as_much():
    large = cameras(3)
    large.rescale_output_resolution(40.0)
    flown = camera_path(large)
    width, height = flown["render_width"], flown["render_height"]
    assert 0.97 * 320 * 240 < width * height <= 320 * 240
    assert width / height == pytest.approx(33 / 25, rel=0.01) and width % 2 == height % 2 == 0
    assert flown["camera_path"][0]["fov"] == pytest.approx(math.degrees(2 * math.atan(12.5 / 32)), rel=0.01)


def test_one_held_out_camera_stands_still():
    flown = camera_path(cameras(1))["camera_path"]
    assert len(flown) == 100 and flown[0]["camera_to_world"] == pytest.approx(flown[-1]["camera_to_world"])
