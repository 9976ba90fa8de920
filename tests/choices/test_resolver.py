"""What is used for a scene: what the user set, else what the recording says, else what the method has."""

from __future__ import annotations

import copy
import shutil
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from small_runs import EVENTS, HEIGHT, WIDTH, check_two_steps, small_config

from enerf_ns.bench.numerics.points import CAMERA, TURNING, recording_of_points, shaking
from enerf_ns.choices.brightness import is_colour
from enerf_ns.choices.resolution import Choice, Resolution
from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation
from enerf_ns.method.config import enerf, enerf_paper
from enerf_ns.sensor.response import Logarithm
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings

ENERF: Any = enerf.config.pipeline
PAPER: Any = enerf_paper.config.pipeline
LENS = Camera(WIDTH, HEIGHT, 30.0, 31.0, 15.5, 11.5, (-0.1, 0.01, 0.0, 0.0), "radtan")


@pytest.mark.parametrize("supervision", ["events", "events+frames"])
def test_a_field_of_grey_frames_or_events_alone_has_one_channel(recording, colour_recording, tmp_path, supervision):
    data = colour_recording if supervision == "events" else recording
    config = small_config(data, tmp_path, data__supervision=supervision).resolved()
    assert config.pipeline.resolution.values["model.num_channels"] == 1


def test_what_is_set_is_not_chosen(recording: Path, tmp_path: Path):
    forced = {
        "max_res": 99, "num_levels": 3, "near_plane": 0.05, "num_channels": 3,
        "sampling": "uniform", "opacity_loss_weight": 0.3, "edge_start": True, "view_direction": True,
    }  # fmt: skip
    config = small_config(recording, tmp_path, **{f"model__{name}": value for name, value in forced.items()})
    config.pipeline.model.sensor.contrast_thresholds = (0.1, 0.3)
    config.pipeline.datamanager.dataparser.depth_range = (1.0, 2.0)
    resolution = config.resolved().pipeline.resolution
    filled = resolution.applied_to(config.pipeline)
    assert {name: getattr(filled.model, name) for name in forced} == forced
    assert filled.model.sensor.contrast_thresholds == (0.1, 0.3)
    assert filled.datamanager.dataparser.depth_range == (1.0, 2.0)
    why = {choice.part: choice.why for choice in resolution.choices}
    parts = (
        "threshold per polarity",
        "colour",
        "box",
        "hash grid",
        "proposal network",
        "opacity loss",
        "start from edges",
        "view direction",
    )
    assert {why[part] for part in parts} == {"set by flag"}


def test_the_registered_method_is_left_as_it_was(recording: Path, tmp_path: Path):
    before = copy.deepcopy(enerf.config)
    config = small_config(recording, tmp_path)
    given = copy.deepcopy(config)
    config.save_config()
    config.setup()
    assert config == given and enerf.config == before


def test_frames_that_are_not_there_cannot_be_learnt_from(recording: Path, tmp_path: Path):
    folder = tmp_path / "without_frames"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth"))
    config = small_config(folder, tmp_path / "outputs", data__supervision="events+frames")
    with pytest.raises(SystemExit, match=r"without_frames.*no frames.*--pipeline\.datamanager\.supervision"):
        config.save_config()
    assert not (tmp_path / "outputs").exists()
    check_two_steps(small_config(folder, tmp_path / "outputs"), EVENTS)


@pytest.mark.parametrize(
    ("changes", "held_out_every", "message"),
    [
        ({"model__event_loss": "hubert"}, 4, "--pipeline.model.event-loss is 'hubert', but one of huber, squared"),
        ({"sensor__response": "log"}, 4, "--pipeline.model.response is the response 'log', but linlog, or"),
        ({"sensor__bayer_pattern": "RGBW"}, 4, "--pipeline.model.bayer-pattern is a colour filter 'RGBW', but"),
        ({"sensor__refractory_period_ns": -1}, 4, "--pipeline.model.refractory-period-ns is -1, but"),
        ({}, 0, "event-data --held-out-every is 0, but"),
        ({"data__supervision": "frames"}, 1, "--held-out-every 1 .*11 frames"),
        ({"data__supervision": "events+frames"}, 22, "--held-out-every 22 .*11 frames"),
        ({"sensor__contrast_thresholds": (0.2, 0.0)}, 4, "--pipeline.model.contrast-thresholds is 0.2 0, but"),
    ],
)
def test_flags_that_cannot_be_followed(
    recording: Path, tmp_path: Path, changes: dict, held_out_every: int, message: str
):
    config = small_config(recording, tmp_path, **changes)
    config.pipeline.datamanager.dataparser.held_out_every = held_out_every
    with pytest.raises(SystemExit, match=message):
        config.save_config()
    assert not list(tmp_path.iterdir())


def resolution_of(recording: Path, tmp_path: Path, **changes: Any) -> Resolution:
    return small_config(recording, tmp_path, **changes).resolved().pipeline.resolution


def rows(resolution: Resolution) -> dict[str, Choice]:
    return {choice.part: choice for choice in resolution.choices}


