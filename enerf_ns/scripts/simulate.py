"""`enerf simulate`: a recording of an event camera, with frames, depth and poses, of anything that has a picture at any
time: scenes made from a seed, meshes, folders of images, videos, trained runs."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Optional  # tyro reads these annotations on Python 3.10

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from enerf_ns.dataparsers.camera import Camera
from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.formats.event_recording import read_cameras
from enerf_ns.dataparsers.formats.registry import layouts, open_writer, writer_of
from enerf_ns.dataparsers.formats.writer import Setup, Writer, is_second_camera
from enerf_ns.dataparsers.recording import Events
from enerf_ns.dataparsers.trajectory import Trajectory
from enerf_ns.sensor.response import ColourFilter, Logarithm, luma, pixel_brightness
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.simulator.frames import Exposures, Frame, FrameSettings, develop
from enerf_ns.simulator.paper_sequences import PRESETS, SimulationPreset
from enerf_ns.simulator.preview import Preview
from enerf_ns.simulator.sampling import MAX_CHANGE, MAX_DISPLACEMENT, Render, adaptive_renders, render_times
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scene_files import load_scene
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.scene.view_check import check_view
from enerf_ns.simulator.sources import ImageFolder, Pictures, RenderedScene, Source, TrainedRun, Video
from enerf_ns.simulator.trajectories import MOTIONS, POSES_PER_SECOND, from_file, key_frames, sampled

CONSOLE = Console(width=120)

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")

SECONDS, FRAME_RATE, EXPOSURE_MS, SIZE, FIELD_OF_VIEW = 1.0, 41.0, 20.0, (160, 120), 60.0
"""Of a recording for which neither a preset nor a flag states them; frames are counted per second."""

WINDOW = 10**9
"""Nanoseconds for which it is found out at once when to render."""

MOST_PIXELS = 2**24
"""Of a camera; rendering takes up to a kilobyte of memory for each."""

SPARSE = 20_000_000
"""Nanoseconds between poses, above which they are made denser where a second camera is mounted on the first."""

if TYPE_CHECKING:
    Layout = str
else:
    Layout = Literal[layouts()]


@dataclass(frozen=True)
class View:
    """What is looked at, by which cameras, from where and how long."""

    events: Source
    """As the event camera sees it."""
    frames: Source | None
    """As the camera of the frames sees it; None: that of the events takes them."""
    trajectory: Trajectory | None
    """Of the event camera."""
    event_camera: Camera
    frame_camera: Camera
    event_from_frame: np.ndarray
    """Pose of the camera of the frames in the axes of that of the events, [4, 4]."""
    start: int
    """ns"""
    end: int
    """ns"""


@dataclass
class Simulate:
    """Simulate a recording of an event camera, with sharp and blurred frames, depth and poses."""

    output_dir: Path
    """New folder for the recording."""
    scene: Annotated[Optional[str], tyro.conf.Positional] = None  # noqa: UP045
    """What is seen: a preset (spiral1, spiral2, shake-moon1, shake-moon2, shake-carpet1), a scene (shapes, carpet,
    roads, moon, board), a mesh (.glb, .gltf, .obj, .ply, .stl), a scene file (.json), a folder of images, a video."""
    from_run: Optional[Path] = None  # noqa: UP045
    """config.yml of a run of Nerfstudio, which is rendered instead of a scene."""
    motion: Optional[Literal["shake", "spiral"]] = None  # noqa: UP045
    """How the camera moves: forward-facing with abrupt turns, or an inward spiral. None: as the preset, or shake."""
    key_frames: Optional[Path] = None  # noqa: UP045
    """Text file of the camera's places and targets instead, `t x y z tx ty tz` a line: seconds, metres, z up."""
    trajectory: Optional[Path] = None  # noqa: UP045
    """Recording, or text file of poses, `t px py pz qx qy qz qw` a line, whose motion is used instead."""
    trajectory_unit: Literal["s", "us", "ns"] = "s"
    """Unit of the times of a file of poses."""
    duration: Optional[float] = None  # noqa: UP045
    """Length of the recording in seconds. None: that of the preset, the trajectory or the video, or 1."""
    num_frames: Optional[int] = None  # noqa: UP045
    """Frames, at regular times. None: as many a second as the preset, or 41."""
    exposure_ms: Optional[float] = None  # noqa: UP045
    """Exposure of the blurred frames in milliseconds, centred at the time of the frame; 0: none are made. None: as the
    preset, or 20, but no longer than from one frame to the next."""
    width: Optional[int] = None  # noqa: UP045
    """Of events and frames, in pixels. None: as the preset or the run, or 160; in proportion, if height is given."""
    height: Optional[int] = None  # noqa: UP045
    """Of events and frames, in pixels. None: as the preset or the run, or 120; in proportion, if width is given."""
    field_of_view: Optional[float] = None  # noqa: UP045
    """Horizontal, in degrees. None: as the preset or the run, or 60."""
    cameras: Optional[Path] = None  # noqa: UP045
    """JSON file with `camera` and, if another one takes the frames, `frame_camera` as in recording.json."""
    layout: Optional[Layout] = None  # noqa: UP045
    """Of the folder: E-NeRF's ESIM sequences, EDS or TUM-VIE as published, or this package's own. None: esim, and for
    images, videos, runs and colour filters this package's own."""
    color: bool = False
    """Frames in colour, where the scene is."""
    bayer_pattern: Optional[str] = None  # noqa: UP045
    """Colours of the event camera's pixels (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB; None: a grey sensor."""
    frames_per_second: Optional[float] = None  # noqa: UP045
    """How fast a video, or the images of a folder, were recorded. None: as fast as the video is played."""
    stamps: Optional[Path] = None  # noqa: UP045
    """Text file with the times of the images of a folder in seconds, one a line."""
    gamma: bool = True
    """Take the images of a folder or a video for sRGB, not for linear brightness."""
    contrast_thresholds: Optional[tuple[float, float]] = None  # noqa: UP045
    """Change of log brightness that makes an on event, and an off event. None: as the preset, or 0.25 0.25."""
    max_displacement: float = MAX_DISPLACEMENT
    """Pixels that a point may move at most from one picture to the next that events are made of."""
    max_change: float = MAX_CHANGE
    """By how much a pixel's log brightness may change at most before it is rendered again, between pictures."""
    preview: bool = False
    """Write preview.mp4 too: frame, blurred frame, events and depth side by side."""
    sensor: Annotated[SensorSettings, tyro.conf.arg(name="")] = field(default_factory=SensorSettings)
    frame: FrameSettings = field(default_factory=FrameSettings)

    def main(self) -> None:
        output_dir = self.output_dir.expanduser().resolve()
        if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())):
            raise RecordingError(
                f"{output_dir} exists already and is not an empty folder; give another --output-dir or move it away."
            )
        self._check_flags()
        self.layout = self.layout or (
            "event_recording" if self._pictures or self.from_run or self.bayer_pattern else "esim"
        )
        if self.bayer_pattern and self.layout != "event_recording":
            raise RecordingError(
                f"--layout {self.layout} has no place for a --bayer-pattern; give --layout event_recording."
            )
        self._check_use()
        thresholds = self.contrast_thresholds or (self._preset and self._preset.contrast_thresholds)
        if thresholds:
            self.sensor = replace(self.sensor, contrast_thresholds=thresholds)
        notes: list[str] = []
        view = self._view(notes)
        times, exposures = self._exposures(view)
        first = view.events.brightness(view.start)
        if first.ndim == 2 and self.bayer_pattern:
            raise RecordingError(f"--bayer-pattern needs colours, but {self.scene or self.from_run} is grey.")
        if first.ndim == 2 and self.color:
            notes.append(f"--color changes nothing, since {self.scene or self.from_run} is grey.")
        sensor = EventSensor(self.sensor, self._seen(first, view.events), view.start)
        setup = Setup(
            event_camera=view.event_camera,
            frame_camera=view.frame_camera,
            event_from_frame=view.event_from_frame,
            trajectory=view.trajectory,
            frame_times=times,
            exposure=exposures.exposure,
            contrast_thresholds=self.sensor.contrast_thresholds,
            pixel_thresholds=sensor.contrast_thresholds if self.sensor.threshold_spread else None,
            refractory_period=self.sensor.refractory_period,
            bayer_pattern=self.bayer_pattern,
            response=Logarithm(self.sensor.log_eps).name,
            settings={**self._settings(view, exposures), "frame_settings": asdict(self.frame)},
        )
        is_new = not output_dir.exists()
        try:
            output_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"{output_dir} cannot be made a folder ({error.strerror}); give another --output-dir."
            ) from error
        with ExitStack() as stack:
            if is_new:
                stack.callback(_remove_if_empty, output_dir)
            writer = stack.enter_context(open_writer(self.layout, output_dir, setup))
            preview = None
            if self.preview:
                size = view.events.width, view.events.height
                preview = stack.enter_context(Preview(output_dir / "preview.mp4", *size))
            self._record(view, exposures, sensor, writer, preview)
        if not writer.num_events:
            notes.append("There are no events, without which a recording cannot be read; let more change.")
        for note in [*notes, *writer.notes]:
            CONSOLE.print(f"note: {note}", highlight=False, markup=False)
        CONSOLE.print(
            f"{writer.num_events:,} events and {writer.num_frames} frames of {(view.end - view.start) * 1e-9:g} s are "
            f"in {output_dir}",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
        if view.trajectory is not None and writer.num_events:
            for what, command in (("look at it", "enerf inspect"), ("train", "ns-train enerf --data")):
                line = f"{what}: {command} {shlex.quote(str(output_dir))}"
                CONSOLE.print(line, soft_wrap=True, highlight=False, markup=False)

    def _check_flags(self) -> None:
        for flag, value, fine, expected in (
            ("--duration", self.duration, lambda v: 1e-3 <= v <= 1000, "seconds from 0.001 to 1000"),
            ("--num-frames", self.num_frames, lambda v: v > 0, "at least 1"),
            ("--exposure-ms", self.exposure_ms, lambda v: 0 <= v < np.inf, "milliseconds from 0 on"),
            ("--width", self.width, lambda v: 0 < v < 2**15, "pixels above 0"),
            ("--height", self.height, lambda v: 0 < v < 2**15, "pixels above 0"),
            ("--field-of-view", self.field_of_view, lambda v: 0 < v < 180, "degrees between 0 and 180"),
            ("--max-displacement", self.max_displacement, lambda v: 0 < v < np.inf, "pixels above 0"),
            ("--max-change", self.max_change, lambda v: 0 < v < np.inf, "a change of log brightness above 0"),
            ("--bayer-pattern", self.bayer_pattern, lambda v: len(v) == 4 and set(v) <= set("RGB"),
             "four letters of R, G and B"),
        ):  # fmt: skip
            if value is not None and not fine(value):
                raise RecordingError(f"{flag} is {value}, but must be {expected}.")
        if bool(self.scene) == (self.from_run is not None):
            raise RecordingError("Give either what is to be seen, such as shapes or a mesh, or --from-run config.yml.")

    def _check_use(self) -> None:
        """Refuses flags that would change nothing."""
        poses_file = self.trajectory is not None and not self.trajectory.expanduser().is_dir()
        sizes = ("--width", "--height", "--field-of-view")
        rig = writer_of(self.layout).published_rig if self.layout else None
        own_rig = rig is not None and self.cameras is None and self.from_run is None and self._pictures is None
        for applies, situation, useless in (
            (self._pictures, "for pictures, which have their size and no poses",
             ("--motion", "--key-frames", "--trajectory", "--cameras", "--width", "--height", "--max-displacement")),
            (self._pictures and not self.sensor.cutoff_frequency, "for pictures without --cutoff-frequency",
             ("--max-change",)),
            (self._pictures is None, "without a folder of images or a video",
             ("--frames-per-second", "--stamps", "--no-gamma")),
            (self._pictures and self._pictures.is_file(), "for a video", ("--stamps",)),
            (self.from_run, "for a trained run", ("--motion", "--cameras")),
            (self.key_frames, "beside --key-frames", ("--motion", "--trajectory")),
            (self.trajectory, "beside --trajectory", ("--motion",)),
            (not poses_file, "unless --trajectory is a text file of poses", ("--trajectory-unit",)),
            (self.cameras, "beside --cameras", sizes),
            (own_rig, f"in the layout {self.layout} without --cameras, whose cameras are those of the data set "
             f"({rig[0].width} x {rig[0].height} pixels)" if rig else "", sizes),
        ):  # fmt: skip
            for flag in useless:
                name = flag.removeprefix("--no-").removeprefix("--").replace("-", "_")
                if applies and getattr(self, name) != DEFAULTS[name]:
                    raise RecordingError(f"{flag} changes nothing {situation}; leave it out.")

    @property
    def _pictures(self) -> Path | None:
        """The folder of images or the video that is seen, if it is one."""
        if self.scene is None or self.scene in PRESETS or self.scene in SCENES:
            return None
        path = Path(self.scene).expanduser()
        return path if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES else None

    @property
    def _preset(self) -> SimulationPreset | None:
        return PRESETS.get(self.scene or "")

    def _view(self, notes: list[str]) -> View:
        """What is looked at, by which cameras and from where."""
        end = None if self.duration is None else round(self.duration * 1e9)
        if self._pictures is not None:
            return self._pictures_view(self._pictures, end)
        if self.from_run is not None:
            trajectory = self._given_trajectory(notes)
            run = TrainedRun(self.from_run.expanduser().resolve(), trajectory, end or round(SECONDS * 1e9))
            if self.width or self.height or self.field_of_view:
                run.camera = self._pinhole(run.camera)
            end = _until(str(self.trajectory or self.key_frames or self.from_run), run.end, end)
            return View(run, None, run.trajectory, run.camera, run.camera, np.eye(4), run.start, end)
        assert self.scene is not None
        scene_rng, motion_rng = np.random.default_rng(self.sensor.seed).spawn(2)
        preset = self._preset
        name = preset.scene if preset else self.scene
        scene = SCENES[name](scene_rng) if name in SCENES else load_scene(self._file(), scene_rng, notes)
        if not (self.color or self.bayer_pattern):
            scene = scene.grey()
        trajectory = self._given_trajectory(notes)
        if trajectory is None:
            seconds = self.duration or (preset.duration if preset else SECONDS)
            if preset:
                moved = replace(preset, duration=seconds, motion=self.motion or preset.motion)
                trajectory = moved.trajectory(scene.camera, scene.target, motion_rng)
            else:
                motion = MOTIONS[self.motion or "shake"]
                trajectory = motion(round(seconds * 1e9), scene.camera, scene.target, motion_rng)
        assert self.layout is not None
        poses_per_second = writer_of(self.layout).poses_per_second
        if poses_per_second is not None:
            given = self.trajectory or self.key_frames
            trajectory, original = sampled(trajectory, poses_per_second), trajectory
            if given and trajectory is not original:
                notes.append(
                    f"{given} is followed through {poses_per_second} poses a second, as many as {self.layout} has."
                )
        event_camera, frame_camera, event_from_frame = self._read_cameras()
        for camera in (event_camera, frame_camera):
            if camera.width * camera.height > MOST_PIXELS:
                raise RecordingError(
                    f"A camera of {camera.width} x {camera.height} pixels is too large to be simulated; give one of at "
                    f"most {MOST_PIXELS:,} pixels."
                )
        events = RenderedScene(Renderer(scene, event_camera), trajectory)
        frames = None
        if is_second_camera(event_camera, frame_camera, event_from_frame):
            if np.diff(trajectory.times).max() > SPARSE:
                trajectory = sampled(trajectory, POSES_PER_SECOND)  # so that both cameras stay as they are mounted
                events = RenderedScene(events.renderer, trajectory)
            frames = RenderedScene(Renderer(scene, frame_camera), trajectory.of_mounted(event_from_frame))
        end = _until(str(self.trajectory or self.key_frames), trajectory.end, end)
        names = ("the event camera", "the frame camera") if frames else ("the camera",)
        for what, source in zip(names, filter(None, (events, frames)), strict=True):
            check_view(self.scene, what, source, trajectory.start, end, notes)
        cameras = event_camera, frame_camera, event_from_frame
        return View(events, frames, trajectory, *cameras, trajectory.start, end)

    def _pictures_view(self, path: Path, end: int | None) -> View:
        if self.layout != "event_recording":
            raise RecordingError(
                f"{path} has pictures and no poses, which --layout {self.layout} needs; give --layout event_recording."
            )
        if path.is_dir():
            stamps = self.stamps and self.stamps.expanduser()
            source = ImageFolder(path, self.frames_per_second, stamps, gamma=self.gamma, log_eps=self.sensor.log_eps)
        else:
            source = Video(path, self.frames_per_second, self.gamma, self.sensor.log_eps)
        camera = _centred(source.width, source.height, self.field_of_view or FIELD_OF_VIEW)
        return View(source, None, None, camera, camera, np.eye(4), source.start, _until(str(path), source.end, end))

    def _file(self) -> Path:
        assert self.scene is not None
        path = Path(self.scene).expanduser()
        if not path.exists():
            raise RecordingError(
                f"{self.scene} is neither a preset ({', '.join(PRESETS)}) nor a scene ({', '.join(SCENES)}) nor a file "
                "or folder that exists; give one of these."
            )
        return path

    def _given_trajectory(self, notes: list[str]) -> Trajectory | None:
        if self.key_frames is not None:
            return key_frames(self.key_frames.expanduser())
        if self.trajectory is not None:
            return from_file(self.trajectory.expanduser(), notes, self.trajectory_unit)
        return None

    def _pinhole(self, like: Camera | None = None) -> Camera:
        """As the flags, and where they are not given as another camera or the preset has it."""
        preset = self._preset
        usual, angle = SIZE, FIELD_OF_VIEW
        if like is not None:
            usual, angle = (like.width, like.height), 2 * np.degrees(np.arctan(like.width / 2 / like.fx))
        elif preset is not None:
            usual, angle = (preset.width, preset.height), preset.field_of_view
        width = self.width or max(1, round((self.height or usual[1]) * usual[0] / usual[1]))
        height = self.height or max(1, round(width * usual[1] / usual[0]))
        return _centred(width, height, self.field_of_view or angle)

    def _read_cameras(self) -> tuple[Camera, Camera, np.ndarray]:
        """Of events and of frames, and the pose of the latter in the axes of the former."""
        if self.cameras is not None:
            return read_cameras(self.cameras.expanduser())
        assert self.layout is not None
        rig = writer_of(self.layout).published_rig
        if rig is not None:
            return rig
        camera = self._pinhole()
        return camera, camera, np.eye(4)

    def _exposures(self, view: View) -> tuple[np.ndarray, Exposures]:
        """Times of the frames, evenly spread, and their exposures, in whole microseconds."""
        preset = self._preset
        length = view.end - view.start
        rate = preset.num_frames / preset.duration if preset else FRAME_RATE
        assert self.layout is not None
        count = self.num_frames or max(writer_of(self.layout).fewest_frames, round(rate * length * 1e-9))
        exposure_ms = self.exposure_ms
        if exposure_ms is None:
            longest = max(0, length // count // 2000 - 1) * 2e-3
            exposure_ms = min(preset.exposure_ms if preset else EXPOSURE_MS, longest)
        exposure = round(exposure_ms * 500) * 2000
        if count * 1000 > length or (count == 1 and exposure > length):
            raise RecordingError(
                f"{length * 1e-9:g} s have no room for {count} frame{'s' * (count > 1)} with exposures of "
                f"{exposure * 1e-6:g} ms, since frames are at least 1 us apart; give less or a longer --duration."
            )
        times = view.start + ((np.arange(count) + 0.5) * length / count).astype(np.int64) // 1000 * 1000
        return times, Exposures(times, exposure)

    def _settings(self, view: View, exposures: Exposures) -> dict[str, Any]:
        """All flags, with what those that were left out came to."""
        settings = asdict(self)
        settings["duration"] = (view.end - view.start) * 1e-9
        settings["num_frames"], settings["exposure_ms"] = len(exposures.times), exposures.exposure * 1e-6
        if self.scene and not (self._pictures or self.key_frames or self.trajectory):
            settings["motion"] = self.motion or (self._preset.motion if self._preset else "shake")
        for name in ("output_dir", "preview"):
            del settings[name]
        return json.loads(json.dumps(settings, default=str))

    def _seen(self, brightness: np.ndarray, source: Source, pixels: np.ndarray | None = None) -> np.ndarray:
        """What the pixels of the event camera, or these, see of a grey or coloured brightness, [height, width] or
        [pixels]."""
        shape = (source.height, source.width) if pixels is None else pixels.shape
        if brightness.shape == shape:
            return brightness
        filters = None
        if self.bayer_pattern is not None:
            filters = _filters(self.bayer_pattern, source.width, source.height)
            filters = filters.view(shape) if pixels is None else filters[pixels]
        return pixel_brightness(torch.from_numpy(brightness), filters).numpy()

    def _record(
        self, view: View, exposures: Exposures, sensor: EventSensor, writer: Writer, preview: Preview | None
    ) -> None:
        def add_events(events: Events) -> None:
            writer.add_events(events)
            if preview is not None:
                preview.add_events(events)

        def add_frame(frame: Frame, source: Source) -> None:
            depth = source.depth(frame.time) if isinstance(source, RenderedScene | TrainedRun) else None
            seed = self.sensor.seed
            sharp = develop(frame.sharp, self.frame, frame.number, False, seed)
            blurred = None if frame.blurred is None else develop(frame.blurred, self.frame, frame.number, True, seed)
            linear = (frame.sharp, frame.blurred) if self.frame.hdr else None
            writer.add_frame(frame.number, frame.time, sharp, blurred, depth, linear)
            if preview is not None:
                preview.add_frame(sharp, blurred, depth)

        stops = np.array([view.start, view.end])
        others: Iterator[Frame] = iter(())
        if view.frames is None:
            stops = np.union1d(stops, exposures.stops)
        else:
            others = self._frames(view.frames, exposures)
        following = next(others, None)
        columns = (TextColumn("Simulating"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=CONSOLE, transient=True) as progress:
            task = progress.add_task("", total=1.0)
            for time, picture, before in self._renders(view.events, stops, self.max_change):
                if time > view.start:
                    before = [
                        part._replace(brightness=self._seen(part.brightness, view.events, part.pixels))
                        for part in before
                    ]
                    add_events(sensor.advance(self._seen(picture, view.events), time, before))
                if view.frames is None:
                    frame = exposures.add(time, self._shown(picture))
                    if frame is not None:
                        add_frame(frame, view.events)
                while following is not None and following.time <= time:
                    assert view.frames is not None
                    add_frame(following, view.frames)
                    following = next(others, None)
                progress.update(task, completed=(time - view.start) / (view.end - view.start))
            add_events(sensor.finish())

    def _renders(self, source: Source, stops: np.ndarray, max_change: float) -> Iterator[Render]:
        """Pictures at these times, and as many between them as motion and brightness need."""
        if isinstance(source, Pictures):
            times = np.union1d(stops, source.times[(source.times > stops[0]) & (source.times < stops[-1])])
            max_change = max_change if self.sensor.cutoff_frequency else np.inf  # else all between is on a line
            yield from adaptive_renders(source.brightness, times, max_change, self.sensor.log_eps, threads=1)
            return
        assert isinstance(source, RenderedScene | TrainedRun)
        for start, end in pairwise([*range(stops[0], max(stops[-1], stops[0] + 1), WINDOW), stops[-1]]):
            within = np.union1d([start, end], stops[(stops > start) & (stops < end)])
            times = render_times(source.camera, source.trajectory, source.depth, within, self.max_displacement)
            renders = adaptive_renders(source.brightness, times, max_change, self.sensor.log_eps)
            if start > stops[0]:
                next(renders)  # the last one of the window before
            yield from renders

    def _frames(self, source: Source, exposures: Exposures) -> Iterator[Frame]:
        """The frames of a camera of their own, which is only rendered during exposures."""
        for stops in np.stack([exposures.opens, exposures.times, exposures.closes], axis=1):
            for time, picture, _ in self._renders(source, np.unique(stops), np.inf):
                frame = exposures.add(time, self._shown(picture))
                if frame is not None:
                    yield frame

    def _shown(self, picture: np.ndarray) -> np.ndarray:
        """What frames show of a picture."""
        return picture if self.color or picture.ndim == 2 else luma(torch.from_numpy(picture)).numpy()


DEFAULTS = {setting.name: setting.default for setting in fields(Simulate)}


@cache
def _filters(pattern: str, width: int, height: int) -> torch.Tensor:
    """Colour channel that each pixel sees."""
    return ColourFilter(pattern, width).channels(torch.arange(width * height))


def _centred(width: int, height: int, field_of_view: float) -> Camera:
    """A pinhole camera that looks through the middle of its picture, as the ESIM layout wants it; degrees."""
    focal_length = float(width / 2 / np.tan(np.radians(field_of_view / 2)))
    return Camera(width, height, focal_length, focal_length, width / 2, height / 2)


def _until(name: str, end: int, wanted: int | None) -> int:
    """When the recording ends (ns), of what lasts until `end`."""
    if wanted is not None and wanted > end:
        raise RecordingError(
            f"--duration is {wanted * 1e-9:g} s, but {name} lasts {end * 1e-9:.9g} s; give less or leave it out."
        )
    return end if wanted is None else wanted


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()
