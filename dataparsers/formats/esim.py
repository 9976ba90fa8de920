"""Reader and writer of E-NeRF's ESIM sequences, which is also the default layout of `enerf simulate`.

    events/*.npy                (n, 4) x y t_ns p, in time order over the files by name; a fifth column is ignored
    *poses_all*.txt             t_ns px py pz qx qy qz qw after a header line; camera to world, OpenCV axes, metres
    poses_bounds.npy            (N, 17) rows of LLFF; only height, width, focal length and the bounds are used
    images/*.png                sharp frames (or .jpg), with images/image_stamps_ns.txt, one stamp a line (optional)
    images_corrupted/*.png      frames blurred by motion, with an image_stamps_ns.txt of their own (optional)
    depth/*.npy                 (height, width) depth in metres of each frame, 0 where nothing was hit (optional)
    simulation.json             contrast_thresholds, response, depth_range, exposure_ns and camera of the simulator
                                (optional)

One camera takes events and frames, without distortion, and stamps are nanoseconds from the simulation's zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.frame_folders import images_in, read_frames
from enerf_ns.dataparsers.formats.json_values import open_json
from enerf_ns.dataparsers.formats.text_tables import read_poses
from enerf_ns.dataparsers.formats.writer import (
    EventFiles,
    GrowingArray,
    Writer,
    encode_npy,
    encode_poses,
    poses_at,
)
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_is_folder, files_in, in_colour, load_array, of_file
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events/*.npy", "*poses_all*.txt", "poses_bounds.npy")

FEWEST_FRAMES, FEWEST_POSES = 11, 101
"""Least numbers of frames and poses that the reference code of E-NeRF accepts."""


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    poses_files = files_in(folder, "*poses_all*.txt")
    if not poses_files:
        raise RecordingError(
            f"{folder} holds no *poses_all*.txt; a file of poses (t_ns px py pz qx qy qz qw) was expected."
        )
    event_files = files_in(folder / "events", "*.npy")
    if not event_files:
        raise RecordingError(f"{folder / 'events'} holds no .npy files; files of events (x y t_ns p) were expected.")
    _check_numbers(event_files)
    trajectory = Trajectory(*read_poses(poses_files[0], "ns", notes))
    camera, depth_range = _read_poses_bounds(folder / "poses_bounds.npy")
    simulation_file = folder / "simulation.json"
    contrast_thresholds, response, exposure = None, None, None
    if simulation_file.exists():
        simulation = open_json(simulation_file)
        contrast_thresholds = simulation.pair("contrast_thresholds")
        depth_range = simulation.pair("depth_range") or depth_range
        if (simulated := simulation.get("camera")) is not None:
            camera = simulated.camera(simulated.each("width", "height"), simulated.each("fx", "fy", "cx", "cy"))
        response = simulation.found.get("response")
        exposure = simulation.nanoseconds("exposure_ns")

    num_rows = [_num_rows(file) for file in event_files]
    with of_file(simulation_file):
        rig = camera, trajectory, poses_files[0]
        frames = _read_frames(folder / "images", *rig, None if exposure is None else 0)
        blurred_frames = _read_frames(folder / "images_corrupted", *rig, exposure)
        return EventRecording(
            path=folder,
            format="esim",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(event_files, num_rows),
            event_files=tuple(event_files),
            frames=frames,
            blurred_frames=blurred_frames,
            contrast_thresholds=contrast_thresholds,
            response=response,
            depth_range=depth_range,
            notes=tuple(notes),
            locate_event=lambda index: _locate(event_files, num_rows, index),
            num_events=sum(num_rows),
            times_in={
                "events": (folder / "events", "ns"),
                "poses": (poses_files[0], "ns"),
                "frames": (folder / "images/image_stamps_ns.txt", "ns"),
                "blurred frames": (folder / "images_corrupted/image_stamps_ns.txt", "ns"),
            },
        )


def _check_numbers(files: list[Path]) -> None:
    """Checks that no event file is missing between others, if the names of the files are numbers in turn."""
    if not all(file.stem.isdecimal() for file in files):
        return
    files = sorted(files, key=lambda file: int(file.stem))
    steps = np.diff([int(file.stem) for file in files])
    gaps = np.flatnonzero(steps > 1)
    if not len(gaps) or 2 * (steps == 1).sum() < len(steps):  # such as stamps, or every tenth number
        return
    before, after, missing = files[gaps[0]], files[gaps[0] + 1], int((steps[gaps] - 1).sum())
    raise RecordingError(
        f"{before.parent} holds {before.name} and then {after.name}, but the names of its {len(files)} files are "
        f"numbers in turn, so {missing} {'is' if missing == 1 else 'are'} missing; copy them "
        "from their source."
    )


def _read_poses_bounds(path: Path) -> tuple[Camera, tuple[float, float] | None]:
    rows = load_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise RecordingError(f"{path} holds an array of shape {rows.shape}, but (N, 17) was expected.")
    height, width, focal_length = rows[0, :15].reshape(3, 5)[:, 4].tolist()
    with of_file(path):
        camera = Camera(width, height, focal_length, focal_length, width / 2, height / 2)
    bounds = rows[:, 15:]
    near, far = float(bounds[:, 0].min()), float(bounds[:, 1].max())
    return camera, (near, far) if 0 < near < far < np.inf else None


def _read_frames(
    folder: Path, camera: Camera, trajectory: Trajectory, poses_file: Path, exposure: int | None
) -> Frames | None:
    check_is_folder(folder.parent / "depth", "a folder of depth maps")
    depth_files = files_in(folder.parent / "depth", "*.npy")
    stamps_file = folder / "image_stamps_ns.txt"
    return read_frames(
        images_in(folder), stamps_file, camera, trajectory, depth_files, exposure=exposure, poses_file=poses_file
    )


def _stream_events(files: list[Path], num_rows: list[int]) -> Iterator[Events]:
    """Yields all events as they are in the files."""
    for file, length in zip(files, num_rows, strict=True):
        rows = load_array(file, mmap_mode="r")
        if len(rows) < length:
            raise RecordingError(f"{file} became shorter while it was read; read the recording again.")
        for start in range(0, length, EVENTS_AT_A_TIME):
            yield _events(file, rows[start : min(start + EVENTS_AT_A_TIME, length)], start)


def _events(file: Path, rows: np.ndarray, start: int) -> Events:
    """Returns the events of rows (n, 4) x y t_ns p of any type; `start` is the number of the first row in its file."""
    limits = (("x", 2**31), ("y", 2**31), ("t", 2**62), ("p", 2**31))
    is_float = rows.dtype.kind == "f"
    for column, (name, limit) in zip(rows.T, limits, strict=False):
        good = (column > -limit) & (column < limit)
        if is_float and name != "t":
            good &= column == np.rint(column)
        if not good.all():
            bad = int(np.argmin(good))
            expected = "a finite time in ns" if name == "t" else "a whole number"
            raise RecordingError(
                f"{file}, event {start + bad + 1} holds {name} = {column[bad]:g}, where {expected} was expected."
            )
    x, y, p = (rows[:, i].astype(np.int32) for i in (0, 1, 3))
    times = np.rint(rows[:, 2]) if is_float else rows[:, 2]
    return Events(x, y, times.astype(np.int64), p)


def _num_rows(file: Path) -> int:
    rows = load_array(file, mmap_mode="r")
    if rows.ndim != 2 or rows.shape[1] not in (4, 5):
        raise RecordingError(f"{file} holds an array of shape {rows.shape}, but (n, 4) was expected: x y t_ns p.")
    return len(rows)


def _locate(files: list[Path], num_rows: list[int], index: int) -> str:
    for file, length in zip(files, num_rows, strict=True):
        if index < length:
            return f"{file}, event {index + 1}"
        index -= length
    return str(files[-1])


class EsimWriter(Writer):
    """Writer of E-NeRF's ESIM sequences, with one file of events for each frame."""

    layout = "esim"
    frame_folders = ("images", "images_corrupted")
    stamps_name = "image_stamps_ns.txt"
    fewest_frames = FEWEST_FRAMES

    def _check(self) -> None:
        setup, camera = self.setup, self.setup.event_camera
        centred = Camera(camera.width, camera.height, camera.fx, camera.fx, camera.width / 2, camera.height / 2)
        if not (camera == setup.frame_camera == centred and np.allclose(setup.event_from_frame, np.eye(4), atol=1e-12)):
            raise FlagError(
                "The layout esim holds one camera for events and frames, without distortion, with one focal length and "
                "the principal point at (width / 2, height / 2); choose such a camera or another layout."
            )

    def _write_calibration(self) -> None:
        self._write_bounds()

    def _write_bounds(self) -> None:
        """Writes LLFF's rows [R | t | height width focal] (axes down, right, back), and nearest and farthest depth."""
        camera, trajectory, times = self.setup.event_camera, self.setup.trajectory, self.setup.frame_times
        poses = np.tile(np.eye(3, 4), (len(times), 1, 1))
        if trajectory is not None:
            poses = trajectory.poses(torch.from_numpy(times)).numpy()
        axes = np.stack([poses[:, :, 1], poses[:, :, 0], -poses[:, :, 2], poses[:, :, 3]], axis=2)
        sizes = np.tile(np.array([[camera.height], [camera.width], [camera.fx]]), (len(times), 1, 1))
        rows = np.concatenate([axes, sizes], axis=2).reshape(len(times), 15)
        bounds = np.tile(self.depth_range or (0.0, 0.0), (len(times), 1))
        self._replace("poses_bounds.npy", encode_npy(np.column_stack([rows, bounds]), np.float64))

    def _write_poses(self, trajectory: Trajectory) -> None:
        """Writes all poses, and interpolated ones between them if they are fewer than `FEWEST_POSES`."""
        times = trajectory.times
        parts = -(-FEWEST_POSES // (len(times) - 1))
        if len(times) < FEWEST_POSES:
            between = [start + (end - start) * np.arange(parts) // parts for start, end in pairwise(times)]
            times = np.unique(np.append(np.concatenate(between), times[-1]))
            positions, quaternions = poses_at(trajectory, times)
        else:
            positions, quaternions = trajectory.positions, trajectory.quaternions
        self._replace("poses_all.txt", encode_poses("# t_ns px py pz qx qy qz qw", times, positions, quaternions))

    def _open_events(self) -> EventFiles:
        paths = [f"events/{self._name(number)}.npy" for number in range(len(self.setup.frame_times))]
        return IntervalFiles([self.folder / path for path in paths], self.setup.frame_times)

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        return super()._images(number, in_colour(sharp), None if blurred is None else in_colour(blurred))

    def _write_depth_range(self) -> None:
        self._write_bounds()


class IntervalFiles:
    """Writer of one file for each frame, with the events from this frame to the next.

    The first file also holds the events before the first frame.
    """

    def __init__(self, paths: list[Path], frame_times: np.ndarray):
        for path in paths:
            GrowingArray(path, np.int64, (4,)).close()
        self._paths, self._ends, self._number = paths, frame_times[1:], 0
        self._file = GrowingArray(paths[0], np.int64, (4,))

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
                self._file = GrowingArray(self._paths[self._number], np.int64, (4,))

    def close(self) -> None:
        self._file.close()


FORMAT = Format(
    name="esim",
    command="esim-events",
    description="Events in the folder layout of E-NeRF's ESIM sequences.",
    files=FILES,
    read=read,
    writer=EsimWriter,
)