def test_without_flags_the_recording_decides_and_then_the_method(recording: Path, tmp_path: Path):
    resolution = resolve(ENERF, read_recording(recording))
    values, simulated = resolution.values, read_recording(recording)
    assert values["model.sensor.contrast_thresholds"] == simulated.contrast_thresholds
    assert values["datamanager.dataparser.depth_range"] == simulated.depth_range
    assert values["model.sensor.response"] == simulated.response and values["model.sensor.bayer_pattern"] == "grey"
    assert values["datamanager.pair_mode"] == "partner" and values["model.num_channels"] == 1
    assert values["datamanager.event_pairs"] + values["datamanager.instant_pairs"] == 1024 + 341
    assert values["datamanager.instant_pairs"] == 682 and values["datamanager.silent_pairs"] == 0
    paper = resolve(PAPER, read_recording(recording)).values
    assert paper["datamanager.event_pairs"] == 30096 and paper["datamanager.silent_pairs"] == 0
    assert paper["model.event_loss"] == "squared" and "datamanager.pair_mode" not in paper
    assert rows(resolution)["threshold per polarity"].why == "the recording states them"


def test_frames_take_no_more_rays_of_a_step_than_silent_pixels_give_up(recording: Path):
    def drawn(config, supervision: str) -> tuple[int, int, int]:
        config = copy.deepcopy(config)
        config.datamanager.supervision = supervision
        values = resolve(config, read_recording(recording)).values
        beside = values["datamanager.instant_pairs"] + values["datamanager.silent_pairs"]
        return values["datamanager.event_pairs"], beside, values["datamanager.train_num_rays_per_batch"]

    alone, both = drawn(ENERF, "events"), drawn(ENERF, "events+frames")
    assert 2 * sum(alone[:2]) == 2 * sum(both[:2]) + both[2] and both[1] > 0 < both[2]
    assert drawn(ENERF, "frames")[1:] == (0, 1024)
    assert drawn(PAPER, "events+frames")[1:] == (0, 30096)


def test_any_instants_are_paired_where_events_alone_are_learnt_from_and_pixels_see_all(recording: Path):
    def chosen(**changes: Any) -> Resolution:
        config = copy.deepcopy(ENERF)
        for name, value in changes.items():
            part, field = name.split("__")
            owner = {"data": config.datamanager, "sensor": config.model.sensor}[part]
            setattr(owner, field, value)
        return resolve(config, read_recording(recording))

    def pairs(**changes: Any) -> int:
        return chosen(**changes).values.get("datamanager.instant_pairs", changes.get("data__instant_pairs", -1))

    assert pairs() == 682 and pairs(data__event_pairs=100) == 100 and pairs(data__instant_pairs=7) == 7
    assert chosen(data__instant_pairs=0).values["datamanager.silent_pairs"] == 341
    for what, changes in {
        "frames": {"data__supervision": "events+frames"},
        "blind": {"sensor__refractory_period_ns": 8_000_000},
    }.items():
        row = rows(chosen(**changes))["any instants"]
        assert pairs(**changes) == 0 and not row.kept and what in row.why
    assert pairs(data__silent_pairs=5) == pairs(data__pair_mode="window") == 0
    assert resolve(PAPER, read_recording(recording)).values["datamanager.instant_pairs"] == 0


def test_instants_too_close_for_a_change_are_refused(recording: Path):
    config = copy.deepcopy(ENERF)
    config.datamanager.instants_apart_ms = 0.01
    with pytest.raises(FlagError, match=r"instants-apart-ms is 0\.01, but 0\.1 or more was expected.*instant-pairs 0"):
        resolve(config, read_recording(recording))
    config.datamanager.instant_pairs = 0
    resolve(config, read_recording(recording))


def test_any_instants_are_the_less_far_apart_the_noisier_events_are(recording: Path):
    apart = {}
    for name, polarity in {
        "regular": np.broadcast_to(np.where(np.arange(96) % 2, 1, -1)[:, None], (96, WIDTH * HEIGHT)),
        "noisy": np.random.default_rng(0).choice([-1, 1], (96, WIDTH * HEIGHT)),
    }.items():
        config = copy.deepcopy(ENERF)
        config.model.sensor.refractory_period_ns = 0
        unknown = of_unknown_sensor(recording, polarity)
        apart[name] = resolve(config, unknown).values["datamanager.instants_apart_ms"]
        first, last = index_events(unknown).span
        assert apart[name] <= 1e-6 * (last - first)
    assert apart["noisy"] < 0.5 * apart["regular"]


def test_thresholds_that_nobody_states_come_from_the_counts(recording: Path, tmp_path: Path):
    unknown = replace(read_recording(recording), contrast_thresholds=None)
    resolution = resolve(ENERF, unknown)
    on, off = resolution.values["model.sensor.contrast_thresholds"]
    index = index_events(unknown)
    assert on * index.num_positive == pytest.approx(off * (len(index) - index.num_positive))
    assert f"{index.num_positive:,} on" in rows(resolution)["threshold per polarity"].why


