"""Simulates a recording: events, frames, depth and poses, written while they are made."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from enerf_ns.dataparsers.formats.registry import check_outside_recordings, open_writer, writer_of
from enerf_ns.dataparsers.formats.writer import Setup, Writer
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError
from enerf_ns.dataparsers.recording.files import absolute, remove_leftovers
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.sensor.response import ColourFilter, luma, pixel_brightness, response_named
from enerf_ns.simulator.event_sensor import EventSensor
from enerf_ns.simulator.frames import Exposures, Frame, develop
from enerf_ns.simulator.preview import Preview
from enerf_ns.simulator.sampling import Render, adaptive_renders, render_times
from enerf_ns.simulator.settings import SimulationSettings, resolve
from enerf_ns.simulator.sources import Pictures, RenderedScene, Source, TrainedRun
from enerf_ns.simulator.view import View, view_of

WINDOW = 10**9
"""Nanoseconds of the recording whose times of rendering are computed at once."""


@dataclass(frozen=True)
class Simulation:
    """Summary of a simulated recording."""

    folder: Path
    """Folder of the recording."""
    duration: int
    """Duration of the recording, ns."""
    num_events: int
    num_frames: int
    has_poses: bool
    """Whether the recording has poses. Pictures have none, so that no field can be trained on them."""
    notes: tuple[str, ...]
    """One sentence for each thing that the user should know."""


def simulate(settings: SimulationSettings, output_dir: Path, preview: bool = False) -> Simulation:
    """Simulates a recording and writes it; shows a progress bar meanwhile.

    Args:
        settings: Scene, motion and sensors.
        output_dir: New or empty folder.
        preview: Whether to write preview.mp4 too: frame, blurred frame, events and depth side by side.

    Raises:
        FlagError: A setting is out of its range, contradicts another one, or changes nothing.
        RecordingError: An input cannot be read or used.
        OutputError: The folder is not empty, lies within a recording or another input, or cannot be made; or the
            preview cannot be written.
    """
    output_dir = absolute(output_dir)
    check_outside_recordings("--output-dir", output_dir, *settings.reads)
    remove_leftovers(output_dir)
    is_new = not output_dir.exists()
    if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())):
        raise OutputError(
            f"{output_dir} exists already and is not an empty folder; give another --output-dir or move it away."
        )
    settings, notes = resolve(settings), []
    assert settings.layout is not None
    view = view_of(settings, notes)
    exposures = _exposures(settings, view)
    first = view.events.brightness(view.start)
    if first.ndim == 2:
        seen = settings.scene or settings.from_run
        if settings.bayer_pattern:
            raise FlagError(f"--bayer-pattern needs colours, but {seen} is grey.")
        if settings.colour:
            notes.append(f"--colour changes nothing, since {seen} is grey.")
    camera = _EventCamera(settings, first, view.start)
    setup = _setup(settings, view, exposures, camera.sensor)
    try:
        output_dir.mkdir(parents=True, exist_ok=not is_new)  # another command may have made it meanwhile
    except OSError as error:
        raise OutputError(
            f"{output_dir} cannot be made a folder ({error.strerror}); give another --output-dir."
        ) from error
    with ExitStack() as stack:
        if is_new:
            stack.callback(_remove_if_empty, output_dir)
        writer = stack.enter_context(open_writer(settings.layout, output_dir, setup))
        video = None
        if preview:
            size = view.event_camera.width, view.event_camera.height
            video = stack.enter_context(Preview(output_dir / "preview.mp4", *size))
        _record(settings, view, exposures, camera, _Recorder(settings, writer, video))
    if not writer.num_events:
        notes.append("There are no events, and a recording without events cannot be read; let the camera move more.")
    return Simulation(
        folder=output_dir,
        duration=view.end - view.start,
        num_events=writer.num_events,
        num_frames=writer.num_frames,
        has_poses=view.trajectory is not None,
        notes=tuple(notes),
    )


def _exposures(settings: SimulationSettings, view: View) -> Exposures:
    """Exposures of evenly spaced frames, in whole microseconds."""
    preset, length = settings.preset, view.end - view.start
    assert settings.layout is not None
    fewest = writer_of(settings.layout).fewest_frames
    count = settings.num_frames or max(fewest, round(preset.num_frames / preset.duration * length * 1e-9))
    exposure_ms = settings.exposure_ms
    if exposure_ms is None:
        longest = max(0, length // count // 2000 - 1) * 2e-3
        exposure_ms = min(preset.exposure_ms, longest)
    exposure = round(exposure_ms * 500) * 2000
    no_room = FlagError(
        f"{length * 1e-9:g} s have no room for {count} frame{'s' * (count > 1)} with exposures of "
        f"{exposure * 1e-6:g} ms, since frames are at least 1 us apart; give less or a longer --duration."
    )
    if count * 1000 > length:
        raise no_room
    times = view.start + ((np.arange(count) + 0.5) * length / count).astype(np.int64) // 1000 * 1000
    exposures = Exposures(times, exposure)
    if exposures.opens[0] < view.start or exposures.closes[-1] > view.end:
        raise no_room
    return exposures


class _EventCamera:
    """The event sensor, behind a colour filter if the settings have one.

    Args:
        settings: Settings of the simulation.
        brightness: First picture, linear: [height, width] or, in colour, [height, width, 3].
        time: Time of the first picture, ns.
    """

    def __init__(self, settings: SimulationSettings, brightness: np.ndarray, time: int):
        self._channels = None
        if settings.bayer_pattern is not None:
            height, width = brightness.shape[:2]
            self._channels = ColourFilter(settings.bayer_pattern, width).channels(torch.arange(width * height))
        self.sensor = EventSensor(settings.sensor, self._seen(brightness), time)

    def advance(self, render: Render) -> Events:
        """Events from the last picture to this one."""
        before = [part._replace(brightness=self._seen(part.brightness, part.pixels)) for part in render.before]
        return self.sensor.advance(self._seen(render.brightness), render.time, before)

    def _seen(self, brightness: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
        """Brightness behind the filter, [height, width] or [pixels], from a grey or coloured brightness."""
        shape = brightness.shape[: 2 if pixels is None else 1]
        if brightness.ndim == len(shape):
            return brightness
        channels = self._channels
        if channels is not None:
            channels = channels.view(shape) if pixels is None else channels[pixels]
        return pixel_brightness(torch.from_numpy(brightness), channels).numpy()


def _record(
    settings: SimulationSettings, view: View, exposures: Exposures, camera: _EventCamera, recorder: _Recorder
) -> None:
    """Renders the view from start to end, and records the events and frames of its cameras."""
    stops = np.array([view.start, view.end])
    others: Iterator[Frame] = iter(())
    if view.frames is None:
        stops = np.union1d(stops, exposures.stops)
    else:
        others = _frames(settings, view.frames, exposures)
    following = next(others, None)
    columns = (TextColumn("Simulating"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(width=120), transient=True) as progress:
        task = progress.add_task("", total=1.0)
        for render in _renders(settings, view.events, stops, settings.max_change):
            if render.time > view.start:
                recorder.add_events(camera.advance(render))
            if view.frames is None:
                frame = exposures.add(render.time, _shown(settings, render.brightness))
                if frame is not None:
                    recorder.add_frame(frame, view.events)
            while following is not None and following.time <= render.time:
                assert view.frames is not None
                recorder.add_frame(following, view.frames)
                following = next(others, None)
            progress.update(task, completed=(render.time - view.start) / (view.end - view.start))
        recorder.add_events(camera.sensor.finish())


def _renders(
    settings: SimulationSettings, source: Source, stops: Int64[np.ndarray, " stops"], max_change: float
) -> Iterator[Render]:
    """Pictures at these times (ns), and as many between them as motion and changes of brightness need."""
    response = response_named(settings.sensor.response)
    if isinstance(source, Pictures):
        times = np.union1d(stops, source.times[(source.times > stops[0]) & (source.times < stops[-1])])
        if not settings.sensor.cutoff_frequency:  # then log brightness is linear between pictures
            max_change = np.inf
        yield from adaptive_renders(source.brightness, times, max_change, response, threads=1)
        return
    assert isinstance(source, RenderedScene | TrainedRun)
    for start, end in pairwise([*range(stops[0], max(stops[-1], stops[0] + 1), WINDOW), stops[-1]]):
        within = np.union1d([start, end], stops[(stops > start) & (stops < end)])
        times = render_times(source.camera, source.trajectory, source.depth, within, settings.max_displacement)
        renders = adaptive_renders(source.brightness, times, max_change, response)
        if start > stops[0]:
            next(renders)  # it is the last picture of the window before
        yield from renders


def _frames(settings: SimulationSettings, source: Source, exposures: Exposures) -> Iterator[Frame]:
    """The frames of a second camera, which is rendered during exposures only."""
    for stops in np.stack([exposures.opens, exposures.times, exposures.closes], axis=1):
        for render in _renders(settings, source, np.unique(stops), np.inf):
            frame = exposures.add(render.time, _shown(settings, render.brightness))
            if frame is not None:
                yield frame


def _shown(settings: SimulationSettings, picture: Float[np.ndarray, "height width *channels"]) -> np.ndarray:
    """The picture in the colours of the frames: R G B, or grey."""
    return picture if settings.colour or picture.ndim == 2 else luma(torch.from_numpy(picture)).numpy()


def _setup(settings: SimulationSettings, view: View, exposures: Exposures, sensor: EventSensor) -> Setup:
    """The facts of the recording that are known before the first picture."""
    return Setup(
        event_camera=view.event_camera,
        frame_camera=view.frame_camera,
        event_from_frame=view.event_from_frame,
        trajectory=view.trajectory,
        frame_times=exposures.times,
        exposure=exposures.exposure,
        contrast_thresholds=settings.sensor.contrast_thresholds,
        pixel_thresholds=sensor.contrast_thresholds if settings.sensor.threshold_spread else None,
        refractory_period=settings.sensor.refractory_period,
        bayer_pattern=settings.bayer_pattern,
        response=settings.sensor.response,
        settings=_stated(settings, view, exposures),
    )


def _stated(settings: SimulationSettings, view: View, exposures: Exposures) -> dict[str, Any]:
    """All settings for simulation.json, with the values that were chosen for those left out."""
    stated = {**asdict(settings), "frame_settings": asdict(settings.frame)}
    stated["duration"] = (view.end - view.start) * 1e-9
    stated["num_frames"], stated["exposure_ms"] = len(exposures.times), exposures.exposure * 1e-6
    if settings.scene and not (settings.pictures or settings.key_frames or settings.trajectory):
        stated["motion"] = settings.motion or settings.preset.motion
    if settings.scene and Path(settings.scene) in settings.reads:
        stated["scene"] = absolute(settings.scene)  # for whoever compares with it from another folder
    return json.loads(json.dumps(stated, default=str))


class _Recorder:
    """Passes events and frames to the writer of the folder and, if there is one, to the preview."""

    def __init__(self, settings: SimulationSettings, writer: Writer, preview: Preview | None):
        self._settings, self._writer, self._preview = settings, writer, preview

    def add_events(self, events: Events) -> None:
        """Adds events that are later than all events added before."""
        self._writer.add_events(events)
        if self._preview is not None:
            self._preview.add_events(events)

    def add_frame(self, frame: Frame, source: Source) -> None:
        """Adds the next frame, with its depth if the source has depth."""
        depth = None
        if isinstance(source, RenderedScene) or (isinstance(source, TrainedRun) and source.has_depth):
            depth = source.depth(frame.time)
        shown, seed = self._settings.frame, self._settings.sensor.seed
        sharp = develop(frame.sharp, shown, frame.number, False, seed)
        blurred = None if frame.blurred is None else develop(frame.blurred, shown, frame.number, True, seed)
        linear = (frame.sharp, frame.blurred) if shown.hdr else None
        self._writer.add_frame(frame.number, frame.time, sharp, blurred, depth, linear)
        if self._preview is not None:
            self._preview.add_frame(sharp, blurred, depth)


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()
