"""The view of a simulation: sources of brightness, cameras, trajectory and duration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from enerf_ns.dataparsers.formats.event_recording import read_cameras
from enerf_ns.dataparsers.formats.registry import writer_of
from enerf_ns.dataparsers.formats.writer import is_second_camera
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import absolute, expanded
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.sensor.response import response_named
from enerf_ns.simulator.paper_sequences import PRESETS
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scene_files import load_scene
from enerf_ns.simulator.scene.scenes import SCENES, Scene
from enerf_ns.simulator.scene.view_check import check_view
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.sources import ImageFolder, RenderedScene, Source, TrainedRun, Video
from enerf_ns.simulator.trajectories import POSES_PER_SECOND, from_file, key_frames, sampled

MOST_PIXELS = 2**24
"""Most pixels of a camera. Rendering takes up to a kilobyte of memory for each."""

SPARSE = 20_000_000
"""Nanoseconds between two poses above which a trajectory is sampled more densely, if there is a second camera."""


@dataclass(frozen=True)
class View:
    """Sources of brightness, cameras, trajectory and duration of a simulation."""

    events: Source
    """Source of brightness for the event camera."""
    frames: Source | None
    """Source of brightness for the frame camera; None if the event camera takes the frames."""
    trajectory: Trajectory | None
    """Trajectory of the event camera; None for pictures."""
    event_camera: Camera
    frame_camera: Camera
    event_from_frame: Float64[np.ndarray, "4 4"]
    """Pose of the frame camera in the axes of the event camera, metres."""
    start: int
    """Start of the recording, ns."""
    end: int
    """End of the recording, ns."""


def view_of(settings: SimulationSettings, notes: list[str]) -> View:
    """The view that settings ask for; makes or loads its scene, pictures or run.

    Args:
        settings: As `settings.resolve` returns them.
        notes: Gets one sentence for each thing that the user should know.

    Raises:
        RecordingError: The scene, pictures, run, cameras or trajectory cannot be read or used.
        FlagError: The recording would last longer than the trajectory or the video, or a camera has too many pixels.
    """
    if settings.pictures is not None:
        return _pictures_view(settings, settings.pictures)
    if settings.from_run is not None:
        return _run_view(settings, settings.from_run, notes)
    return _scene_view(settings, notes)


def _pictures_view(settings: SimulationSettings, path: Path) -> View:
    rate, response = settings.frames_per_second, response_named(settings.sensor.response)
    if path.is_dir():
        stamps = settings.stamps and expanded(settings.stamps)
        source = ImageFolder(path, rate, stamps, gamma=settings.gamma, response=response)
    else:
        source = Video(path, rate, settings.gamma, response)
    camera = _centred(source.width, source.height, settings.field_of_view or settings.preset.field_of_view)
    return View(source, None, None, camera, camera, np.eye(4), source.start, _end(settings, source.end, str(path)))


def _run_view(settings: SimulationSettings, config: Path, notes: list[str]) -> View:
    duration = settings.duration or settings.preset.duration
    run = TrainedRun(absolute(config), _given_trajectory(settings, notes), round(duration * 1e9))
    if settings.width or settings.height or settings.field_of_view:
        run.camera = _pinhole(settings, run.camera)
    end = _end(settings, run.end, str(settings.trajectory or settings.key_frames or config))
    return View(run, None, run.trajectory, run.camera, run.camera, np.eye(4), run.start, end)


def _scene_view(settings: SimulationSettings, notes: list[str]) -> View:
    assert settings.scene is not None
    _, motion_rng = np.random.default_rng(settings.sensor.seed).spawn(2)
    scene = scene_of(settings, notes)
    trajectory = _motion(settings, scene, motion_rng, notes)
    event_camera, frame_camera, event_from_frame = _cameras(settings)
    has_two = is_second_camera(event_camera, frame_camera, event_from_frame)
    if has_two and np.diff(trajectory.times).max() > SPARSE:
        trajectory = sampled(trajectory, POSES_PER_SECOND)  # so that both cameras stay as they are mounted
    sources = [RenderedScene(Renderer(scene, event_camera), trajectory)]
    if has_two:
        sources.append(RenderedScene(Renderer(scene, frame_camera), trajectory.of_mounted(event_from_frame)))
    end = _end(settings, trajectory.end, str(settings.trajectory or settings.key_frames))
    names = ("the event camera", "the frame camera") if has_two else ("the camera",)
    for name, source in zip(names, sources, strict=True):
        check_view(settings.scene, name, source, trajectory.start, end, notes)
    frames = sources[1] if has_two else None
    cameras = event_camera, frame_camera, event_from_frame
    return View(sources[0], frames, trajectory, *cameras, trajectory.start, end)


def scene_of(settings: SimulationSettings, notes: list[str]) -> Scene:
    """The scene of settings; the same settings always make the same scene.

    Args:
        settings: Their `scene` is a preset, a name in `SCENES`, a mesh file or a scene file.
        notes: As for `scene_files.load_scene`.

    Raises:
        RecordingError: The name of the scene is not known, or the file cannot be used.
    """
    name, rng = settings.preset.scene or settings.scene, np.random.default_rng(settings.sensor.seed).spawn(2)[0]
    assert name is not None
    if name in SCENES:
        scene = SCENES[name](rng)
    else:
        path = expanded(name)
        if not path.exists():
            raise RecordingError(
                f"{name} is neither a preset ({', '.join(PRESETS)}) nor a scene ({', '.join(SCENES)}) nor a file or "
                "folder that exists; give one of these."
            )
        scene = load_scene(path, rng, notes)
    return scene if settings.colour or settings.bayer_pattern else scene.grey()


def _motion(settings: SimulationSettings, scene: Scene, rng: np.random.Generator, notes: list[str]) -> Trajectory:
    """Trajectory of the event camera, with as many poses per second as the layout has."""
    trajectory, preset = _given_trajectory(settings, notes), settings.preset
    if trajectory is None:
        moved = replace(preset, duration=settings.duration or preset.duration, motion=settings.motion or preset.motion)
        trajectory = moved.trajectory(scene.camera, scene.target, rng)
    assert settings.layout is not None
    poses_per_second = writer_of(settings.layout).poses_per_second
    if poses_per_second is None:
        return trajectory
    thinned, given = sampled(trajectory, poses_per_second), settings.trajectory or settings.key_frames
    if given and thinned is not trajectory:
        notes.append(
            f"{given} is followed through {poses_per_second} poses a second, as many as the layout "
            f"{settings.layout} has."
        )
    return thinned


def _given_trajectory(settings: SimulationSettings, notes: list[str]) -> Trajectory | None:
    if settings.key_frames is not None:
        return key_frames(expanded(settings.key_frames))
    if settings.trajectory is not None:
        return from_file(expanded(settings.trajectory), notes, settings.trajectory_unit)
    return None


def _cameras(settings: SimulationSettings) -> tuple[Camera, Camera, np.ndarray]:
    """Event camera, frame camera, and the pose of the frame camera in the axes of the event camera."""
    assert settings.layout is not None
    rig = writer_of(settings.layout).published_rig
    if settings.cameras is not None:
        rig = read_cameras(expanded(settings.cameras))
    elif rig is None:
        camera = _pinhole(settings)
        rig = camera, camera, np.eye(4)
    for camera in rig[:2]:
        _check_size(camera.width, camera.height)
    return rig


def _check_size(width: int, height: int) -> None:
    """Raises a FlagError for a camera that takes too long to simulate."""
    if width * height > MOST_PIXELS:
        raise FlagError(
            f"A camera of {width} x {height} pixels is too large to be simulated; give one of at most {MOST_PIXELS:,} "
            "pixels."
        )


def _pinhole(settings: SimulationSettings, like: Camera | None = None) -> Camera:
    """Pinhole camera of the settings; what they leave out is taken from another camera or the preset."""
    usual = like or settings.preset
    angle = settings.preset.field_of_view if like is None else 2 * np.degrees(np.arctan(like.width / 2 / like.fx))
    width = settings.width or max(1, round((settings.height or usual.height) * usual.width / usual.height))
    height = settings.height or max(1, round(width * usual.height / usual.width))
    return _centred(width, height, settings.field_of_view or angle)


def _centred(width: int, height: int, field_of_view: float) -> Camera:
    """A pinhole camera with its principal point in the middle, as the ESIM layout needs; field of view in degrees."""
    _check_size(width, height)
    focal_length = float(width / 2 / np.tan(np.radians(field_of_view / 2)))
    try:
        return Camera(width, height, focal_length, focal_length, width / 2, height / 2)
    except ValueError as error:
        raise FlagError(
            f"--field-of-view is {field_of_view:g} degrees, which makes {str(error).partition(', which')[0]}, as no "
            "lens has; give another."
        ) from error


def _end(settings: SimulationSettings, last: int, name: str) -> int:
    """End of the recording (ns), if the source called `name` ends at `last` (ns)."""
    if settings.duration is None:
        return last
    end = round(settings.duration * 1e9)
    if end > last:
        raise FlagError(
            f"--duration is {settings.duration:g} s, but {name} lasts {last * 1e-9:.9g} s; give less or leave it out."
        )
    return end