def of_unknown_sensor(recording: Path, polarity: np.ndarray) -> EventRecording:
    """Events of all pixels at once, at times drawn from 80 ms, of a polarity of the shape (events, pixels); frames as
    recorded."""
    number, pixels = polarity.shape
    instants = np.sort(np.random.default_rng(1).integers(10_000_000, 90_000_000, number))
    places, times = np.tile(np.arange(pixels), number), np.repeat(instants, pixels)
    events = Events(places % WIDTH, places // WIDTH, times, polarity.reshape(-1).astype(np.int8))
    return replace(
        read_recording(recording), contrast_thresholds=None, response=None, stream_events=lambda: iter([events])
    )


def of_blind_sensor(recording: Path, blind_ns: int) -> EventRecording:
    """Simulated events of all pixels over 80 ms, in which the brightness of each goes up and down by itself; their
    sensor states its refractory period."""
    rates = np.random.default_rng(0).uniform(2e-7, 1e-6, (3, HEIGHT, WIDTH))

    def picture(time: int) -> np.ndarray:
        return np.exp(-1.5 + 0.6 * np.sin(rates * time).sum(axis=0))

    times = np.arange(10_000_000, 90_000_000, 20_000).tolist()
    sensor = EventSensor(
        SensorSettings(contrast_thresholds=(0.2, 0.2), refractory_period=blind_ns), picture(times[0]), times[0]
    )
    parts = [sensor.advance(picture(time), time) for time in times[1:]] + [sensor.finish()]
    events = Events(*(np.concatenate([getattr(part, column) for part in parts]) for column in "xytp"))
    return replace(
        read_recording(recording),
        contrast_thresholds=(0.2, 0.2),
        response="logarithm:0.001",
        refractory_period=blind_ns,
        stream_events=lambda: iter([events]),
    )


def test_missed_changes_are_added_where_events_tell_them(recording: Path):
    """Of brightness with periods of 6 to 31 ms: where pixels are blind for 0.1 ms and for 4 ms."""
    for blind, kept in ((100_000, True), (4_000_000, False)):
        scene = of_blind_sensor(recording, blind)
        resolution = resolve(ENERF, scene)
        values, row = resolution.values, rows(resolution)["missed changes"]
        assert values["datamanager.completed_refractory_ns"] == (blind if kept else 0) and row.kept == kept
        assert values["datamanager.pair_mode"] == ("partner" if kept else "successor")
        assert bool(values["datamanager.instant_pairs"]) == kept
        assert (values.get("poses.refine_clock") is False) == (not kept)
        assert "squared thresholds an event" in row.why
        exact = resolve(PAPER, scene)
        assert (
            exact.values["datamanager.completed_refractory_ns"] == 0 and "method" in rows(exact)["missed changes"].why
        )
        config = copy.deepcopy(ENERF)
        config.datamanager.completed_refractory_ns = 0 if kept else blind
        forced = resolve(config, scene)
        assert forced.values["datamanager.pair_mode"] == ("successor" if kept else "partner")
        assert rows(forced)["missed changes"].why == "set by flag"
    assert "not known to be blind" in rows(resolve(ENERF, read_recording(recording)))["missed changes"].why
    contradicted = replace(of_blind_sensor(recording, 100_000), refractory_period=2_000_000)
    row = rows(resolve(ENERF, contradicted))["missed changes"]
    assert not row.kept and "within the refractory period" in row.why


def test_missed_changes_are_added_only_for_a_refractory_period_that_is_known_and_stays(recording: Path):
    scene, config = of_blind_sensor(recording, 100_000), copy.deepcopy(ENERF)
    config.model.sensor.learn_refractory_period = True
    resolution = resolve(config, scene)
    values = resolution.values
    assert values["datamanager.completed_refractory_ns"] == 0 and values["datamanager.pair_mode"] == "successor"
    assert "is learned" in rows(resolution)["missed changes"].why
    for is_learned, completed, expected in (
        (True, 100_000, "is 100000, but 0 was expected"),
        (False, 90_000, "is 90000, but 0, or the refractory period of 100000, was expected"),
    ):
        config.model.sensor.learn_refractory_period = is_learned
        config.datamanager.completed_refractory_ns = completed
        with pytest.raises(FlagError, match=f"^--pipeline.datamanager.completed-refractory-ns {expected}"):
            resolve(config, scene)


def test_of_noisy_events_frames_have_more_rays_at_less_cost(recording: Path):
    """Events that alternate cancel; of events with a polarity drawn by chance, each adds its square."""
    drawn = {}
    for name, polarity in {
        "regular": np.broadcast_to(np.where(np.arange(96) % 2, 1, -1)[:, None], (96, WIDTH * HEIGHT)),
        "noisy": np.random.default_rng(0).choice([-1, 1], (96, WIDTH * HEIGHT)),
    }.items():
        config = copy.deepcopy(ENERF)
        config.datamanager.supervision, config.datamanager.silence_ms = "events+frames", 0.001
        config.model.sensor.refractory_period_ns = 0
        resolution = resolve(config, of_unknown_sensor(recording, polarity))
        values = resolution.values
        assert ("noisy" in rows(resolution)["frame loss"].why) == (name == "noisy")
        names = ("event_pairs", "silent_pairs", "train_num_rays_per_batch")
        drawn[name] = np.array([values[f"datamanager.{name}"] for name in names])
    assert (drawn["noisy"] / drawn["regular"])[:2].tolist() == [0.25, 0.25] and drawn["noisy"][2] > drawn["regular"][2]
    assert drawn["noisy"] @ (2, 2, 1) < drawn["regular"] @ (2, 2, 1)


def test_the_response_is_learned_where_frames_tell_it_and_nobody_states_it(recording: Path):
    regular = np.where(np.arange(96) % 4 < 2, 1, -1)[:, None]
    unknown = of_unknown_sensor(recording, np.broadcast_to(regular, (96, WIDTH * HEIGHT)))

    def chosen(supervision: str, response: str | None, made: EventRecording) -> tuple[bool, str]:
        config = copy.deepcopy(ENERF)
        config.datamanager.supervision, config.model.sensor.response = supervision, response
        resolution = resolve(config, made)
        row = rows(resolution)["response"]
        return resolution.values["model.sensor.learn_response"], f"{row.value}; {row.why}"

    assert chosen("events", None, unknown)[1].startswith("logarithm:0.01; pixels see the logarithm of brightness")
    learned, said = chosen("events+frames", None, unknown)
    assert learned and "learned, starting from linlog" in said and "frames determine it better" in said
    for supervision, response, made in (
        ("events", None, unknown),
        ("events+frames", "logarithm:0.1", unknown),
        ("events+frames", None, replace(unknown, response="logarithm:0.1")),
        ("events+frames", None, replace(unknown, contrast_thresholds=(0.2, 0.2))),
    ):
        learned, said = chosen(supervision, response, made)
        assert not learned and "learned" not in said


def test_where_pixels_see_much_of_log_brightness_events_alone_are_learnt_from_with_linlog(recording: Path):
    """Of pixels that go up by 24 events, and down again, twice."""
    rises = np.repeat([1, -1, 1, -1], 24)[:, None] * np.broadcast_to(1, (96, WIDTH * HEIGHT))
    unknown = of_unknown_sensor(recording, rises)
    resolution = resolve(ENERF, unknown)
    response, high = (rows(resolution)[part] for part in ("response", "high dynamic range"))
    assert high.value == "exponential" and response.value == "linlog" and "log brightness" in response.why


def test_frames_beside_events_have_the_weight_that_their_errors_make(recording: Path):
    for supervision, given, expected in (
        ("events", None, 10.0),
        ("frames", None, 10.0),
        ("events+frames", None, None),
        ("events+frames", 3.0, 3.0),
    ):
        config = copy.deepcopy(ENERF)
        config.datamanager.supervision, config.model.frame_loss_weight = supervision, given
        resolution = resolve(config, read_recording(recording))
        assert resolution.applied_to(config).model.frame_loss_weight == expected
        assert ("errors of events and frames" in rows(resolution)["frame loss"].value) == (expected is None)


def test_what_the_recording_states_of_its_sensor_is_used(recording: Path, tmp_path: Path):
    stated = replace(
        read_recording(recording), response="logarithm:0.01", refractory_period=3_000_000, bayer_pattern="RGGB"
    )
    config = copy.deepcopy(ENERF)
    assert resolve(config, stated).values["model.sensor.response"] == "logarithm:0.01"
    assert resolve(PAPER, stated).values["model.sensor.response"] == "linlog", "the paper's"
    config.datamanager.supervision = "events+frames"
    resolution = resolve(config, stated)
    sensor = resolution.applied_to(config).model.sensor.setup()
    assert sensor.response == Logarithm(0.01) and sensor.refractory_period == 3_000_000
    assert sensor.colour_filter is not None and resolution.values["model.num_channels"] == 3
    assert resolution.values["datamanager.pair_mode"] == "successor"
    assert rows(resolution)["response"].why == "the recording states it"


def test_what_a_method_sets_is_said_to_be_set_by_it(recording: Path):
    """Until a flag says otherwise; of enerf nothing is."""
    parts = ("high dynamic range", "hash grid", "proposal network", "opacity loss", "start from edges", "contraction")
    parts += ("view direction",)
    said = rows(resolve(PAPER, read_recording(recording)))
    assert {said[part].why for part in parts} == {"set by the method"}
    config = copy.deepcopy(PAPER)
    config.model.sampling, config.model.opacity_loss_weight = "proposal", 0.5
    said = rows(resolve(config, read_recording(recording)))
    assert said["proposal network"].why == said["opacity loss"].why == "set by flag"
    assert said["contraction"].why == "set by the method"
    assert not any("set by" in row.why for row in rows(resolve(ENERF, read_recording(recording))).values())


@pytest.mark.parametrize(
    ("mode", "window_ms", "expected"),
    [("accumulated", None, 5.0), ("accumulated", 7.0, 7.0), ("window", None, 60.0), ("window", 8.0, 8.0)],
)  # a tenth of a second is recorded
def test_windows_are_as_long_as_is_said(recording: Path, mode: str, window_ms: float | None, expected: float):
    config = copy.deepcopy(ENERF)
    config.datamanager.pair_mode, config.datamanager.window_ms = mode, window_ms
    resolution = resolve(config, read_recording(recording))
    assert resolution.applied_to(config).datamanager.window_ms == pytest.approx(expected)
    assert f"{expected:g} ms" in rows(resolution)["event loss"].value


@pytest.mark.parametrize(
    ("setting", "value", "part"),
    [
        ("sensor__response", "logarithm:0.1", "response"),
        ("sensor__contrast_thresholds", (0.25, 0.25), "threshold per polarity"),
        ("sensor__refractory_period_ns", 1000, "refractory period"),
        ("model__sampling", "uniform", "proposal network"),
        ("model__opacity_loss_weight", 0.0, "opacity loss"),
        ("model__edge_start", True, "start from edges"),
        ("model__view_direction", True, "view direction"),
        ("data__silent_pairs", 5, "silent pixels"),
        ("model__num_levels", 4, "hash grid"),
        ("model__log2_table_size", 12, "hash grid"),
        ("model__num_channels", 1, "colour"),
    ],
)
def test_a_flag_stands_and_is_said_to(recording: Path, tmp_path: Path, setting: str, value: Any, part: str):
    resolution = resolution_of(recording, tmp_path, **{setting: value})
    assert not any(name.endswith("." + setting.rpartition("__")[2]) for name in resolution.values)
    assert rows(resolution)[part].why == "set by flag"


def test_a_delay_of_less_than_a_twentieth_of_the_time_between_events_is_none(recording: Path):
    """Where a flag has it learned, any is."""
    unknown = replace(fired(recording, np.tile([1, -1], 60)), contrast_thresholds=None)
    interval = 180.0 / 119
    found = resolve(ENERF, unknown)
    assert found.values["model.sensor.least_delay"] == pytest.approx(0.05 * interval, rel=1e-3)
    assert rows(found)["bandwidth"].value.endswith(
        f"is learned, and left out if it is less than {0.05 * interval:.2g} ms"
    )
    forced = copy.deepcopy(ENERF)
    forced.model.sensor.learn_cutoff_frequency = True
    assert "model.sensor.least_delay" not in resolve(forced, unknown).values


@pytest.mark.parametrize(
    ("setting", "part", "value"),
    [
        ({"leak_rate": 0.5}, "leak", "0.5 on events a second"),
        ({"cutoff_frequency": 100.0}, "bandwidth", "cut off at 100 Hz"),
        (
            {"cutoff_frequency": 100.0, "learn_cutoff_frequency": True},
            "bandwidth",
            "the lag of pixels behind brightness is learned",
        ),
        ({"second_cutoff_frequency": 200.0}, "second stage", "pixels lag by 0.796 ms more"),
    ],
)
def test_what_is_stated_of_noise_and_lag_is_shown_with_its_unit(
    recording: Path, tmp_path: Path, setting: dict[str, Any], part: str, value: str
):
    config = small_config(recording, tmp_path, **{f"sensor__{name}": given for name, given in setting.items()})
    rows = {choice.part: choice for choice in config.resolved().pipeline.resolution.choices}
    assert rows[part].kept and (rows[part].value, rows[part].why) == (value, "set by flag")
    others = {"leak", "bandwidth", "second stage"} - {part}
    assert not any(rows[other].kept for other in others & rows.keys())


def test_what_is_applied_fills_in_what_is_open_and_leaves_the_config_alone(recording: Path):
    config = copy.deepcopy(ENERF)
    config.model.max_res, config.datamanager.silent_pairs = 77, 0
    before = copy.deepcopy(config)
    resolution = resolve(config, read_recording(recording))
    filled = Resolution({**resolution.values, "model.max_res": 5, "datamanager.silent_pairs": 9}).applied_to(config)
    assert config == before
    assert (filled.model.max_res, filled.datamanager.silent_pairs) == (77, 0)
    assert filled.model.num_channels == 1 and filled.model.sensor.width == WIDTH


def test_two_answers_to_one_question_are_equal_and_can_be_stored(recording: Path):
    first, second = (resolve(ENERF, read_recording(recording)) for _ in range(2))
    assert first == second == yaml.load(yaml.dump(first), Loader=yaml.Loader)


def test_a_picture_of_grey_is_no_colour():
    grey = np.repeat(np.arange(12, dtype=np.uint8).reshape(3, 4, 1), 3, axis=2)
    assert not is_colour(grey) and not is_colour(grey[..., :1])
    grey[1, 2, 2] += 1
    assert is_colour(grey)


@pytest.mark.parametrize("depth", [(0.0, 1.0), (2.0, 1.0), (1.0, float("inf")), (float("nan"), 2.0)])
def test_a_depth_range_that_is_none_is_refused_before_anything_is_written(recording: Path, tmp_path: Path, depth):
    config = small_config(recording, tmp_path / "outputs")
    config.pipeline.datamanager.dataparser.depth_range = depth
    with pytest.raises(SystemExit, match="event-data --depth-range is"):
        config.save_config()
    assert not (tmp_path / "outputs").exists()


def test_every_row_names_a_flag_of_ns_train_and_both_answers_can_be_forced(recording: Path, tmp_path: Path):
    """The flag of each row is one of the config; set to each answer, the row says so and that a flag did it."""
    forced: dict[str, tuple[Any, Any]] = {
        "pose gaps": (True, False),
        "noise of poses": (True, False),
        "clock of the poses": (True, False),
        "mount": (True, False),
        "lens": (True, False),
        "drift of the poses": (True, False),
        "held-out events": (0.1, 0.0),
        "event loss": ("events", "frames"),
        "silent pixels": (7, 0),
        "any instants": (7, 0),
        "missed changes": (1000, 0),
        "threshold per polarity": ((0.2, 0.3), (0.2, 0.2)),
        "threshold map": (True, False),
        "refractory period": (1000, 0),
        "leak": (True, False),
        "bandwidth": (True, False),
        "level of brightness": (1.0, 0.0),
        "high dynamic range": ("exponential", "log-sigmoid"),
        "frame loss": ("events+frames", "events"),
        "second camera": ("events+frames", "events"),
        "exposure": (3, 1),
        "exposure of frames": (True, False),
        "colour": (3, 1),
        "undistortion": (True, False),
        "panorama": (True, False),
        "contraction": (True, False),
        "proposal network": ("proposal", "uniform"),
        "opacity loss": (1.0, 0.0),
        "start from edges": (True, False),
        "view direction": (True, False),
    }
    always_kept = {"response", "box", "hash grid"}
    config = copy.deepcopy(ENERF)
    config.datamanager.supervision = "events+frames"
    distorted = replace(read_recording(recording), camera=LENS, depth_range=(1.0, 4.0))
    default = rows(resolve(config, distorted))
    assert set(default) == {*forced, *always_kept}
    assert all(default[part].kept for part in always_kept) and default["second camera"].kept
    for part, answers in forced.items():
        *parents, name = default[part].flag.replace("event-data --", "pipeline.datamanager.dataparser.").split(".")
        for value, kept in zip(answers, (True, False), strict=True):
            config = copy.deepcopy(ENERF)
            config.datamanager.supervision = "events+frames"
            owner = config
            for parent in [parent.strip("-") for parent in parents][1:]:
                owner = getattr(owner, parent)
            field = name.replace("-", "_")
            owner = config.model.sensor if hasattr(config.model.sensor, field) else owner
            owner = config.poses if hasattr(config.poses, field) else owner
            assert hasattr(owner, field)
            setattr(owner, field, value)
            blind = 1000 if part == "missed changes" else 0
            row = rows(resolve(config, replace(distorted, refractory_period=blind))).get(part)
            if part == "pose gaps":  # there are none to keep
                assert row is not None and not row.kept
            else:
                assert (row is not None and row.kept) == kept, (part, value)


def frames_config(supervision: str = "frames", **changes: Any) -> Any:
    config = copy.deepcopy(ENERF)
    config.datamanager.supervision = supervision
    for name, value in changes.items():
        setattr(config.datamanager if hasattr(config.datamanager, name) else config.datamanager.dataparser, name, value)
    return config


@pytest.mark.parametrize(("speed", "instants"), [(0.0, 1), (10.0, 1), (72.0, 5), (1000.0, 16)])
def test_a_frame_is_rendered_once_for_every_two_pixels_that_it_moves(recording: Path, speed: float, instants: int):
    """A slide of `speed` m/s, in which points at 1 m move by focal length * speed * 5 ms."""
    whole = read_recording(recording)
    times = whole.trajectory.times
    positions = (times * 1e-9)[:, None] * [speed, 0.0, 0.0]
    slide = Trajectory(times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)))
    frames = replace(whole.blurred_frames, trajectory=slide)  # type: ignore[type-var]
    sliding = replace(whole, frames=None, blurred_frames=frames)
    resolution = resolve(frames_config(depth_range=(1.0, 4.0)), sliding)
    assert resolution.values["datamanager.exposure_samples"] == instants
    row, motion = rows(resolution)["exposure"], whole.camera.fx * speed * 0.005
    assert row.kept == (instants > 1)
    assert f"within 5 ms the picture moves by {motion:.3g} pixels" in row.why
    assert instants in (1, 16) or instants == round(motion / 2)


