"""A sensor with a colour filter, from events to colour: a camera circles before a wall painted with waves."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Type  # noqa: UP035 - as the config it derives from

import numpy as np
import pytest
import torch
from nerfstudio.scripts.train import _set_random_seed
from PIL import Image
from recordings import joined

from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.event_dataparser import EventDataParser, EventDataParserConfig
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align
from enerf_ns.evaluation.views import aligned_views
from enerf_ns.events.batch import TrainBatch
from enerf_ns.method.config import enerf
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.pipeline import EnerfPipelineConfig
from enerf_ns.sensor.response import inverse_linlog, linlog
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.supervision.event_supervision import brightness_change

WIDTH, HEIGHT, FOCAL = 32, 24, 32.0
PATTERN = "GRBG"
THRESHOLDS = (0.2, 0.2)
SECOND = 1_000_000_000

WAVES = np.random.default_rng(4).uniform(-1, 1, (4, 3, 3)) * [14.0, 14.0, 3.0]
"""Of every channel four waves: radians per metre along x and y, and the phase."""


def position(time: int | np.ndarray) -> np.ndarray:
    """Of the camera, metres, (..., 3): a circle before the wall, which is the plane z = 1."""
    angle = 2 * np.pi * np.asarray(time) / SECOND
    return np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.0 * angle], axis=-1)


def log_brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of all three channels at points of the wall (metres), (..., 3)."""
    waves = np.sin(WAVES[..., 0] * x[..., None, None] + WAVES[..., 1] * y[..., None, None] + WAVES[..., 2])
    return 4.0 + 0.35 * waves.sum(axis=-2)


