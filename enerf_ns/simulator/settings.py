"""The settings of `engine.simulate`, which are the flags of `enerf simulate`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Optional  # tyro reads these annotations on Python 3.10

import tyro

from enerf_ns.dataparsers.formats.registry import layouts, writer_of
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.files import expanded
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.frames import FrameSettings
from enerf_ns.simulator.paper_sequences import PRESETS, USUAL, SimulationPreset
from enerf_ns.simulator.sampling import MAX_CHANGE, MAX_DISPLACEMENT
from enerf_ns.simulator.scene.scenes import SCENES

if TYPE_CHECKING:
    Layout = str
else:
    Layout = Literal[layouts()]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


@dataclass(frozen=True)
class SimulationSettings:
    """Scene, motion of the camera, event sensor and frame sensor of a simulation.

    `resolve` refuses settings that contradict one another.
    """

    scene: Annotated[Optional[str], tyro.conf.Positional] = None  # noqa: UP045
    """Scene to simulate: a preset (spiral1, spiral2, shake-moon1, shake-moon2, shake-carpet1), a scene (shapes,
    carpet, roads, moon, board), a mesh file (.glb, .gltf, .obj, .off, .ply, .stl), a scene file (.json), a folder of
    images, or a video."""
    from_run: Optional[Path] = None  # noqa: UP045
    """config.yml of a Nerfstudio run, which the simulator renders instead of a scene."""
    motion: Optional[Literal["shake", "spiral"]] = None  # noqa: UP045
    """Motion of the camera: forward-facing with abrupt turns (shake), or an inward spiral. Default: that of the preset,
    else shake."""
    key_frames: Optional[Path] = None  # noqa: UP045
    """Text file of positions of the camera and of its target, used instead of a motion. Each line is `t x y z tx ty
    tz`: seconds, metres, z up."""
    trajectory: Optional[Path] = None  # noqa: UP045
    """Recording or text file of poses whose trajectory is used instead of a motion. Each line of a text file is
    `t px py pz qx qy qz qw`: camera to world, metres, OpenCV axes."""
    trajectory_unit: Literal["s", "us", "ns"] = "s"
    """Unit of the times in the text file of poses."""
    duration: Optional[float] = None  # noqa: UP045
    """Duration of the recording in seconds. Default: that of the preset, the trajectory or the video, else 1."""
    num_frames: Optional[int] = None  # noqa: UP045
    """Number of frames, at regular times. Default: the frame rate of the preset, else 41 frames per second."""
    exposure_ms: Optional[float] = None  # noqa: UP045
    """Exposure of the blurred frames in milliseconds, centred at the time of the frame. 0 makes no blurred frames.
    Default: that of the preset, else 20, but at most the time from one frame to the next."""
    width: Optional[int] = None  # noqa: UP045
    """Width of events and frames in pixels. Default: that of the preset or the run, else 160; if only the height is
    given, the width in proportion to it."""
    height: Optional[int] = None  # noqa: UP045
    """Height of events and frames in pixels. Default: that of the preset or the run, else 120; if only the width is
    given, the height in proportion to it."""
    field_of_view: Optional[float] = None  # noqa: UP045
    """Horizontal field of view in degrees. Default: that of the preset or the run, else 60."""
    cameras: Optional[Path] = None  # noqa: UP045
    """JSON file with `camera` and, if a second camera takes the frames, `frame_camera`, as in recording.json."""
    layout: Optional[Layout] = None  # noqa: UP045
    """Layout of the folder: that of E-NeRF's ESIM sequences, of EDS or TUM-VIE as published, or this package's own
    (event_recording). Default: event_recording for images, videos, runs and colour filters, else esim."""
    colour: Annotated[bool, tyro.conf.arg(aliases=["--color"])] = False
    """Make frames in colour, if the scene is in colour."""
    bayer_pattern: Optional[str] = None  # noqa: UP045
    """Colour filter of the event camera: the colours of the pixels (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB.
    Default: no filter, a grey sensor."""
    frames_per_second: Optional[float] = None  # noqa: UP045
    """Frame rate at which the video or the images of the folder were recorded. Default: the rate stated in the
    video."""
    stamps: Optional[Path] = None  # noqa: UP045
    """Text file with the times of the images of the folder in seconds, one a line."""
    gamma: bool = True
    """Take the values of the images or the video for sRGB instead of linear brightness."""
    contrast_thresholds: Optional[tuple[float, float]] = None  # noqa: UP045
    """Contrast thresholds of on events and of off events: the change of log brightness that causes one event. Default:
    those of the preset, else 0.25 0.25."""
    max_displacement: float = MAX_DISPLACEMENT
    """Largest motion of any point, in pixels, from one rendered picture to the next."""
    max_change: float = MAX_CHANGE
    """Largest change of log brightness of a pixel until it is rendered again, between two pictures."""
    sensor: Annotated[SensorSettings, tyro.conf.arg(name="")] = field(default_factory=SensorSettings)
    """The event sensor."""
    frame: FrameSettings = field(default_factory=FrameSettings)
    """The frame sensor."""

    @property
    def pictures(self) -> Path | None:
        """The folder of images or the video, if the scene is one of these."""
        if self.scene is None or self.scene in PRESETS or self.scene in SCENES:
            return None
        path = expanded(self.scene)
        return path if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES else None

    @property
    def reads(self) -> tuple[Path, ...]:
        """The folders and files that the simulation reads."""
        scene = self.scene if self.scene not in {*PRESETS, *SCENES, None} else None
        read = (scene, self.from_run, self.key_frames, self.trajectory, self.cameras, self.stamps)
        return tuple(Path(path) for path in read if path)

    @property
    def preset(self) -> SimulationPreset:
        """Values of settings that are left out: those of the preset that `scene` names, else `USUAL`."""
        return PRESETS.get(self.scene or "", USUAL)


DEFAULTS = {setting.name: setting.default for setting in fields(SimulationSettings)}


def resolve(settings: SimulationSettings) -> SimulationSettings:
    """The settings with their layout and contrast thresholds filled in.

    Raises:
        FlagError: A setting is out of its range, contradicts another one, or changes nothing.
    """
    _check_ranges(settings)
    if bool(settings.scene) == (settings.from_run is not None):
        raise FlagError("Give either a scene, such as shapes or a mesh file, or --from-run config.yml.")
    layout = settings.layout
    if layout is None:
        layout = "event_recording" if settings.pictures or settings.from_run or settings.bayer_pattern else "esim"
    if settings.bayer_pattern and layout != "event_recording":
        raise FlagError(f"--layout {layout} has no place for a --bayer-pattern; give --layout event_recording.")
    if settings.pictures and layout != "event_recording":
        raise FlagError(
            f"{settings.pictures} has pictures but no poses, which --layout {layout} needs; give --layout "
            "event_recording."
        )
    _check_use(settings, layout)
    sensor = settings.sensor
    thresholds = settings.contrast_thresholds
    if thresholds is None and settings.scene in PRESETS:
        thresholds = settings.preset.contrast_thresholds
    if thresholds is not None:
        sensor = replace(sensor, contrast_thresholds=thresholds)
    return replace(settings, layout=layout, sensor=sensor)


def _check_ranges(settings: SimulationSettings) -> None:
    for name, fine, expected in (
        ("duration", lambda v: 1e-3 <= v <= 1000, "seconds from 0.001 to 1000"),
        ("num_frames", lambda v: 0 < v <= 10**9, "at least 1 and at most 10^9"),
        ("exposure_ms", lambda v: 0 <= v <= 1e6, "milliseconds from 0 to 10^6"),
        ("width", lambda v: 0 < v < 2**15, "pixels from 1 to 32767"),
        ("height", lambda v: 0 < v < 2**15, "pixels from 1 to 32767"),
        ("field_of_view", lambda v: 0 < v < 180, "degrees between 0 and 180"),
        ("frames_per_second", lambda v: 1e-3 <= v <= 1e6, "from 0.001 to 1000000"),
        ("max_displacement", lambda v: 0 < v <= 1e6, "pixels above 0, and at most 10^6"),
        ("max_change", lambda v: 0 < v <= 1e6, "a change of log brightness above 0, and at most 10^6"),
        ("bayer_pattern", lambda v: len(v) == 4 and set(v) <= set("RGB"), "four letters of R, G and B"),
    ):
        value = getattr(settings, name)
        if value is not None and not fine(value):
            raise FlagError(f"--{name.replace('_', '-')} is {value}, but must be {expected}.")


def _check_use(settings: SimulationSettings, layout: str) -> None:
    """Refuses settings that would change nothing."""
    pictures, trajectory = settings.pictures, settings.trajectory
    poses_file = trajectory is not None and not expanded(trajectory).is_dir()
    sizes = ("--width", "--height", "--field-of-view")
    rig = writer_of(layout).published_rig
    own_rig = rig is not None and settings.cameras is None and settings.from_run is None and pictures is None
    for applies, situation, useless in (
        (pictures, "for pictures, which have their size and no poses",
         ("--motion", "--key-frames", "--trajectory", "--cameras", "--width", "--height", "--max-displacement")),
        (pictures and not settings.sensor.cutoff_frequency, "for pictures without --cutoff-frequency",
         ("--max-change",)),
        (pictures is None, "without a folder of images or a video",
         ("--frames-per-second", "--stamps", "--no-gamma")),
        (pictures and pictures.is_file(), "for a video", ("--stamps",)),
        (settings.from_run, "for a trained run", ("--motion", "--cameras")),
        (settings.key_frames, "beside --key-frames", ("--motion", "--trajectory")),
        (trajectory, "beside --trajectory", ("--motion",)),
        (not poses_file, "unless --trajectory is a text file of poses", ("--trajectory-unit",)),
        (settings.cameras, "beside --cameras", sizes),
        (own_rig, f"in the layout {layout} without --cameras, whose cameras are those of the data set "
         f"({rig[0].width} x {rig[0].height} pixels)" if rig else "", sizes),
    ):  # fmt: skip
        for flag in useless:
            name = flag.removeprefix("--no-").removeprefix("--").replace("-", "_")
            if applies and getattr(settings, name) != DEFAULTS[name]:
                raise FlagError(f"{flag} changes nothing {situation}; leave it out.")