def test_frames_whose_exposures_are_not_known_are_instants_unless_they_are_stated(recording: Path):
    whole = read_recording(recording)
    unknown = replace(whole, blurred_frames=replace(whole.blurred_frames, exposures=None))  # type: ignore[type-var]
    row = rows(resolve(frames_config(), unknown))["exposure"]
    assert not row.kept and row.flag == "event-data --exposure-ms" and "--exposure-ms" in row.why
    with pytest.raises(FlagError, match=r"recording states no exposures.*exposure-samples averages.*--exposure-ms"):
        resolve(frames_config(exposure_samples=4), unknown)
    assert "datamanager.exposure_samples" not in resolve(frames_config(exposure_samples=1), unknown).values
    stated = resolve(frames_config(exposure_ms=5.0), unknown)
    known = resolve(frames_config(), whole)
    assert stated.values["datamanager.exposure_samples"] == known.values["datamanager.exposure_samples"]
    assert rows(stated)["exposure"].why == "set by flag; " + rows(known)["exposure"].why


def test_sharp_frames_are_instants(recording: Path):
    resolution = resolve(frames_config(train_frames="sharp"), read_recording(recording))
    assert resolution.values["datamanager.exposure_samples"] == 1 and not rows(resolution)["exposure"].kept


@pytest.mark.parametrize(
    ("exposure_ms", "message"),
    [
        (20.0, "--exposure-ms 20 gives .* exposures of 20 ms of frames that are 9.09"),
        (1e-4, "the exposure 100 ns, but"),
    ],
)
def test_an_exposure_that_no_frame_can_have_is_refused(recording: Path, exposure_ms: float, message: str):
    with pytest.raises(FlagError, match=message):
        resolve(frames_config(exposure_ms=exposure_ms), read_recording(recording))


