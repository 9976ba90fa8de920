"""The common part of the writers of all layouts, which write a recording in pieces.

Calibration and poses are written first. Events and frames follow in pieces, so memory does not grow with duration. The
files can be read even if the disk becomes full or the process is stopped.

Every layout also holds these files, with the numbers of frames as names:

    simulation.json     the true contrast thresholds and all settings, cameras and extrinsics; if the simulation was
                        interrupted, "finished" is false, and the numbers of events and frames are not final
    thresholds.npy      float32 [2, height, width], on and off threshold of each pixel of the event camera, if they vary
    depth/              .npy, float32 [height, width], z-depth in metres of each frame, 0 where nothing was hit
    sharp_images/       .png, in eds and tum_vie, whose own frames are blurred like those of a real camera
    hdr/, hdr_blurred/  .npy, float32 linear brightness of frames, R G B if in colour
"""

from __future__ import annotations

import json
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

Rig = tuple[Camera, Camera, Float64[np.ndarray, "4 4"]]
"""Event camera, frame camera, and the pose of the frame camera in the axes of the event camera."""


@dataclass(frozen=True)
class Setup:
    """The properties of a recording that are known before the first frame."""

    event_camera: Camera
    frame_camera: Camera
    event_from_frame: Float64[np.ndarray, "4 4"]
    """Extrinsics: pose of the frame camera in the axes of the event camera, metres."""
    trajectory: Trajectory | None
    """Trajectory of the event camera; None for a source without poses, whose recording then has none."""
    frame_times: Int64[np.ndarray, " frames"]
    """Times of the frames, ns, increasing: the middles of the exposures."""
    exposure: int
    """Exposure of the blurred frames, ns; 0 if there are only sharp frames."""
    contrast_thresholds: tuple[float, float]
    """Contrast thresholds of on and of off events."""
    pixel_thresholds: Float32[np.ndarray, "2 height width"] | None = None
    """Contrast thresholds of each pixel for on and for off events, if they vary."""
    refractory_period: int = 0
    """Refractory period, ns."""
    bayer_pattern: str | None = None
    """Colours of the event camera's pixels (0, 0), (1, 0), (0, 1), (1, 1), such as RGGB; None for a grey camera."""
    response: str | None = None
    """Response of the event camera to brightness, as in `EventRecording.response`; None if it is not known."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Further entries of simulation.json; values that JSON can hold."""