def picture(time: int) -> np.ndarray:
    """Log brightness that the camera sees, (HEIGHT, WIDTH, 3)."""
    row, column = np.indices((HEIGHT, WIDTH))
    x, y, _ = position(time)
    return log_brightness((column - (WIDTH - 1) / 2) / FOCAL + x, (row - (HEIGHT - 1) / 2) / FOCAL + y)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> EventRecording:
    """One second of colour events, and five frames in colour."""
    folder = tmp_path_factory.mktemp("colour")
    row, column = np.indices((HEIGHT, WIDTH))
    seen = np.array(["RGB".index(letter) for letter in PATTERN]).reshape(2, 2)[row % 2, column % 2]

    def mosaic(time: int) -> np.ndarray:
        return np.exp(np.take_along_axis(picture(time), seen[..., None], axis=-1)[..., 0])

    sensor = EventSensor(SensorSettings(contrast_thresholds=THRESHOLDS, response="logarithm:1e-9"), mosaic(0), 0)
    times = np.arange(1, 1001) * (SECOND // 1000)
    events = joined(sensor.advance(mosaic(time), time) for time in times.tolist())
    np.save(folder / "events.npy", np.stack([events.x, events.y, events.t, events.p], axis=1))

    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    pose_times = np.arange(0, 101) * (SECOND // 100)
    trajectory = Trajectory(pose_times, position(pose_times), np.tile([0.0, 0.0, 0.0, 1.0], (101, 1)))
    frame_times = np.array([1, 3, 5, 7, 9]) * (SECOND // 10)
    files = tuple(folder / f"{i}.png" for i in range(len(frame_times)))
    for file, time in zip(files, frame_times.tolist(), strict=True):
        brightness = inverse_linlog(torch.from_numpy(picture(time))).numpy()
        Image.fromarray((255.0 * brightness).round().astype(np.uint8)).save(file)

    def stream() -> Iterator[Events]:
        yield events

    return EventRecording(
        path=folder,
        format="colour",
        camera=camera,
        trajectory=trajectory,
        stream_events=stream,
        event_files=(folder / "events.npy",),
        frames=Frames(files, frame_times, camera, trajectory),
        contrast_thresholds=THRESHOLDS,
        bayer_pattern=PATTERN,
        depth_range=(0.95, 1.05),
    )


@dataclass
class MemoryDataParserConfig(EventDataParserConfig):
    _target: Type = field(default_factory=lambda: MemoryDataParser)  # noqa: UP006
    recording: Any = None


class MemoryDataParser(EventDataParser):
    def recording(self) -> EventRecording:
        return self.config.recording  # type: ignore


def small_config(recording: EventRecording, supervision: Any = "events") -> EnerfPipelineConfig:
    config = copy.deepcopy(enerf.config.pipeline)
    assert isinstance(config, EnerfPipelineConfig)
    manager, model = config.datamanager, config.model
    manager.dataparser = MemoryDataParserConfig(data=recording.path, recording=recording)
    manager.supervision = supervision
    manager.event_pairs, manager.silent_pairs, manager.silence_ms = 256, 32, 5.0
    model.log2_table_size, model.num_levels = 12, 4
    model.sampling, model.num_samples, model.sensor.response = "uniform", 8, "linlog"  # by which the events were made
    return config


def make_pipeline(recording: EventRecording) -> Any:
    _set_random_seed(0)
    pipeline = small_config(recording).setup(device="cpu")
    pipeline.train()
    return pipeline


def batch_and_rays(pipeline: Any) -> tuple[TrainBatch, Any]:
    manager, sensor = pipeline.datamanager, pipeline.model.sensor
    batch = manager.next_batch(sensor)
    return batch, manager.rays(batch, sensor)


def test_the_sensor_says_which_channel_every_pair_sees(recording: EventRecording):
    """From the directions of its rays, projected into the sensor."""
    pipeline = make_pipeline(recording)
    batch, rays = batch_and_rays(pipeline)
    turn = pipeline.datamanager.train_dataparser_outputs.dataparser_transform[:, :3]
    assert batch.events is not None and batch.num_pairs == 256 + 32
    x, y, z = (rays.directions @ turn).T
    column = (FOCAL * x / z + (WIDTH - 1) / 2).round().int().tolist()
    row = (FOCAL * y / z + (HEIGHT - 1) / 2).round().int().tolist()
    letters = [PATTERN[2 * (v % 2) + u % 2] for u, v in zip(column, row, strict=True)]
    channels = pipeline.model.sensor.colour_filter.channels(batch.events.pixels.repeat(2)).tolist()
    assert set(channels) == {0, 1, 2}
    assert letters == ["RGB"[channel] for channel in channels]


@pytest.mark.parametrize("loss", ["huber", "squared", "normalised"])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_an_event_teaches_its_own_channel_alone(recording: EventRecording, channel: int, loss: str):
    pipeline = make_pipeline(recording)
    pipeline.model.supervision = replace(pipeline.model.supervision, event_loss=loss)
    torch.nn.init.normal_(pipeline.model.field.geometry.grid.table)
    batch, rays = batch_and_rays(pipeline)
    assert batch.events is not None
    seen = torch.full((len(batch.events),), channel)
    seen[batch.events.silent] = (channel + 1) % 3
    pixels = torch.tensor([PATTERN.index(letter) for letter in "RGB"])[seen]  # of the first row and the second
    batch = replace(batch, events=replace(batch.events, pixels=pixels % 2 + WIDTH * (pixels // 2)))
    outputs = pipeline.model(rays)
    losses = pipeline.model.get_loss_dict(outputs, batch)
    weight = pipeline.model.field.colour_network.layers[-1].weight
    for name, taught in {"event_loss": channel, "no_event_loss": (channel + 1) % 3}.items():
        (gradient,) = torch.autograd.grad(losses[name], weight, retain_graph=True)
        assert [bool(row.any()) for row in gradient] == [c == taught for c in range(3)]


def test_the_change_of_a_pair_is_that_of_its_channel(recording: EventRecording):
    """With the wall's true brightness as a render, the pairs change as their events say."""
    pipeline = make_pipeline(recording)
    manager = pipeline.datamanager
    batch, rays = batch_and_rays(pipeline)
    assert batch.events is not None
    outputs = manager.train_dataparser_outputs
    turn, scale = outputs.dataparser_transform, outputs.dataparser_scale
    origins = (rays.origins / scale - turn[:, 3]) @ turn[:, :3]
    directions = rays.directions @ turn[:, :3]
    x, y, _ = (origins + directions / directions[:, 2:]).double().numpy().T
    rgb = inverse_linlog(torch.from_numpy(log_brightness(x, y)))
    start, end, _ = batch.split(rgb)
    events, sensor = batch.events, pipeline.model.sensor
    predicted = brightness_change(start, end, events, sensor)
    measured = sensor.measured_change(events)
    np.testing.assert_allclose(predicted[events.fired], measured[events.fired], atol=1e-3)
    assert predicted[events.silent].abs().max() < 2 * max(THRESHOLDS)


def test_colour_is_learnt_from_events_and_brightness_fitted_for_each_channel(recording: EventRecording):
    """The wall is opaque from the beginning, so that it is colour that is learnt."""
    pipeline = make_pipeline(recording)
    pipeline.model.field.geometry.init_density = 50.0
    optimizer = torch.optim.Adam(pipeline.get_param_groups()["fields"], lr=2e-2, eps=1e-15)
    for step in range(200):
        _, losses, _ = pipeline.get_train_loss_dict(step)
        optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
    assert pipeline.event_scores(2048)["event_correlation"] > 0.85

    views, _ = held_out_views(pipeline)
    shown, summary = aligned_views(views)
    rendered, recorded, aligned = (
        torch.stack([getattr(view, name) for view in of]).double().reshape(-1, 3)
        for of, name in ((views, "rendered"), (views, "recorded"), (shown, "rendered"))
    )
    correlations = np.corrcoef(linlog(rendered).T, linlog(recorded).T)[:3, 3:]
    assert (correlations.diagonal() > 0.75).all()
    assert (correlations.argmax(axis=1) == [0, 1, 2]).all()
    for channel, name in enumerate(("red", "green", "blue")):
        x, y = linlog(rendered[:, channel]), linlog(recorded[:, channel])
        scale, offset = np.polyfit(x, y, 1)
        assert summary[f"brightness_scale_{name}"] == pytest.approx(scale, rel=1e-6)
        assert summary[f"brightness_offset_{name}"] == pytest.approx(offset, rel=1e-6)
        expected = inverse_linlog(scale * x + offset)
        torch.testing.assert_close(aligned[:, channel], expected, rtol=0, atol=1e-6)
    assert not {"brightness_scale", "brightness_offset"} & set(summary)

    recorded: Any = views[0].recorded
    rendered = views[0].rendered
    _, images = pipeline.model.get_image_metrics_and_images(
        {"rgb": rendered, "depth": views[0].depth}, {"image": recorded, "is_frame": True}
    )
    alone = align([rendered], [recorded], DEFAULT_PROTOCOL, colour_filter=True).rendered[0].clamp(0, 1)
    torch.testing.assert_close(images["img"], torch.cat([recorded, alone], dim=1))


def test_a_grey_sensor_gets_one_fit_and_no_channels(recording: EventRecording):
    grey = replace(recording, bayer_pattern=None)
    pipeline = make_pipeline(grey)
    assert pipeline.model.config.num_channels == 1
    assert pipeline.model.sensor.colour_filter is None
    views: Any = held_out_views(pipeline)[0]
    _, parameters = aligned_views([replace(view, rendered=0.5 * view.recorded) for view in views])
    assert set(parameters) == {"brightness_scale", "brightness_offset"}


@pytest.mark.parametrize("supervision", ["events", "events+frames"])
def test_a_colour_filter_needs_three_channels_and_the_table_says_so(recording: EventRecording, supervision: str):
    config = small_config(recording, supervision)
    resolution = resolve(config, recording)
    colour = next(choice for choice in resolution.choices if choice.part == "colour")
    assert resolution.values["model.num_channels"] == 3
    assert colour.kept and colour.why == "the sensor has a colour filter (GRBG)"


def test_one_channel_behind_a_colour_filter_is_refused(recording: EventRecording):
    config = small_config(recording)
    config.model.num_channels = 1
    with pytest.raises(FlagError, match=r"colour filter \(GRBG\).*--pipeline\.model\.num-channels is 1") as error:
        resolve(config, recording)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("mode", "approximate"), [("successor", False), ("partner", True), ("window", True)])
def test_the_refractory_period_reaches_the_rays_and_the_table(recording: EventRecording, mode, approximate: bool):
    blind = replace(recording, refractory_period=8_000_000)
    config = small_config(blind)
    config.datamanager.pair_mode, config.datamanager.completed_refractory_ns = mode, 0
    rows = {choice.part: choice for choice in resolve(config, blind).choices}
    assert rows["refractory period"].kept and "8 ms" in rows["refractory period"].value
    assert ("successor" in rows["event loss"].why) == approximate
    pipeline = config.setup(device="cpu")
    sensor, index = pipeline.model.sensor, index_events(blind)
    events: Any = pipeline.datamanager.next_batch(sensor).events
    assert torch.isin(events.start[events.fired], index.times).all()
    blind_for: Any = sensor.blind_after(events.start, events.end)
    assert ((blind_for == 8_000_000) | (events.start + blind_for == events.end - 1)).all()
    rays = pipeline.datamanager.event_rays(events, sensor)
    later = events.start.clone()
    later[events.fired] += blind_for.long()[events.fired]
    expected = pipeline.datamanager.event_camera.rays(events.pixels.repeat(2), torch.cat([later, events.end]))
    torch.testing.assert_close(rays.origins, expected.origins, rtol=0, atol=1e-7)
    silent_pixels, silent_start = events.pixels[events.silent], events.start[events.silent]
    before = index.count_until(silent_pixels, silent_start)
    latest = index.times[index.offsets[silent_pixels] + before - 1]
    assert (silent_start - latest >= 8_000_000)[before > 0].all()