def test_a_time_range_without_frames_is_for_events_alone(recording: Path):
    whole = read_recording(recording)
    assert whole.frames is not None and whole.blurred_frames is not None
    first, second = (np.union1d(whole.frames.times, whole.blurred_frames.times)[:2] * 1e-9).tolist()
    between = 0.75 * first + 0.25 * second, 0.25 * first + 0.75 * second
    with pytest.raises(FlagError, match=r"--time-range holds none of the frames .* to train on, which lie from"):
        resolve(frames_config(time_range=between), whole)
    resolve(frames_config("events", time_range=between), whole)


def test_a_lens_may_be_ignored(recording: Path):
    distorted = replace(read_recording(recording), camera=LENS)
    plain = distorted.selected(None, False, undistort=False)
    assert plain.camera == Camera(WIDTH, HEIGHT, 30.0, 31.0, 15.5, 11.5) and plain.frames is not None
    assert plain is distorted.selected(None, False, undistort=False)
    assert distorted.selected(None, False).camera == LENS


def fired(recording: Path, polarity: np.ndarray) -> EventRecording:
    """Of 0.2 s, whose pixels, all alike, fire an event of such polarity every so often."""
    times = np.linspace(10_000_000, 190_000_000, len(polarity)).astype(np.int64)
    pixels = np.tile(np.arange(WIDTH * HEIGHT), len(times))
    times, polarity = np.repeat(times, WIDTH * HEIGHT), np.repeat(polarity, WIDTH * HEIGHT).astype(np.int8)
    events = Events(pixels % WIDTH, pixels // WIDTH, times, polarity)
    long = read_recording(recording)
    trajectory = Trajectory(long.trajectory.times * 2, long.trajectory.positions, long.trajectory.quaternions)
    return replace(
        long, trajectory=trajectory, stream_events=lambda: iter([events]), frames=None, blurred_frames=None,
        contrast_thresholds=(0.25, 0.25),
    )  # fmt: skip


RISES: dict[str, tuple[np.ndarray, float, str]] = {
    "a little": (np.tile([1, -1], 60), 0.25, "log-sigmoid"),
    "much": (np.repeat([1, -1] * 3, 20), 5.0, "exponential"),
    "much, and only in one half": (np.concatenate([np.tile([1, -1], 40), np.repeat([1, -1], 20)]), 5.0, "exponential"),
    "a little, with drift": (np.tile([1, 1, 1, -1], 12), 6.25, "log-sigmoid"),
}
"""Polarities of events, what they span, and how brightness is to be rendered."""


@pytest.mark.parametrize("name", RISES)
def test_what_events_span_decides_whether_brightness_has_a_limit(recording: Path, name: str):
    """Pixels whose log brightness rises by so many thresholds of 0.25 and falls again."""
    polarity, span, expected = RISES[name]
    config = copy.deepcopy(ENERF)
    config.model.sensor.refractory_period_ns = 0
    row = rows(resolve(config, fired(recording, polarity)))["high dynamic range"]
    assert row.value == expected and row.kept == (expected == "exponential")
    assert f"span {span:.2g} of log brightness" in row.why


def test_events_from_beyond_the_box_decide_on_contraction():
    generator = np.random.default_rng(4)
    depths = np.exp(generator.uniform(0.0, np.log(1.5), (400, 1)))
    for far_points in (0, 240):
        depths[:far_points] = 300.0
        points = depths * np.append(generator.uniform(-0.6, 0.6, (400, 2)), np.ones((400, 1)), axis=1)
        events, trajectory, _ = recording_of_points(points, shaking(0.1), TURNING)
        made = EventRecording(Path("memory"), "", CAMERA, trajectory, lambda events=events: iter([events]), ())
        resolution = resolve(ENERF, made)
        row = rows(resolution)["contraction"]
        assert row.kept == resolution.values["model.contraction"] == bool(far_points)
        assert "come from beyond" in row.why


@pytest.mark.parametrize(
    ("far", "settings", "end"),
    [
        (3.9, {}, None),
        (4.1, {}, 4.0),
        (60.0, {}, 4.0),
        (60.0, {"datamanager.dataparser.contraction_depth": 10.0}, 10.0),
        (60.0, {"datamanager.dataparser.contraction_depth": 60.0}, None),
        (60.0, {"datamanager.dataparser.box": (0.0, 0.0, 0.0, 30.0)}, None),
        (60.0, {"model.contraction": False}, None),
    ],
)
def test_a_large_range_of_depths_decides_on_contraction(recording: Path, far: float, settings: dict, end: float | None):
    """Cells are even up to four times the nearest depth, unless a flag says otherwise."""
    config = copy.deepcopy(ENERF)
    for name, value in settings.items():
        place, _, setting = name.rpartition(".")
        setattr(attrgetter(place)(config), setting, value)
    made = replace(read_recording(recording), depth_range=(1.0, far))
    resolution = resolve(config, made)
    row = rows(resolution)["contraction"]
    assert row.kept == (end is not None)
    assert row.value == ("" if end is None else f"space beyond a depth of {end:.3g} m")
    is_flag = bool(settings) and "datamanager.dataparser.box" not in settings
    assert (row.why == "set by flag") == is_flag
    near_plane = resolution.values["model.near_plane"]
    _, scale, box = scene_normalisation(made, 1.0, far, config.datamanager.dataparser.box, end)
    assert near_plane == pytest.approx(scale)
    assert (np.ptp(box, axis=0).max() > 2.01) == (end is not None)


def test_a_clock_that_is_corrected_moves_no_event_beyond_the_box():
    generator = np.random.default_rng(4)
    depths = np.exp(generator.uniform(0.0, np.log(2.0), (400, 1)))
    points = depths * np.append(generator.uniform(-0.6, 0.6, (400, 2)), np.ones((400, 1)), axis=1)
    events, given, _ = recording_of_points(points, shaking(0.1), TURNING)
    late = Trajectory(given.times + 20_000_000, given.positions, given.quaternions)
    made = EventRecording(Path("memory"), "", CAMERA, late, lambda: iter([events]), (), depth_range=(0.9, 2.2))
    for clock, kept in ((0.0, True), (20.0, False)):
        config = copy.deepcopy(ENERF)
        config.poses.clock_ms = clock
        assert rows(resolve(config, made))["contraction"].kept == kept


def test_a_silent_border_is_an_object_before_nothing(recording: Path):
    whole = read_recording(recording)

    def inner() -> Any:
        for events in whole.stream_events():
            inside = (events.x > 2) & (events.x < WIDTH - 3) & (events.y > 2) & (events.y < HEIGHT - 3)
            yield Events(events.x[inside], events.y[inside], events.t[inside], events.p[inside])

    for stream, expected in ((whole.stream_events, 1.0), (inner, 0.0)):
        resolution = resolve(ENERF, replace(whole, stream_events=stream))
        assert resolution.values["model.opacity_loss_weight"] == expected
        assert rows(resolution)["opacity loss"].kept == bool(expected)


def of_lines(number: int) -> EventRecording:
    """A recording of as many lines in space, each of 30 points."""
    generator = np.random.default_rng(1)
    depths = np.exp(generator.uniform(0, np.log(3), (number, 1, 1)))
    across = generator.uniform(-0.6, 0.6, (number, 1, 2))
    middles = depths * np.concatenate([across, np.ones((number, 1, 1))], axis=2)
    points = middles + generator.uniform(-0.4, 0.4, (number, 1, 3)) * np.linspace(-1, 1, 30)[:, None]
    events, trajectory, _ = recording_of_points(points.reshape(-1, 3), shaking(0.2), TURNING)
    return EventRecording(Path("memory"), "", CAMERA, trajectory, lambda: iter([events]), (), depth_range=(0.7, 4.0))


@pytest.mark.slow
def test_a_field_starts_from_edges_where_there_are_many_and_all_are_seen(recording: Path):
    many, few = of_lines(80), of_lines(8)
    blind = copy.deepcopy(ENERF)
    blind.model.sensor.refractory_period_ns = 1_000_000
    for config, scene, expected, why in (
        (ENERF, many, True, "% of the pixels see an edge"),
        (ENERF, few, False, "% of the pixels see an edge"),
        (blind, many, False, "blind pixels"),
        (PAPER, many, False, "set by the method"),
    ):
        resolution = resolve(config, scene)
        row = rows(resolution)["start from edges"]
        assert resolution.applied_to(config).model.edge_start == row.kept == expected
        assert why in row.why
    beside_frames = resolve(frames_config("events+frames"), read_recording(recording))
    assert not beside_frames.values["model.edge_start"]
    assert "frames" in rows(beside_frames)["start from edges"].why


@pytest.mark.slow
def test_edges_are_looked_for_at_the_right_time_of_a_clock_that_is_wrong():
    right = of_lines(80)
    given = right.trajectory
    late = Trajectory(given.times + 30_000_000, given.positions, given.quaternions)
    said = {}
    for clock, trajectory in ((0.0, given), (0.0, late), (30.0, late)):
        config = copy.deepcopy(ENERF)
        config.poses.clock_ms = clock
        row = rows(resolve(config, replace(right, trajectory=trajectory)))["start from edges"]
        said[clock, trajectory is late] = float(row.why.partition(" %")[0])
    assert said[0.0, False] == pytest.approx(said[30.0, True], rel=0.05) and said[0.0, True] < 0.5 * said[0.0, False]


@pytest.mark.parametrize("config", [frames_config(), None])
def test_frames_alone_and_a_panorama_show_no_edge_to_start_from(recording: Path, config: Any):
    config = config or copy.deepcopy(ENERF)
    config.model.panorama = config.datamanager.supervision == "events"
    resolution = resolve(config, read_recording(recording))
    assert resolution.values["model.edge_start"] is False and "start from edges" not in rows(resolution)


@pytest.mark.parametrize(("max_res", "levels"), [(16, 1), (32, 3), (64, 5), (256, 9), (4096, 10)])
def test_levels_of_the_grid_are_never_closer_than_they_help(recording: Path, max_res: int, levels: int):
    config = copy.deepcopy(ENERF)
    config.model.max_res = max_res
    assert resolve(config, read_recording(recording)).values["model.num_levels"] == levels
    assert levels == 1 or (max_res / 16) ** (1 / (levels - 1)) >= 1.39


@pytest.mark.parametrize(
    ("size", "log2_expected"),
    [((32, 24), 17), ((160, 120), 18), ((240, 180), 19), ((346, 260), 19), ((640, 480), 20), ((1280, 720), 20)],
)
def test_a_table_grows_with_the_side_of_the_sensor(recording: Path, size: tuple[int, int], log2_expected: int):
    """Between the smallest and the largest table, to the nearest power of two."""
    resized = replace(read_recording(recording), camera=Camera(*size, 30.0, 31.0, 15.5, 11.5))
    resolution = resolve(copy.deepcopy(ENERF), resized)
    log2_entries = resolution.values["model.log2_table_size"]
    assert log2_entries == log2_expected
    relative = 2**log2_entries / (2000 * (size[0] * size[1]) ** 0.5)
    assert 2**-0.5 < relative < 2**0.5 or (log2_entries == 17 and relative > 1) or (log2_entries == 20 and relative < 1)
    assert f"levels of 2^{log2_entries} entries" in rows(resolution)["hash grid"].value


@pytest.mark.parametrize("setting", ["max_res", "log2_table_size", "num_levels"])
def test_each_flag_of_the_hash_grid_is_said_to_be_one(recording: Path, setting: str):
    config = copy.deepcopy(ENERF)
    assert rows(resolve(config, read_recording(recording)))["hash grid"].why != "set by flag"
    setattr(config.model, setting, 16)
    assert rows(resolve(config, read_recording(recording)))["hash grid"].why == "set by flag"
