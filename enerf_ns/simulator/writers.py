"""Writes what is simulated as it comes, in the layouts that this project and others read.

    esim              E-NeRF's ESIM sequences, as its reference code reads them
    eds               EDS as it is unpacked, on a clock of absolute times in microseconds
    tum_vie           TUM-VIE as it is unpacked, its left cameras, in microseconds
    event_recording   this project's own, in nanoseconds

Calibration and poses are there from the beginning, and events and frames are added in pieces, so that memory does not
grow with duration, and what was written can be read when the disk is full or the process is stopped.

Beside what a layout has, in all of them, with files named by the numbers of the frames:

    simulation.json     the true contrast thresholds and all settings, cameras and extrinsics; "finished" is false, and
                        the numbers of events and frames are not final, if the simulation was broken off
    thresholds.npy      float32 [2, height, width], on and off threshold of each pixel of the event camera, if they vary
    depth/              .npy, float32 [height, width], z-depth in metres of each frame, 0 where nothing was hit
    sharp_images/       in eds and tum_vie, whose own frames are blurred as those of a real camera
    hdr/, hdr_blurred/  .npy, float32 linear brightness of frames, R G B if in colour, and .exr where OpenCV writes that
                        (it does with OPENCV_IO_ENABLE_OPENEXR=1 in the environment)
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.camera import Camera, check_rotation
from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.formats import eds, tum_vie
from enerf_ns.dataparsers.formats.event_recording import MOUNTING_KEY, STORED_TYPES, camera_json, write_poses
from enerf_ns.dataparsers.recording import Events
from enerf_ns.dataparsers.trajectory import Trajectory
from enerf_ns.simulator.frames import Frame, FrameSettings, develop, in_colour

EVENTS_AT_A_TIME = 2**16
"""Events that are held back until they are written, and those in a chunk of an HDF5 file."""

EDS_START = 1000 * 10**9
"""What the clock of the layout eds shows (ns) when the simulation's is at 0."""

TUM_VIE_SEQUENCE = "simulated"
"""What the files of the layout tum_vie are named after."""

FEWEST_ESIM_FRAMES, FEWEST_ESIM_POSES = 11, 101
"""That the reference code of E-NeRF accepts."""

METADATA_BYTES = 2**17
"""By which an HDF5 file may grow beside its events at a time."""

PARTIAL = ".partial"
"""Ending of files that are not yet complete."""


@dataclass(frozen=True)
class Setup:
    """What is known of a recording before the first picture."""

    event_camera: Camera
    frame_camera: Camera
    event_from_frame: Float64[np.ndarray, "4 4"]
    """Extrinsics: pose of the frame camera in the axes of the event camera, metres."""
    trajectory: Trajectory | None
    """Of the event camera; None for a source without poses, whose recording then lacks them too."""
    frame_times: Int64[np.ndarray, " frames"]
    """ns, increasing: the middles of the exposures."""
    exposure: int
    """ns; 0 for sharp frames alone."""
    contrast_thresholds: tuple[float, float]
    """Of on and of off events."""
    pixel_thresholds: Float32[np.ndarray, "2 height width"] | None = None
    """On and off thresholds of each pixel, if they vary."""
    refractory_period: int = 0
    """For how long a pixel is blind after an event, ns."""
    bayer_pattern: str | None = None
    """Colours of the event camera's pixels (0, 0), (1, 0), (0, 1), (1, 1), such as RGGB; None for a grey one."""
    frame_settings: FrameSettings = field(default_factory=FrameSettings)
    seed: int = 0
    """Of the noise of the frames."""
    settings: dict[str, Any] = field(default_factory=dict)
    """All else that simulation.json shall state; what JSON can hold."""


def open_writer(layout: str, folder: Path, setup: Setup) -> Writer:
    """Begins a recording, to be used in a `with` statement at whose end the recording is finished.

    Args:
        layout: One of `LAYOUTS`.
        folder: Exists and is empty.
        setup: What is recorded.

    Raises:
        RecordingError: The layout cannot hold these cameras or that few frames, the extrinsics are no rigid motion, or
            the disk is full.
    """
    return _WRITERS[layout](folder, setup)


