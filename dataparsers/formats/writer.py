"""Writes a recording as it comes, in pieces: what the writers of all layouts share.

Calibration and poses are there from the beginning, and events and frames are added in pieces, so that memory does not
grow with duration, and what was written can be read when the disk is full or the process is stopped.

Beside what a layout has, in all of them, with files named by the numbers of the frames:

    simulation.json     the true contrast thresholds and all settings, cameras and extrinsics; "finished" is false, and
                        the numbers of events and frames are not final, if the simulation was broken off
    thresholds.npy      float32 [2, height, width], on and off threshold of each pixel of the event camera, if they vary
    depth/              .npy, float32 [height, width], z-depth in metres of each frame, 0 where nothing was hit
    sharp_images/       .png, in eds and tum_vie, whose own frames are blurred as those of a real camera
    hdr/, hdr_blurred/  .npy, float32 linear brightness of frames, R G B if in colour, and .exr where OpenCV writes that
                        (it does with OPENCV_IO_ENABLE_OPENEXR=1 in the environment)
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, Shaped, UInt8
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError
from enerf_ns.dataparsers.recording.files import write_all, write_together
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA_KEYS = ("width", "height", "model", "fx", "fy", "cx", "cy")
MOUNTING_KEY = "event_camera_from_frame_camera"

FEWEST_FRAMES, FEWEST_POSES = 11, 101
"""Fewest frames and poses that the reference code of E-NeRF accepts."""

LARGEST_SMALL_SIDE, LARGEST_SMALL_CENTRE = 200, 100
"""Width or height, and place of the principal point, in pixels, that it does not accept yet."""

Rig = tuple[Camera, Camera, Float64[np.ndarray, "4 4"]]
"""Cameras of events and of frames, and the pose of the latter in the axes of the former."""


@dataclass(frozen=True)
class Setup:
    """What is known of a recording before the first picture."""

    event_camera: Camera
    frame_camera: Camera
    event_from_frame: Float64[np.ndarray, "4 4"]
    """Extrinsics: pose of the frame camera in the axes of the event camera, metres."""
    trajectory: Trajectory | None
    """Trajectory of the event camera; None for a source without poses, whose recording then lacks them too."""
    frame_times: Int64[np.ndarray, " frames"]
    """Times of the frames, ns, increasing: the middles of the exposures."""
    exposure: int
    """Exposure of the blurred frames, ns; 0 for sharp frames alone."""
    contrast_thresholds: tuple[float, float]
    """Contrast thresholds of on and of off events."""
    pixel_thresholds: Float32[np.ndarray, "2 height width"] | None = None
    """Contrast thresholds of each pixel for on and for off events, if they vary."""
    refractory_period: int = 0
    """For how long a pixel is blind after an event, ns."""
    bayer_pattern: str | None = None
    """Colours of the event camera's pixels (0, 0), (1, 0), (0, 1), (1, 1), such as RGGB; None for a grey camera."""
    response: str | None = None
    """How the event camera answers brightness, as `EventRecording.response` has it, where that is known."""
    settings: dict[str, Any] = field(default_factory=dict)
    """All else that simulation.json shall state; values that JSON can hold."""