class Writer(ABC):
    """A recording that is being written. Use it in a `with` statement, whose end finishes the recording.

    Args:
        folder: An empty folder.
        setup: The properties of the recording.

    Raises:
        FlagError: The layout cannot hold these cameras or so few frames, or the extrinsics are not a rigid motion.
        OutputError: The disk is full. The methods raise it too.
    """

    layout: ClassVar[str]
    """Name of the format that reads the layout."""
    start: ClassVar[int] = 0
    """Time (ns) in the files of the layout at the simulation's time 0."""
    fewest_frames: ClassVar[int] = 1
    """Least number of frames that other readers of this layout accept."""
    poses_per_second: ClassVar[int | None] = None
    """Rate of poses of the data set, per second; None if it is not fixed."""
    published_rig: ClassVar[Rig | None] = None
    """The published cameras of the data set; None if it has none."""
    frame_folders: ClassVar[tuple[str, str]]
    """Folders of the sharp and of the blurred frames, in layouts that have both."""
    stamps_name: ClassVar[str]
    """Name of the table of stamps in each frame folder."""
    events_held: ClassVar[int] = 2**16
    """Number of events that are written together; also the chunk size of an HDF5 file."""

    num_events: int = 0
    """Number of events added so far."""
    num_frames: int = 0
    """Number of frames added so far."""

    def __init__(self, folder: Path, setup: Setup):
        self.folder, self.setup = folder, setup
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

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Smallest and largest depth (metres) of the frames so far; None if there are no two values."""
        return (self._near, self._far) if self._near < self._far else None

    def add_events(self, events: Events) -> None:
        """Adds events that follow the events added before. Up to `events_held` of them wait in memory."""
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
        """Adds the next frame completely or, after an error, not at all.

        Args:
            number: Number of the frame, from 0.
            time: Time of the frame in the setup, ns.
            sharp: The frame at this time without exposure.
            blurred: The frame with the setup's exposure; None if the exposure is 0.
            depth: z-depth in metres of the frame camera at this time, 0 where nothing is hit; None for a source without
                depth.
            linear: Linear brightness of the sharp and of the blurred frame, which is written to hdr/ and hdr_blurred/.
                Default: it is not written.
        """
        assert number == self.num_frames and time == self.setup.frame_times[number]
        assert (blurred is None) == (self.setup.exposure == 0)
        name = self._name(number)
        files = {
            path: _encode(Path(path).suffix, image) for path, image in self._images(number, sharp, blurred).items()
        }
        for folder, brightness in zip(("hdr", "hdr_blurred"), linear or (), strict=False):
            if brightness is not None:
                files[f"{folder}/{name}.npy"] = encode_npy(brightness)
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
        """Finishes the recording. After an error, the files that are there are kept."""
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

    def _write_depth_range(self) -> None:  # noqa: B027  (the default does nothing)
        """Writes the range of depth if the layout states it; called when a range is known, and at the end."""

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        """Returns the images of a frame by path."""
        images = zip(self.frame_folders, (sharp, blurred), strict=True)
        return {f"{folder}/{self._name(number)}.png": image for folder, image in images if image is not None}

    def _stamps(self, time: int) -> dict[str, str]:
        """Returns the lines that a frame at this time (ns) adds to tables, by path."""
        folders = self.frame_folders if self.setup.exposure else self.frame_folders[:1]
        return {f"{folder}/{self.stamps_name}": f"{time}\n" for folder in folders}

    def _name(self, number: int) -> str:
        """Returns the name of a frame's files, which sorts by the number."""
        return f"{number:0{max(5, len(str(len(self.setup.frame_times) - 1)))}d}"

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

    def _to_us(self, times: Int64[np.ndarray, " times"]) -> Int64[np.ndarray, " times"]:
        """Returns times in whole microseconds, rounded and clipped to the trajectory, on the simulation's clock."""
        rounded, trajectory = (times + 500) // 1000, self.setup.trajectory
        return rounded if trajectory is None else rounded.clip(-(-trajectory.start // 1000), trajectory.end // 1000)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns errors of the disk and of the HDF5 library into one OutputError."""
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
    """The files of events. Appended events can be read at once or, in HDF5, when a chunk is full."""

    def append(self, events: Events) -> None: ...

    def close(self) -> None:
        """Closes the files. All columns then have the same length, even after an error."""


class GrowingArray:
    """A .npy file, new or existing, that grows by rows. Its header states the number of committed rows."""

    def __init__(self, path: Path, dtype: type, columns: tuple[int, ...] = ()):
        self._dtype, self._columns, self.num_rows = np.dtype(dtype), columns, 0
        if not path.exists():
            write_together(path.parent, {path.name: self._header(0)})
        self._file = open(path, "r+b", buffering=0)

    def append(self, rows: np.ndarray) -> None:
        """Writes rows after the committed rows."""
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
        """Returns the header. NumPy reserves space in it for any number of rows, so its length is constant."""
        about = {"descr": self._dtype.str, "fortran_order": False, "shape": (num_rows, *self._columns)}
        header = BytesIO()
        np.lib.format.write_array_header_1_0(header, about)
        return header.getvalue()


def is_second_camera(event_camera: Camera, frame_camera: Camera, event_from_frame: Float64[np.ndarray, "4 4"]) -> bool:
    """Returns whether the frame camera differs from the event camera in its calibration or its pose."""
    return frame_camera != event_camera or bool((event_from_frame != np.eye(4)).any())


def camera_json(camera: Camera) -> dict[str, Any]:
    """Returns a camera as recording.json and simulation.json state it."""
    about = {key: getattr(camera, key) for key in CAMERA_KEYS}
    return {**about, "distortion": list(camera.distortion)} if camera.distortion else about


def mounted_camera_json(camera: Camera, event_from_frame: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Returns the JSON object of a camera that is fixed to the event camera, with its pose there."""
    return {**camera_json(camera), MOUNTING_KEY: event_from_frame.tolist()}


def encode_json(value: dict[str, Any]) -> bytes:
    """Returns the content of a JSON file; numbers keep all digits."""
    return (json.dumps(value, indent=2) + "\n").encode()


def encode_npy(array: Shaped[np.ndarray, "..."], dtype: type = np.float32) -> bytes:
    """Returns the content of a .npy file."""
    content = BytesIO()
    np.save(content, array.astype(dtype))
    return content.getvalue()


def encode_poses(
    header: str,
    stamps: Iterable[int | str],
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
) -> bytes:
    """Returns a table with one pose in each line, with all digits.

    Args:
        header: The first line.
        stamps: The times as written in the table.
        positions: Metres.
        quaternions: xyzw.
    """
    rows = np.column_stack([positions, quaternions]).tolist()
    lines = [f"{stamp} {' '.join(map(repr, row))}" for stamp, row in zip(stamps, rows, strict=True)]
    return ("\n".join([header, *lines]) + "\n").encode()


def encode_tum(trajectory: Trajectory, zero: int) -> bytes:
    """Returns a trajectory as text of the TUM benchmark: lines t px py pz qx qy qz qw, seconds and metres.

    Args:
        trajectory: The poses.
        zero: Time (ns) that the text states for its time 0.
    """
    times = (trajectory.times + zero).tolist()
    stamps = (f"{'-' * (time < 0)}{abs(time) // 10**9}.{abs(time) % 10**9:09d}" for time in times)
    return encode_poses("# t px py pz qx qy qz qw", stamps, trajectory.positions, trajectory.quaternions)


def poses_at(
    trajectory: Trajectory, times: Int64[np.ndarray, " times"]
) -> tuple[Float64[np.ndarray, "times 3"], Float64[np.ndarray, "times 4"]]:
    """Returns positions (metres) and quaternions xyzw of a trajectory, interpolated at any times (ns)."""
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    return poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()


def _encode(kind: str, image: np.ndarray) -> bytes:
    """Returns the content of an image file, with the best quality for JPEG."""
    best = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    done, content = cv2.imencode(kind, image[..., ::-1] if image.ndim == 3 else image, best if kind == ".jpg" else ())
    assert done
    return content.tobytes()