class Writer(ABC):
    """A recording that is being written. Its methods raise RecordingError if the disk is full."""

    layout: ClassVar[str]
    start: ClassVar[int] = 0
    """What the clock of the layout shows (ns) when the simulation's is at 0."""

    num_events: int = 0
    """Added so far."""
    num_frames: int = 0
    """Added so far."""
    notes: list[str]
    """What the user should know, one sentence each."""

    def __init__(self, folder: Path, setup: Setup):
        self.folder, self.setup, self.notes = folder, setup, []
        try:
            check_rotation(setup.event_from_frame[:3, :3])
        except ValueError as error:
            raise RecordingError(f"The extrinsics of the frame camera are wrong: their rotation {error}.") from error
        self._check()
        self._writes_exr = setup.frame_settings.hdr and _exr_enabled()
        if setup.frame_settings.hdr and not self._writes_exr:
            self.notes.append(
                "Frames of high dynamic range are written as .npy alone, since OpenCV writes no .exr here unless "
                "OPENCV_IO_ENABLE_OPENEXR=1 is set."
            )
        self._pending: list[Events] = []
        self._num_pending = 0
        self._near, self._far = np.inf, 0.0
        with self._writing():
            self._write_calibration()
            if setup.trajectory is not None:
                self._write_poses(setup.trajectory)
            if setup.pixel_thresholds is not None:
                np.save(folder / "thresholds.npy", setup.pixel_thresholds.astype(np.float32))
            self._write_summary(finished=False)
            self._event_files = self._open_events()

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Smallest and largest depth (metres) of the frames so far; None unless there are two."""
        return (self._near, self._far) if self._near < self._far else None

    def add_events(self, events: Events) -> None:
        """Adds events that lie after those added before. Memory for up to `EVENTS_AT_A_TIME` of them is held back."""
        if not len(events):
            return
        self.num_events += len(events)
        self._num_pending += len(events)
        self._pending.append(events)
        if self._num_pending >= EVENTS_AT_A_TIME:
            with self._writing():
                self._store_events()

    def add_frame(
        self, frame: Frame, depth: Float[np.ndarray, "height width"] | None
    ) -> tuple[UInt8[np.ndarray, "height width *channels"], UInt8[np.ndarray, "height width *channels"] | None]:
        """Adds the next frame, completely or, if that fails, not at all.

        Args:
            frame: Number and time as of the setup.
            depth: z-depth in metres that the frame camera sees at the frame's time, 0 where nothing is hit; None for a
                source that knows none.

        Returns:
            the sharp and the blurred frame as the sensor reads them out.
        """
        assert frame.number == self.num_frames and frame.time == self.setup.frame_times[frame.number]
        assert (frame.blurred is None) == (self.setup.exposure == 0)
        sharp = develop(frame.sharp, self.setup.frame_settings, frame.number, False, self.setup.seed)
        blurred = None
        if frame.blurred is not None:
            blurred = develop(frame.blurred, self.setup.frame_settings, frame.number, True, self.setup.seed)
        name = self._name(frame.number)
        files = {path: _encode_png(image) for path, image in self._images(frame.number, sharp, blurred).items()}
        if self.setup.frame_settings.hdr:
            for folder, brightness in (("hdr", frame.sharp), ("hdr_blurred", frame.blurred)):
                if brightness is not None:
                    files |= self._encode_hdr(f"{folder}/{name}", brightness)
        if depth is not None:
            files[f"depth/{name}.npy"] = _encode_npy(depth)
        with self._writing():
            self._store_events()
            _write_together(self.folder, files, self._stamps(frame.time))
        self.num_frames += 1
        if depth is not None and (depth > 0).any():
            self._near = min(self._near, float(depth[depth > 0].min()))
            self._far = max(self._far, float(depth.max()))
        return sharp, blurred

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        """Finishes the recording; of one that was broken off, what is there is kept."""
        try:
            with self._writing(), ExitStack() as stack:
                stack.callback(self._write_summary, finished=kind is None)
                stack.callback(self._event_files.close)
                self._store_events()
        except RecordingError:
            if kind is None:
                raise

    @abstractmethod
    def _check(self) -> None:
        """Raises RecordingError if the layout cannot hold the recording."""

    @abstractmethod
    def _write_calibration(self) -> None: ...

    @abstractmethod
    def _write_poses(self, trajectory: Trajectory) -> None: ...

    @abstractmethod
    def _open_events(self) -> _EventFiles: ...

    @abstractmethod
    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        """The images of a frame, by path."""

    @abstractmethod
    def _stamps(self, time: int) -> dict[str, str]:
        """What each table of frames gets for one at this time (ns), by path."""

    def _name(self, number: int) -> str:
        """Of a frame's files, so that they sort as their numbers do."""
        return f"{number:0{max(5, len(str(len(self.setup.frame_times) - 1)))}d}"

    def _check_size(self, size: tuple[int, int]) -> None:
        camera = self.setup.event_camera
        if (camera.width, camera.height) != size:
            raise RecordingError(
                f"The layout {self.layout} holds events of {size[0]} x {size[1]} pixels, but {camera.width} x "
                f"{camera.height} were asked for; choose such a camera or another layout."
            )

    def _write_summary(self, finished: bool) -> None:
        setup = self.setup
        summary = {
            **setup.settings,
            "layout": self.layout,
            "finished": finished,
            "clock_start_ns": self.start,
            "contrast_thresholds": setup.contrast_thresholds,
            "refractory_period_ns": setup.refractory_period,
            "bayer_pattern": setup.bayer_pattern,
            "camera": camera_json(setup.event_camera),
            "frame_camera": {**camera_json(setup.frame_camera), MOUNTING_KEY: setup.event_from_frame.tolist()},
            "exposure_ns": setup.exposure,
            "frame_settings": asdict(setup.frame_settings),
            "depth_range": self.depth_range,
            "num_events": self.num_events,
            "num_frames": self.num_frames,
        }
        self._replace("simulation.json", _json(summary))

    def _replace(self, path: str, content: bytes) -> None:
        _write_together(self.folder, {path: content}, {})

    def _store_events(self) -> None:
        if self._pending:
            events = Events(*(np.concatenate([getattr(piece, name) for piece in self._pending]) for name in "xytp"))
            self._pending, self._num_pending = [], 0
            self._event_files.append(events)

    def _encode_hdr(self, stem: str, brightness: np.ndarray) -> dict[str, bytes]:
        files = {f"{stem}.npy": _encode_npy(brightness)}
        if self._writes_exr:
            files[f"{stem}.exr"] = _encode(".exr", brightness.astype(np.float32))
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
            raise RecordingError(
                f"{self.folder} could not be written any further ({reason}); what was written before, "
                f"{self.num_frames} frame{'s' * (self.num_frames != 1)} and the events up to there, can be read, but "
                "make room for more or give another folder."
            ) from error