class Writer(ABC):
    """A recording that is being written, in a `with` statement at whose end it is finished.

    Args:
        folder: Exists and is empty.
        setup: What is recorded.

    Raises:
        FlagError: The layout cannot hold these cameras or that few frames, or the extrinsics are no rigid motion.
        OutputError: The disk is full; the methods raise it too.
    """

    layout: ClassVar[str]
    """Name of the format that reads the layout."""
    start: ClassVar[int] = 0
    """What the clock of the layout shows (ns) when the simulation's is at 0."""
    fewest_frames: ClassVar[int] = 1
    """Fewest frames that others who read this layout accept."""
    fills_up_poses: ClassVar[bool] = False
    """Whether poses are added where there are fewer than `FEWEST_POSES`."""
    is_of_reference: ClassVar[bool] = True
    """Whether the reference code of E-NeRF reads this layout."""
    poses_per_second: ClassVar[int | None] = None
    """Poses a second, as many as the data set has, where it has a fixed number."""
    published_rig: ClassVar[Rig | None] = None
    """The cameras of the data set, where it has its own."""
    frame_folders: ClassVar[tuple[str, str]]
    """Folders of the sharp and of the blurred frames, of layouts that have one for each."""
    stamps_name: ClassVar[str]
    """Name of the table of stamps in each of those."""
    events_held: ClassVar[int] = 2**16
    """Events that are held back until they are written, and those in a chunk of an HDF5 file."""

    num_events: int = 0
    """Number of events added so far."""
    num_frames: int = 0
    """Number of frames added so far."""
    notes: list[str]
    """What the user should know, one sentence each."""

    def __init__(self, folder: Path, setup: Setup):
        self.folder, self.setup, self.notes = folder, setup, []
        try:
            check_rotation(setup.event_from_frame[:3, :3])
        except ValueError as error:
            raise FlagError(f"The extrinsics of the frame camera are wrong: their rotation {error}.") from error
        if len(setup.frame_times) < self.fewest_frames:
            raise FlagError(
                f"The layout {self.layout} needs at least {self.fewest_frames} frames, but {len(setup.frame_times)} "
                "were asked for; take more of them or another layout."
            )
        self._check()
        self._pending: list[Events] = []
        self._num_pending = 0
        self._near, self._far = np.inf, 0.0
        with self._writing():
            self._write_calibration()
            if setup.trajectory is not None:
                self._write_poses(setup.trajectory)
            if setup.pixel_thresholds is not None:
                self._replace("thresholds.npy", encode_npy(setup.pixel_thresholds))
            self._write_summary(finished=False)
            self._event_files = self._open_events()
        if self.is_of_reference and (reasons := self._reasons_against_reference()):
            self.notes.append(f"The reference code of E-NeRF does not read this recording: {'; '.join(reasons)}.")

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Smallest and largest depth (metres) of the frames so far; None unless there are two."""
        return (self._near, self._far) if self._near < self._far else None

    def add_events(self, events: Events) -> None:
        """Adds events that lie after those added before. Memory for up to `events_held` of them is held back."""
        if not len(events):
            return
        self.num_events += len(events)
        self._num_pending += len(events)
        self._pending.append(events)
        if self._num_pending >= self.events_held:
            with self._writing():
                self._store_events()

    def add_frame(
        self,
        number: int,
        time: int,
        sharp: UInt8[np.ndarray, "height width *channels"],
        blurred: UInt8[np.ndarray, "height width *channels"] | None,
        depth: Float[np.ndarray, "height width"] | None = None,
        linear: tuple[Float[np.ndarray, "height width *channels"], Float[np.ndarray, "height width *channels"] | None]
        | None = None,
    ) -> None:
        """Adds the next frame, completely or, if that fails, not at all.

        Args:
            number: From 0.
            time: ns, as of the setup.
            sharp: The frame as the sensor reads it out, at that time.
            blurred: The frame with the setup's exposure; None if that is 0.
            depth: z-depth in metres that the frame camera sees at the frame's time, 0 where nothing is hit; None for a
                source that knows none.
            linear: Linear brightness of the sharp and of the blurred frame, kept for its high dynamic range; None: it
                is not kept.
        """
        assert number == self.num_frames and time == self.setup.frame_times[number]
        assert (blurred is None) == (self.setup.exposure == 0)
        name = self._name(number)
        files = {
            path: _encode(Path(path).suffix, image) for path, image in self._images(number, sharp, blurred).items()
        }
        for folder, brightness in zip(("hdr", "hdr_blurred"), linear or (), strict=False):
            if brightness is not None:
                files |= self._encode_hdr(f"{folder}/{name}", brightness)
        if depth is not None:
            files[f"depth/{name}.npy"] = encode_npy(depth)
        with self._writing():
            self._store_events()
            write_together(self.folder, files, self._stamps(time))
        self.num_frames += 1
        if depth is not None and (depth > 0).any():
            self._near = min(self._near, float(depth[depth > 0].min()))
            self._far = max(self._far, float(depth.max()))

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        """Finishes the recording; of one that was broken off, what is there is kept."""
        try:
            with self._writing(), ExitStack() as stack:
                stack.callback(self._write_summary, finished=kind is None)
                stack.callback(self._event_files.close)
                self._store_events()
        except OutputError:
            if kind is None:
                raise

    @abstractmethod
    def _check(self) -> None:
        """Raises FlagError if the layout cannot hold the recording."""

    @abstractmethod
    def _write_calibration(self) -> None: ...

    @abstractmethod
    def _write_poses(self, trajectory: Trajectory) -> None: ...

    @abstractmethod
    def _open_events(self) -> EventFiles: ...

    def _write_depth_range(self) -> None:  # noqa: B027  (a layout that states no range does nothing)
        """Writes what states the range of depth, where the layout does; called when there is one, and at the end."""

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        """The images of a frame, by path."""
        images = zip(self.frame_folders, (sharp, blurred), strict=True)
        return {f"{folder}/{self._name(number)}.png": image for folder, image in images if image is not None}

    def _stamps(self, time: int) -> dict[str, str]:
        """What each table of frames gets for one at this time (ns), by path."""
        folders = self.frame_folders if self.setup.exposure else self.frame_folders[:1]
        return {f"{folder}/{self.stamps_name}": f"{time}\n" for folder in folders}

    def _name(self, number: int) -> str:
        """Name of a frame's files, such that they sort as their numbers do."""
        return f"{number:0{max(5, len(str(len(self.setup.frame_times) - 1)))}d}"

    def _reasons_against_reference(self) -> list[str]:
        """What the reference code of E-NeRF asserts and does not find."""
        setup, camera, reasons = self.setup, self.setup.event_camera, []
        num_frames, num_poses = len(setup.frame_times), len(setup.trajectory.times) if setup.trajectory else 0
        if num_frames < FEWEST_FRAMES:
            reasons.append(f"it wants {FEWEST_FRAMES} frames or more, and there are {num_frames}")
        if num_poses < FEWEST_POSES and not (self.fills_up_poses and num_poses):
            reasons.append(f"it wants {FEWEST_POSES} poses or more, and there are {num_poses}")
        if min(camera.width, camera.height) <= LARGEST_SMALL_SIDE or min(camera.cx, camera.cy) <= LARGEST_SMALL_CENTRE:
            reasons.append(
                f"it wants more than {LARGEST_SMALL_SIDE} pixels along both sides and a centre beyond "
                f"{LARGEST_SMALL_CENTRE}, and there are {camera.width} x {camera.height} with the centre at "
                f"({camera.cx:g}, {camera.cy:g})"
            )
        return reasons

    def _check_size(self, size: tuple[int, int]) -> None:
        camera = self.setup.event_camera
        if (camera.width, camera.height) != size:
            raise FlagError(
                f"The layout {self.layout} holds events of {size[0]} x {size[1]} pixels, but {camera.width} x "
                f"{camera.height} were asked for; choose such a camera or another layout."
            )

    def _write_summary(self, finished: bool) -> None:
        setup = self.setup
        if self.depth_range is not None:
            self._write_depth_range()
        summary = {
            **setup.settings,
            "layout": self.layout,
            "finished": finished,
            "clock_start_ns": self.start,
            "contrast_thresholds": setup.contrast_thresholds,
            "refractory_period_ns": setup.refractory_period,
            "bayer_pattern": setup.bayer_pattern,
            "response": setup.response,
            "camera": camera_json(setup.event_camera),
            "frame_camera": mounted_camera_json(setup.frame_camera, setup.event_from_frame),
            "exposure_ns": setup.exposure,
            "depth_range": self.depth_range,
            "num_events": self.num_events,
            "num_frames": self.num_frames,
        }
        self._replace("simulation.json", encode_json(summary))

    def _replace(self, path: str, content: bytes) -> None:
        write_together(self.folder, {path: content})

    def _store_events(self) -> None:
        if self._pending:
            events = Events(*(np.concatenate([getattr(piece, name) for piece in self._pending]) for name in "xytp"))
            self._pending, self._num_pending = [], 0
            self._event_files.append(events)

    def _encode_hdr(self, stem: str, brightness: np.ndarray) -> dict[str, bytes]:
        files = {f"{stem}.npy": encode_npy(brightness)}
        if _exr_enabled():
            files[f"{stem}.exr"] = _encode(".exr", brightness.astype(np.float32))
        elif NO_EXR not in self.notes:
            self.notes.append(NO_EXR)
        return files

    def _to_us(self, times: Int64[np.ndarray, " times"]) -> Int64[np.ndarray, " times"]:
        """The nearest microseconds within the poses, on the simulation's clock."""
        rounded, trajectory = (times + 500) // 1000, self.setup.trajectory
        return rounded if trajectory is None else rounded.clip(-(-trajectory.start // 1000), trajectory.end // 1000)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns errors of the disk and of the HDF5 library into one sentence."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
            raise OutputError(
                f"{self.folder} could not be written any further ({reason}); what was written before, "
                f"{self.num_frames} frame{'s' * (self.num_frames != 1)} and the events up to there, can be read, but "
                "make room for more or give another folder."
            ) from error


class EventFiles(Protocol):
    """Where events go. What was appended can be read at once or, in HDF5, when a chunk is full."""

    def append(self, events: Events) -> None: ...

    def close(self) -> None:
        """Closes the files; whatever has happened before, as many of each column can be read afterwards."""


class GrowingArray:
    """A .npy file without rows, new or there already, that grows by rows and holds those that were committed."""

    def __init__(self, path: Path, dtype: type, columns: tuple[int, ...] = ()):
        self._dtype, self._columns, self.num_rows = np.dtype(dtype), columns, 0
        if not path.exists():
            write_together(path.parent, {path.name: self._header(0)})
        self._file = open(path, "r+b", buffering=0)

    def append(self, rows: np.ndarray) -> None:
        """Writes rows after those that were committed."""
        row_bytes = self._dtype.itemsize * int(np.prod(self._columns))
        self._file.seek(len(self._header(0)) + self.num_rows * row_bytes)
        write_all(self._file, rows.astype(self._dtype).tobytes())

    def commit(self, num_rows: int) -> None:
        """Sets the number of rows that the file holds."""
        self._file.seek(0)
        write_all(self._file, self._header(num_rows))
        self.num_rows = num_rows

    def close(self) -> None:
        self._file.close()

    def _header(self, num_rows: int) -> bytes:
        """Header of the file; NumPy leaves room in it for any number of rows, so that it stays as long as it is."""
        about = {"descr": self._dtype.str, "fortran_order": False, "shape": (num_rows, *self._columns)}
        header = BytesIO()
        np.lib.format.write_array_header_1_0(header, about)
        return header.getvalue()


def is_second_camera(event_camera: Camera, frame_camera: Camera, event_from_frame: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether frames are taken by another camera, or from another place, than events."""
    return frame_camera != event_camera or bool((event_from_frame != np.eye(4)).any())


def camera_json(camera: Camera) -> dict[str, Any]:
    """A camera as recording.json and simulation.json state it."""
    about = {key: getattr(camera, key) for key in CAMERA_KEYS}
    return {**about, "distortion": list(camera.distortion)} if camera.distortion else about


def mounted_camera_json(camera: Camera, event_from_frame: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    """A camera that is fixed to the event camera, with its pose in the axes of that one."""
    return {**camera_json(camera), MOUNTING_KEY: event_from_frame.tolist()}


def encode_json(value: dict[str, Any]) -> bytes:
    """Content of a JSON file; numbers keep all their digits."""
    return (json.dumps(value, indent=2) + "\n").encode()


def encode_npy(array: Shaped[np.ndarray, "..."], dtype: type = np.float32) -> bytes:
    """Content of a .npy file."""
    content = BytesIO()
    np.save(content, array.astype(dtype))
    return content.getvalue()


def encode_poses(
    header: str,
    stamps: Iterable[int | str],
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
) -> bytes:
    """A table of poses, one a line, of which reading gives the same numbers.

    Args:
        header: First line.
        stamps: Times as they shall stand there.
        positions: Metres.
        quaternions: xyzw.
    """
    rows = np.column_stack([positions, quaternions]).tolist()
    lines = [f"{stamp} {' '.join(map(repr, row))}" for stamp, row in zip(stamps, rows, strict=True)]
    return ("\n".join([header, *lines]) + "\n").encode()


def encode_tum(trajectory: Trajectory) -> bytes:
    """A trajectory as text of the TUM benchmark: t px py pz qx qy qz qw a line, seconds and metres."""
    stamps = (f"{'-' * (time < 0)}{abs(time) // 10**9}.{abs(time) % 10**9:09d}" for time in trajectory.times.tolist())
    return encode_poses("# t px py pz qx qy qz qw", stamps, trajectory.positions, trajectory.quaternions)


def poses_at(
    trajectory: Trajectory, times: Int64[np.ndarray, " times"]
) -> tuple[Float64[np.ndarray, "times 3"], Float64[np.ndarray, "times 4"]]:
    """Positions (metres), and quaternions xyzw, of a trajectory at other times (ns) than its own."""
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    return poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()


NO_EXR = (
    "Frames of high dynamic range are written as .npy alone, since OpenCV writes no .exr here unless "
    "OPENCV_IO_ENABLE_OPENEXR=1 is set."
)


def _exr_enabled() -> bool:
    """OpenCV raises, and prints a warning, where it was not told to."""
    if not os.environ.get("OPENCV_IO_ENABLE_OPENEXR"):
        return False
    try:
        return cv2.haveImageWriter(".exr")
    except cv2.error:
        return False


def _encode(kind: str, image: np.ndarray) -> bytes:
    """Content of an image file, of JPEG the best that there is; OpenCV keeps colours as B G R."""
    best = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    done, content = cv2.imencode(kind, image[..., ::-1] if image.ndim == 3 else image, best if kind == ".jpg" else ())
    assert done
    return content.tobytes()