class EsimWriter(Writer):
    """E-NeRF's ESIM sequences, with one file of events for each frame, up to the next."""

    layout = "esim"

    def _check(self) -> None:
        setup, camera = self.setup, self.setup.event_camera
        centred = Camera(camera.width, camera.height, camera.fx, camera.fx, camera.width / 2, camera.height / 2)
        if not (camera == setup.frame_camera == centred and np.allclose(setup.event_from_frame, np.eye(4), atol=1e-12)):
            raise RecordingError(
                "The layout esim holds one camera for events and frames, without distortion, with one focal length and "
                "the principal point at (width / 2, height / 2); choose such a camera or another layout."
            )
        if len(setup.frame_times) < FEWEST_ESIM_FRAMES:
            raise RecordingError(
                f"The layout esim needs at least {FEWEST_ESIM_FRAMES} frames, but {len(setup.frame_times)} were asked "
                "for; take more of them or another layout."
            )

    def _write_calibration(self) -> None:
        self._write_bounds()

    def _write_bounds(self) -> None:
        """LLFF's rows [R | t | height width focal], axes down, right and back, and the nearest and farthest depth."""
        camera, trajectory, times = self.setup.event_camera, self.setup.trajectory, self.setup.frame_times
        poses = np.tile(np.eye(3, 4), (len(times), 1, 1))
        if trajectory is not None:
            poses = trajectory.poses(torch.from_numpy(times)).numpy()
        axes = np.stack([poses[:, :, 1], poses[:, :, 0], -poses[:, :, 2], poses[:, :, 3]], axis=2)
        sizes = np.tile(np.array([[camera.height], [camera.width], [camera.fx]]), (len(times), 1, 1))
        rows = np.concatenate([axes, sizes], axis=2).reshape(len(times), 15)
        bounds = np.tile(self.depth_range or (0.0, 0.0), (len(times), 1))
        self._replace("poses_bounds.npy", _encode_npy(np.column_stack([rows, bounds]), np.float64))

    def _write_poses(self, trajectory: Trajectory) -> None:
        """All poses and, where they are too few, some between them, which leave the interpolated path as it is."""
        times = trajectory.times
        parts = -(-FEWEST_ESIM_POSES // (len(times) - 1))
        if len(times) < FEWEST_ESIM_POSES:
            between = [start + (end - start) * np.arange(parts) // parts for start, end in pairwise(times)]
            times = np.unique(np.append(np.concatenate(between), times[-1]))
            positions, quaternions = _poses_at(trajectory, times)
        else:
            positions, quaternions = trajectory.positions, trajectory.quaternions
        write_poses(self.folder / "poses_all.txt", times, positions, quaternions)

    def _open_events(self) -> _EventFiles:
        paths = [f"events/{self._name(number)}.npy" for number in range(len(self.setup.frame_times))]
        return _IntervalFiles([self.folder / path for path in paths], self.setup.frame_times)

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        images = {f"images/{self._name(number)}.png": in_colour(sharp)}
        if blurred is not None:
            images[f"images_corrupted/{self._name(number)}.png"] = in_colour(blurred)
        return images

    def _stamps(self, time: int) -> dict[str, str]:
        folders = ("images", "images_corrupted") if self.setup.exposure else ("images",)
        return {f"{folder}/image_stamps_ns.txt": f"{time}\n" for folder in folders}

    def _write_summary(self, finished: bool) -> None:
        if self.depth_range is not None:
            self._write_bounds()
        super()._write_summary(finished)


class EventRecordingWriter(Writer):
    """This project's own layout."""

    layout = "event_recording"

    def _check(self) -> None:
        if self.setup.frame_camera.model == "lookup":
            raise RecordingError(
                "The layout event_recording holds no table of directions for the frame camera; give its distortion."
            )

    def _write_calibration(self) -> None:
        if self.setup.event_camera.directions is not None:
            np.save(self.folder / "camera_directions.npy", self.setup.event_camera.directions)
        self._write_about()

    def _write_about(self) -> None:
        setup = self.setup
        frame_camera = {**camera_json(setup.frame_camera), MOUNTING_KEY: setup.event_from_frame.tolist()}
        is_second = is_second_camera(setup.event_camera, setup.frame_camera, setup.event_from_frame)
        about = {
            "camera": camera_json(setup.event_camera),
            "frame_camera": frame_camera if is_second else None,
            "contrast_thresholds": setup.contrast_thresholds,
            "refractory_period_ns": setup.refractory_period or None,
            "bayer_pattern": setup.bayer_pattern,
            "depth_range": self.depth_range,
        }
        self._replace("recording.json", _json({key: value for key, value in about.items() if value is not None}))

    def _write_poses(self, trajectory: Trajectory) -> None:
        write_poses(self.folder / "poses.txt", trajectory.times, trajectory.positions, trajectory.quaternions)

    def _open_events(self) -> _EventFiles:
        return _ColumnFiles(self.folder / "events")

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        images = {f"frames/{self._name(number)}.png": sharp}
        if blurred is not None:
            images[f"blurred_frames/{self._name(number)}.png"] = blurred
        return images

    def _stamps(self, time: int) -> dict[str, str]:
        folders = ("frames", "blurred_frames") if self.setup.exposure else ("frames",)
        return {f"{folder}/stamps_ns.txt": f"{time}\n" for folder in folders}

    def _write_summary(self, finished: bool) -> None:
        if self.depth_range is not None:
            self._write_about()
        super()._write_summary(finished)


class EdsWriter(Writer):
    """EDS as it is unpacked. The published files do not state exposures; simulation.json does."""

    layout = "eds"
    start = EDS_START

    def _check(self) -> None:
        self._check_size(eds.SENSOR_SIZE)
        for camera in (self.setup.event_camera, self.setup.frame_camera):
            if camera.model == "lookup" or (camera.model == "radtan" and len(camera.distortion) != 4):
                raise RecordingError(
                    f"The layout eds holds cameras without distortion, or with 4 coefficients of it (radtan or "
                    f"fisheye), but one of {len(camera.distortion)} of {camera.model} was asked for; choose another."
                )

    def _write_calibration(self) -> None:
        setup = self.setup
        rgb = _kalibr(setup.frame_camera, "/cam0/image_raw", 1)
        event = _kalibr(setup.event_camera, "/cam1/events", 0)
        event["T_cn_cnm1"] = setup.event_from_frame.tolist()
        content = f"cam0: # This is the RGB camera\n{_yaml(rgb)}cam1: # This is the event camera\n{_yaml(event)}"
        self._replace("camchain.yaml", content.encode())

    def _write_poses(self, trajectory: Trajectory) -> None:
        times = (trajectory.times + EDS_START).tolist()
        stamps = [f"{time // 10**9}.{time % 10**9:09d}" for time in times]
        header = "# timestamp[s] px py pz qx qy qz qw"
        content = _pose_rows(header, stamps, trajectory.positions, trajectory.quaternions)
        self._replace(eds.RAW_POSES, content)

    def _open_events(self) -> _EventFiles:
        return _Hdf5File(self.folder / "events.h5", "", {}, lambda times: self._to_us(times) + EDS_START // 1000)

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        path = f"{eds.RAW_IMAGES}/frame_{number:010d}.png"
        if blurred is None:
            return {path: in_colour(sharp)}
        return {path: in_colour(blurred), f"sharp_images/{self._name(number)}.png": in_colour(sharp)}

    def _stamps(self, time: int) -> dict[str, str]:
        return {"images_timestamps.txt": f"{int(self._to_us(np.array(time))) + EDS_START // 1000}\n"}


class TumVieWriter(Writer):
    """TUM-VIE as it is unpacked: its left cameras. Markers, IMU and event camera are in one place."""

    layout = "tum_vie"

    def _check(self) -> None:
        self._check_size(tum_vie.SENSOR_SIZE)
        for camera in (self.setup.event_camera, self.setup.frame_camera):
            if camera.model != "fisheye":
                raise RecordingError(
                    f"The layout tum_vie holds cameras of the model fisheye, but one of {camera.model} was asked for; "
                    "choose such a camera or another layout."
                )

    def _write_calibration(self) -> None:
        setup = self.setup
        cameras = [setup.frame_camera] * 2 + [setup.event_camera] * 2
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
        lenses = [(camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion) for camera in cameras]
        calibration = {
            "T_imu_cam": [_pose_json(setup.event_from_frame)] * 2 + [_pose_json(np.eye(4))] * 2,
            "intrinsics": [
                {"camera_type": "kb4", "intrinsics": dict(zip(names, lens, strict=True))} for lens in lenses
            ],
            "resolution": [[camera.width, camera.height] for camera in cameras],
        }
        self._replace("camera-calibrationA.json", _json({"value0": calibration}))
        marker = {"value0": {"T_imu_marker": _pose_json(np.eye(4))}}
        self._replace("mocap-imu-calibrationA.json", _json(marker))
        self._replace(
            f"{self._data}/right_images/image_timestamps_right.txt", b""
        )  # without which E-NeRF does not load

    def _write_poses(self, trajectory: Trajectory) -> None:
        times = np.unique(self._to_us(trajectory.times))
        header = "# timestamp[us] px py pz qx qy qz qw"
        content = _pose_rows(header, map(str, times.tolist()), *_poses_at(trajectory, times * 1000))
        self._replace(f"{self._data}/mocap_data.txt", content)

    def _open_events(self) -> _EventFiles:
        import hdf5plugin

        path = self.folder / f"{TUM_VIE_SEQUENCE}-events_left.h5"
        return _Hdf5File(path, "events/", dict(hdf5plugin.Blosc("zstd")), self._to_us)

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        path = f"{self._data}/left_images/{self._name(number)}.png"
        if blurred is None:
            return {path: sharp}
        return {path: blurred, f"sharp_images/{self._name(number)}.png": sharp}

    def _stamps(self, time: int) -> dict[str, str]:
        """Exposures begin at the stamps, which are such that their middles are closest to the frames' times."""
        exposure = round(self.setup.exposure / 1000)
        stamp = (2 * time - 1000 * exposure + 1000) // 2000
        folder = f"{self._data}/left_images"
        return {
            f"{folder}/image_timestamps_left.txt": f"{stamp}\n",
            f"{folder}/image_exposures_left.txt": f"{exposure}\n",
        }

    @property
    def _data(self) -> str:
        return f"{TUM_VIE_SEQUENCE}-vi_gt_data"


def is_second_camera(event_camera: Camera, frame_camera: Camera, event_from_frame: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether frames are taken by another camera, or from another place, than events."""
    return frame_camera != event_camera or bool((event_from_frame != np.eye(4)).any())


_WRITERS: dict[str, Callable[[Path, Setup], Writer]] = {
    writer.layout: writer for writer in (EsimWriter, EdsWriter, TumVieWriter, EventRecordingWriter)
}
LAYOUTS = tuple(_WRITERS)
"""Names of the layouts, which are those of their readers' formats."""


class _EventFiles(Protocol):
    """Where events go. What was appended can be read at once or, in HDF5, when a chunk is full."""

    def append(self, events: Events) -> None: ...

    def close(self) -> None:
        """Whatever has happened before, as many of each column can be read afterwards."""


class _NpyFile:
    """A .npy file without rows, new or there already, that grows by rows and holds those that were committed."""

    def __init__(self, path: Path, dtype: type, columns: tuple[int, ...] = ()):
        self._dtype, self._columns, self.num_rows = np.dtype(dtype), columns, 0
        if not path.exists():
            _write_together(path.parent, {path.name: self._header(0)}, {})
        self._file = open(path, "r+b", buffering=0)

    def append(self, rows: np.ndarray) -> None:
        """Writes rows after those that were committed."""
        row_bytes = self._dtype.itemsize * int(np.prod(self._columns))
        self._file.seek(len(self._header(0)) + self.num_rows * row_bytes)
        _write_all(self._file, rows.astype(self._dtype).tobytes())

    def commit(self, num_rows: int) -> None:
        """Sets the number of rows that the file holds."""
        self._file.seek(0)
        _write_all(self._file, self._header(num_rows))
        self.num_rows = num_rows

    def close(self) -> None:
        self._file.close()

    def _header(self, num_rows: int) -> bytes:
        """NumPy leaves room in it for any number of rows, so that it stays as long as it is."""
        about = {"descr": self._dtype.str, "fortran_order": False, "shape": (num_rows, *self._columns)}
        header = BytesIO()
        np.lib.format.write_array_header_1_0(header, about)
        return header.getvalue()


class _ColumnFiles:
    """x.npy, y.npy, t.npy and p.npy."""

    def __init__(self, folder: Path):
        self._files = {name: _NpyFile(folder / f"{name}.npy", dtype) for name, dtype in STORED_TYPES.items()}
        self._num_events = 0

    def append(self, events: Events) -> None:
        for name, file in self._files.items():
            file.append(getattr(events, name))
        self._num_events += len(events)
        self._commit()

    def close(self) -> None:
        self._commit()
        for file in self._files.values():
            file.close()

    def _commit(self) -> None:
        for file in self._files.values():
            file.commit(self._num_events)


class _IntervalFiles:
    """One file for each frame, with the events after it up to the next; those before the first are in its file."""

    def __init__(self, paths: list[Path], frame_times: np.ndarray):
        for path in paths:
            _NpyFile(path, np.int64, (4,)).close()
        self._paths, self._ends, self._number = paths, frame_times[1:], 0
        self._file = _NpyFile(paths[0], np.int64, (4,))

    def append(self, events: Events) -> None:
        rows = np.column_stack([events.x, events.y, events.t, events.p]).astype(np.int64)
        while len(rows):
            count = len(rows)
            if self._number < len(self._ends):
                count = int(np.searchsorted(rows[:, 2], self._ends[self._number], side="right"))
            self._file.append(rows[:count])
            self._file.commit(self._file.num_rows + count)
            rows = rows[count:]
            if len(rows):
                self._file.close()
                self._number += 1
                self._file = _NpyFile(self._paths[self._number], np.int64, (4,))

    def close(self) -> None:
        self._file.close()


class _Hdf5File:
    """x, y, t (whole microseconds) and p (0 or 1); if in a group, also ms_to_idx: each millisecond's first event.

    Only whole chunks are added until the file is closed, since one that is rewritten as it grows may end up in place
    of another that the file on the disk still refers to. The room that an addition needs is taken from the disk before
    it is made, since a file whose addition fails halfway cannot be read any more. The oldest version of the file format
    is used, in which a file is not marked as open.
    """

    def __init__(self, path: Path, group: str, filters: dict, to_us: Callable[[np.ndarray], np.ndarray]):
        import h5py

        self._path, self._to_us = path, to_us
        self._file = h5py.File(path, "w", libver=("earliest", "v108"), rdcc_nbytes=0)
        self._reserve(0)
        make = partial(self._file.create_dataset, shape=(0,), maxshape=(None,))
        types = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
        options = {"chunks": (EVENTS_AT_A_TIME,), **filters}
        self._columns = {name: make(group + name, dtype=dtype, **options) for name, dtype in types.items()}
        self._milliseconds = make("ms_to_idx", dtype=np.uint64, chunks=(1024,)) if group else None
        self._file.flush()
        self._num_events, self._next_millisecond = 0, 0
        self._rest = {name: np.zeros(0, dtype) for name, dtype in types.items()}

    def append(self, events: Events) -> None:
        new = {"x": events.x, "y": events.y, "t": self._to_us(events.t), "p": events.p > 0}
        for name, column in new.items():
            self._rest[name] = np.concatenate([self._rest[name], column.astype(self._rest[name].dtype)])
        self._add(len(self._rest["t"]) // EVENTS_AT_A_TIME * EVENTS_AT_A_TIME)

    def close(self) -> None:
        try:
            for column in self._columns.values():  # of which some may have grown before an interruption
                column.resize((self._num_events,))
            if self._milliseconds is not None:
                self._milliseconds.resize((self._next_millisecond,))
            self._add(len(self._rest["t"]))
        finally:
            length = self._file.id.get_filesize()
            self._file.close()
            os.truncate(self._path, length)

    def _add(self, count: int) -> None:
        """Adds the first events of those held back."""
        if not count:
            return
        times, indices = self._rest["t"][:count], np.zeros(0, np.int64)
        if self._milliseconds is not None:
            milliseconds = np.arange(self._next_millisecond, times[-1] // 1000 + 1)
            indices = self._num_events + np.searchsorted(times, 1000 * milliseconds)
        self._reserve(sum(column[:count].nbytes for column in self._rest.values()) + indices.nbytes)
        for name, column in self._columns.items():
            column.resize((self._num_events + count,))
            column[self._num_events :] = self._rest[name][:count]
        if self._milliseconds is not None:
            self._milliseconds.resize((self._next_millisecond + len(indices),))
            self._milliseconds[self._next_millisecond :] = indices
        self._file.flush()
        self._num_events += count
        self._next_millisecond += len(indices)
        self._rest = {name: column[count:] for name, column in self._rest.items()}

    def _reserve(self, num_bytes: int) -> None:
        """Makes the file so much longer than the library knows; what lies behind its end it uses as it needs it."""
        end = self._file.id.get_filesize() + num_bytes + METADATA_BYTES
        with open(self._path, "r+b", buffering=0) as file:
            length = file.seek(0, os.SEEK_END)
            try:
                _write_all(file, bytes(max(end - length, 0)))
            except OSError:
                file.truncate(length)
                raise


def _write_all(file: Any, content: bytes) -> None:
    """Writes to an unbuffered file, which may take less than it is given when the disk is nearly full."""
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]


def _write_together(folder: Path, files: dict[str, bytes], lines: dict[str, str]) -> None:
    """Writes new files and appends lines to tables, all or, if anything fails, none."""
    replaced = [path for path in files if (folder / path).exists()]
    lengths = {path: (folder / path).stat().st_size for path in lines if (folder / path).exists()}
    try:
        for path, content in files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / (path + PARTIAL)).write_bytes(content)
        for path, line in lines.items():
            with open(folder / path, "ab", buffering=0) as table:
                _write_all(table, line.encode())
        for path in files:
            (folder / (path + PARTIAL)).replace(folder / path)
    except BaseException:
        for path in {*files, *lines}.difference(replaced, lengths):
            (folder / path).unlink(missing_ok=True)
        for path in files:
            (folder / (path + PARTIAL)).unlink(missing_ok=True)
        for path, length in lengths.items():
            os.truncate(folder / path, length)
        raise


def _exr_enabled() -> bool:
    """OpenCV raises, and prints a warning, where it was not told to."""
    if not os.environ.get("OPENCV_IO_ENABLE_OPENEXR"):
        return False
    try:
        return cv2.haveImageWriter(".exr")
    except cv2.error:
        return False


def _encode_png(image: np.ndarray) -> bytes:
    return _encode(".png", image)


def _encode(kind: str, image: np.ndarray) -> bytes:
    """An image file; OpenCV keeps colours as B G R."""
    done, content = cv2.imencode(kind, image[..., ::-1] if image.ndim == 3 else image)
    assert done
    return content.tobytes()


def _encode_npy(array: np.ndarray, dtype: type = np.float32) -> bytes:
    content = BytesIO()
    np.save(content, array.astype(dtype))
    return content.getvalue()


def _json(value: dict) -> bytes:
    return (json.dumps(value, indent=2) + "\n").encode()


def _yaml(value: dict) -> str:
    import yaml

    text = yaml.safe_dump(value, default_flow_style=None)
    return "".join(f"  {line}\n" for line in text.splitlines())


def _kalibr(camera: Camera, topic: str, other: int) -> dict[str, Any]:
    models = {ours: kalibrs for kalibrs, ours in eds.KALIBR_MODELS.items()}
    return {
        "cam_overlaps": [other],
        "camera_model": "pinhole",
        "distortion_coeffs": list(map(float, camera.distortion)),
        "distortion_model": models[camera.model],
        "intrinsics": list(map(float, (camera.fx, camera.fy, camera.cx, camera.cy))),
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
    }


def _pose_json(pose: np.ndarray) -> dict[str, float]:
    values = [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]
    return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), values, strict=True))


def _pose_rows(header: str, stamps: Any, positions: np.ndarray, quaternions: np.ndarray) -> bytes:
    rows = np.column_stack([positions, quaternions]).tolist()
    lines = [f"{stamp} {' '.join(map(repr, row))}" for stamp, row in zip(stamps, rows, strict=True)]
    return ("\n".join([header, *lines]) + "\n").encode()


def _poses_at(trajectory: Trajectory, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions, and quaternions xyzw, at other times (ns) than its own."""
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    return poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()
