"""Reader and writer of this project's layout, which a few lines of NumPy or `enerf convert` write.

    events/x.npy y.npy t.npy p.npy   (n,) each: column, row, time in ns, polarity 0 or 1, or -1 or 1; in time order
    poses.txt                        t_ns px py pz qx qy qz qw; camera to world, OpenCV axes, metres
    recording.json                   camera; and, optional, frame_camera, contrast_thresholds, refractory_period_ns,
                                     bayer_pattern, response, depth_range, reconstructed_by, white_level,
                                     frame_gamma
    camera_directions.npy            (height, width, 2) x / z and y / z of each pixel's ray, of a camera of model lookup
    frames/*.png                     sharp frames (or .jpg), with frames/stamps_ns.txt, one stamp a line: the middle of
                                     each exposure; and frames/exposures_ns.txt, how long each was, 0 for an instant
                                     (both optional)
    frames/numbers.txt               the numbers by which flags choose frames, one a line, if they are not 0, 1, 2 and
                                     so on (optional)
    blurred_frames/*.png             frames blurred by motion, with the same tables (optional); if reconstructed_by
                                     states that they were made from the events, their camera is the event camera
    depth/*.npy                      (height, width) depth in metres of each sharp frame, 0 where nothing is (optional)

All times are nanoseconds on one clock, from any zero.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from PIL import Image
from rich import get_console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from enerf_ns.dataparsers.formats.columns import LATEST, STORED_TYPES, check_columns, check_times
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, read_frames, read_stamps
from enerf_ns.dataparsers.formats.json_values import Value, open_json
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames, RestPoses, poses_of
from enerf_ns.dataparsers.formats.text_tables import parse_numbers, read_rows
from enerf_ns.dataparsers.formats.writer import (
    CAMERA_KEYS,
    MOUNTING_KEY,
    EventFiles,
    GrowingArray,
    Setup,
    Writer,
    camera_json,
    encode_json,
    encode_npy,
    encode_poses,
    is_second_camera,
    mounted_camera_json,
)
from enerf_ns.dataparsers.recording.camera import COEFFICIENTS, Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_is_folder, files_in, is_deep, load_array, of_file, write_whole
from enerf_ns.dataparsers.recording.hdf5_files import file_of, is_deep_picture, load_depth_map, load_picture
from enerf_ns.dataparsers.recording.ranges import COUNT
from enerf_ns.dataparsers.recording.recording import (
    EVENTS_AT_A_TIME,
    LARGEST_GAMMA,
    MOUNTING_TOLERANCE,
    EventRecording,
    Events,
    Frames,
)
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events/x.npy", "events/t.npy", "recording.json", "poses.txt")

OPTIONAL_KEYS = (
    *("frame_camera", "contrast_thresholds", "refractory_period_ns", "bayer_pattern", "response", "depth_range"),
    *("reconstructed_by", "white_level", "frame_gamma"),
)
STAMPS_NAME, EXPOSURES_NAME, NUMBERS_NAME = "stamps_ns.txt", "exposures_ns.txt", "numbers.txt"


def read(folder: Path, poses: GivenPoses | None = None) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses in place of poses.txt.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    columns = _open_columns(folder / "events")
    path = folder / "recording.json"
    about = open_json(path)
    about.check_keys(("camera",), OPTIONAL_KEYS)
    camera = parse_camera(about["camera"], folder / "camera_directions.npy")
    poses_file, unit = (folder / "poses.txt", "ns") if poses is None else (poses.path, poses.unit)
    mounted, reconstructed_by = about.get("frame_camera"), about.found.get("reconstructed_by")
    frame_camera, mounting = (camera, np.eye(4)) if mounted is None else _parse_frame_camera(mounted)
    named = []
    if poses is not None:
        blurred_mounting = mounting if reconstructed_by is None else np.eye(4)
        named = [*_named(folder / "frames", mounting), *_named(folder / "blurred_frames", blurred_mounting)]
    trajectory = Trajectory(*poses_of(poses_file, unit, poses, named, notes))
    frame_trajectory = trajectory if mounted is None else trajectory.of_mounted(mounting)
    blurred_rig = frame_camera, frame_trajectory
    if reconstructed_by is not None:
        blurred_rig = camera, trajectory
        notes.append(f"The blurred frames are reconstructed from events by {reconstructed_by}.")
    stored = _parse_white_level(about), _parse_gamma(about)
    check_is_folder(folder / "depth", "a folder of depth maps")
    depth_files = files_in(folder / "depth", "*.npy")
    frames = _read_frames(folder / "frames", poses_file, frame_camera, frame_trajectory, stored, depth_files)
    blurred_frames = _read_frames(folder / "blurred_frames", poses_file, *blurred_rig, stored)
    shallow = [kind.filenames[0] for kind in (frames, blurred_frames) if kind and not is_deep(kind.filenames[0])]
    if stored[0] not in (None, 255) and len(shallow) == sum(kind is not None for kind in (frames, blurred_frames)) > 0:
        raise RecordingError(
            f"{path} holds white_level = {stored[0]:g}, but {shallow[0]} has 8 bits, of which 255 is white; leave "
            "white_level out."
        )
    with of_file(path):
        return EventRecording(
            path=folder,
            format="event_recording",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(folder / "events", columns),
            event_files=tuple(folder / "events" / f"{name}.npy" for name in STORED_TYPES),
            frames=frames,
            blurred_frames=blurred_frames,
            reconstructed_by=reconstructed_by,
            contrast_thresholds=about.pair("contrast_thresholds", "two numbers above 0, of on and off events, were"),
            depth_range=about.pair("depth_range", "the nearest and the farthest depth in metres were"),
            refractory_period=about.nanoseconds("refractory_period_ns") or 0,
            bayer_pattern=about.found.get("bayer_pattern"),
            response=about.found.get("response"),
            notes=tuple(notes),
            num_events=len(columns["t"]),
            times_in={
                "events": (folder / "events/t.npy", "ns"),
                "poses": (poses_file, unit),
                "frames": (folder / "frames/stamps_ns.txt", "ns"),
                "blurred frames": (folder / "blurred_frames/stamps_ns.txt", "ns"),
            },
        )


def rest_poses(folder: Path) -> RestPoses | None:
    """Returns poses at rest from the first to the last event of a recording of this layout that has no poses; None for
    any other folder.

    Raises:
        RecordingError: A file of the events is missing, empty or cannot be used.
    """
    if (folder / "poses.txt").exists() or not (folder / "recording.json").exists():
        return None
    ends = _open_columns(folder / "events")["t"][[0, -1]]
    check_times(folder / "events/t.npy", ends)
    return RestPoses(folder, times=(int(ends[0]), int(ends[1])))


def write(recording: EventRecording, folder: Path) -> int:
    """Writes all events, poses, frames, calibration and depth of a recording, with the same times.

    Args:
        recording: A recording of any format. Without poses, poses.txt is not written, and no times are compared.
        folder: An empty folder.

    Returns:
        The number of events.

    Raises:
        RecordingError: An event lies outside the sensor, goes back in time or has another polarity, times are in
            another unit, no event lies within the poses, or the camera of the frames is not fixed to the event camera.
        OSError: The disk is full, or a frame cannot be copied.
    """
    kinds = {"frames": recording.frames, "blurred_frames": recording.blurred_frames}
    of_frame_camera = kinds.values() if recording.reconstructed_by is None else [recording.frames]
    frame_cameras = [_frame_camera_json(recording, frames) for frames in of_frame_camera if frames is not None]
    if any(camera != frame_cameras[0] for camera in frame_cameras):
        raise RecordingError(f"{recording.path} holds sharp and blurred frames of two cameras, but one was expected.")
    frame_camera = frame_cameras[0] if frame_cameras else None
    deep = [frames for frames in kinds.values() if frames is not None and is_deep_picture(frames.filenames[0])]
    white_level = deep[0].white_level if deep else None
    about = _encode_about(
        *(recording.camera, frame_camera, recording, recording.depth_range),
        reconstructed_by=recording.reconstructed_by,
        white_level=white_level,
        frame_gamma=next((frames.gamma for frames in kinds.values() if frames and frames.gamma != 1.0), None),
    )
    write_whole(folder / "recording.json", about)
    if recording.camera.directions is not None:
        np.save(folder / "camera_directions.npy", recording.camera.directions)
    trajectory = recording.trajectory
    if recording.has_poses:
        write_poses(folder / "poses.txt", trajectory.times, trajectory.positions, trajectory.quaternions)
    for name, frames in kinds.items():
        if frames is not None:
            _write_frames(frames, folder / name, folder / "depth")

    size = recording.camera.width, recording.camera.height
    num_events, first, last = write_events(
        recording.stream_events(), folder / "events", *size, recording.locate, recording.num_events
    )
    if recording.has_poses:
        recording.check_units(num_events, last - first)
        start, end = recording.span
        if last < start or end < first:
            raise recording.not_covered(first, last)
    return num_events


def write_events(
    stream: Iterator[Events],
    folder: Path,
    width: int,
    height: int,
    locate: Callable[[int], str],
    total: int | None = None,
) -> tuple[int, int, int]:
    """Writes events piece by piece into x.npy, y.npy, t.npy and p.npy, and shows the progress.

    Args:
        stream: Pieces of events in time order.
        folder: New folder for the files.
        width, height: Size of the sensor, pixels.
        locate: Function that names the file and line of event number i, for error messages.
        total: Number of events, if it is known.

    Returns:
        The number of events, and the times of the first and of the last one (ns).

    Raises:
        RecordingError: There are no events, or one lies outside the sensor, goes back in time or has another polarity.
        OSError: The disk is full.
    """
    num_events, first, last = 0, 0, -LATEST
    columns = (TextColumn("Writing {task.completed:,} events"), BarColumn(), TimeRemainingColumn())
    shown = Progress(*columns, transient=True, disable=not get_console().is_terminal)
    with closing(_ColumnFiles(folder)) as files, shown as progress:
        task = progress.add_task("", total=total)
        for events in filter(len, stream):
            _check_events(events, last, width, height, lambda i, before=num_events: locate(before + i))
            files.append(events)
            first = first if num_events else int(events.t[0])
            num_events, last = num_events + len(events), int(events.t[-1])
            progress.update(task, completed=num_events)
    if num_events == 0:
        raise RecordingError(f"{locate(0)} is missing, since there are no events; give a recording with some.")
    return num_events, first, last


def write_poses(
    path: Path,
    times: Int64[np.ndarray, " poses"],
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
) -> None:
    """Writes poses.txt with all digits, so that the reader returns the same numbers.

    Args:
        path: The file.
        times: Nanoseconds.
        positions: Metres.
        quaternions: xyzw.

    Raises:
        OSError: The disk is full.
    """
    write_whole(path, encode_poses("# t_ns px py pz qx qy qz qw", times, positions, quaternions))


def parse_camera(value: Value, directions_file: Path | None = None) -> Camera:
    """Returns the camera of a JSON object with width, height, model, fx, fy, cx, cy (pixels) and distortion.

    Args:
        value: The object; a model without distortion needs no such key.
        directions_file: Table of a camera of the model lookup; None if this model is not possible.

    Raises:
        RecordingError: A key is missing, unknown or out of range, or the camera fits no lens.
    """
    value.check_keys(CAMERA_KEYS, ("distortion",))
    width, height, *intrinsics = value.each("width", "height", "fx", "fy", "cx", "cy")
    model = value["model"].choice(known for known in COEFFICIENTS if known != "lookup" or directions_file is not None)
    coefficients = value.get("distortion")
    distortion = [] if coefficients is None else [float(item.numbers(())) for item in coefficients.values()]
    camera = value.camera((width, height), intrinsics, distortion, "pinhole" if model == "lookup" else model)
    if model != "lookup":
        return camera
    assert directions_file is not None
    with of_file(directions_file):
        return replace(camera, model="lookup", directions=load_array(directions_file).astype(np.float64))


def _open_columns(folder: Path) -> dict[str, Any]:
    """Opens the four files of events; only their headers are read."""
    columns = {name: load_array(folder / f"{name}.npy", mmap_mode="r") for name in STORED_TYPES}
    check_columns(folder, {f"{name}.npy": column for name, column in columns.items()}, "ns")
    return columns


def _stream_events(folder: Path, columns: dict[str, Any]) -> Iterator[Events]:
    """Yields the events that the files held when their headers were read."""
    length = len(columns["t"])
    for start in range(0, length, EVENTS_AT_A_TIME):
        count = min(EVENTS_AT_A_TIME, length - start)
        pieces = {name: _read_piece(folder / f"{name}.npy", column, start, count) for name, column in columns.items()}
        t = pieces.pop("t")
        check_times(folder / "t.npy", t)
        yield Events(t=t.astype(np.int64, copy=False), **pieces)


def _read_piece(path: Path, column: np.memmap, start: int, count: int) -> np.ndarray:
    """Returns some rows of a column. Reading notices a file that shrinks, which a memory map does not."""
    try:
        piece = np.fromfile(path, column.dtype, count, offset=column.offset + start * column.dtype.itemsize)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error}); copy it again from its source.") from error
    if len(piece) < count:
        raise RecordingError(f"{path} became shorter while it was read; read the recording again.")
    return piece.astype(column.dtype.newbyteorder("="), copy=False)


def _check_events(events: Events, last: int, width: int, height: int, locate: Callable[[int], str]) -> None:
    limits = (("x", events.x, 0, width - 1), ("y", events.y, 0, height - 1), ("polarity", events.p, -1, 1))
    for name, column, smallest, largest in limits:
        bad = (column < smallest) | (column > largest)
        if bad.any():
            index = int(np.argmax(bad))
            raise RecordingError(
                f"{locate(index)} holds {name} = {column[index]}, but from {smallest} to {largest} was expected, on a "
                f"sensor of {width} x {height} pixels."
            )
    backwards = np.diff(events.t, prepend=last) < 0
    if backwards.any():
        index = int(np.argmax(backwards))
        before = events.t[index - 1] if index else last
        raise RecordingError(
            f"{locate(index)} goes back in time from {before} ns to {events.t[index]} ns, but events must be in time "
            "order; sort them."
        )


def read_cameras(path: Path) -> tuple[Camera, Camera, Float64[np.ndarray, "4 4"]]:
    """Returns the event camera, the frame camera, and the pose of the frame camera in the axes of the event camera.

    Args:
        path: JSON file with camera and, if another camera takes the frames, frame_camera, as in recording.json.

    Raises:
        RecordingError: The file is missing or holds no such cameras.
    """
    about = open_json(path)
    if about.get(MOUNTING_KEY) is not None:
        raise RecordingError(f"{path} holds {MOUNTING_KEY} beside frame_camera; move it into frame_camera.")
    camera = parse_camera(about["camera"])
    mounted = about.get("frame_camera")
    return (camera, camera, np.eye(4)) if mounted is None else (camera, *_parse_frame_camera(mounted))


def _parse_frame_camera(value: Value) -> tuple[Camera, Float64[np.ndarray, "4 4"]]:
    """Returns the camera of the frames, and its pose in the axes of the event camera."""
    if value.get(MOUNTING_KEY) is None:
        return parse_camera(value), np.eye(4)
    camera = {key: item for key, item in value.found.items() if key != MOUNTING_KEY}
    return parse_camera(replace(value, found=camera)), value[MOUNTING_KEY].pose()


def _encode_about(
    camera: Camera,
    frame_camera: dict[str, Any] | None,
    sensor: EventRecording | Setup,
    depth_range: tuple[float, float] | None,
    **about_frames: Any,
) -> bytes:
    """Returns the content of recording.json, without the keys whose values are not known."""
    about = {
        "camera": camera_json(camera),
        "frame_camera": frame_camera,
        "contrast_thresholds": sensor.contrast_thresholds,
        "refractory_period_ns": sensor.refractory_period or None,
        "bayer_pattern": sensor.bayer_pattern,
        "response": sensor.response,
        "depth_range": depth_range,
        **about_frames,
    }
    return encode_json({key: value for key, value in about.items() if value is not None})


def _frame_camera_json(recording: EventRecording, frames: Frames) -> dict[str, Any] | None:
    """Returns the frame camera as recording.json states it, or None if it is the event camera."""
    body, mounted = recording.trajectory, frames.trajectory
    if mounted is body and frames.camera == recording.camera:
        return None
    times = torch.from_numpy(mounted.times[body.covers(mounted.times)])
    bodies, cameras = body.poses(times).numpy(), mounted.poses(times).numpy()
    inverses = bodies[:, :, :3].transpose(0, 2, 1)
    mountings = inverses @ (cameras - np.pad(bodies[:, :, 3:], ((0, 0), (0, 0), (3, 0))))
    if not len(mountings) or np.abs(mountings - mountings[0]).max() > MOUNTING_TOLERANCE:
        raise RecordingError(
            f"{recording.path} holds frames of a camera that moves against the event camera, but this layout holds one "
            "trajectory and constant extrinsics."
        )
    if frames.camera.model == "lookup":
        raise RecordingError(
            f"{recording.path} holds frames of a camera with a table of directions, but this layout holds such a table "
            "only for the event camera."
        )
    return mounted_camera_json(frames.camera, np.vstack([mountings[0], [0.0, 0.0, 0.0, 1.0]]))


def _read_frames(
    folder: Path,
    poses_file: Path,
    camera: Camera,
    trajectory: Trajectory,
    stored: tuple[float | None, float],
    depth_files: Sequence[Path] = (),
) -> Frames | None:
    white, gamma = stored
    stamps_file, exposures_file = folder / STAMPS_NAME, folder / EXPOSURES_NAME
    files = _images_in(folder)
    rig = files, stamps_file, camera, trajectory
    frames = read_frames(*rig, depth_files, exposures_file, poses_file=poses_file)
    if frames is None:
        return None
    numbers = frames.numbers
    if (folder / NUMBERS_NAME).exists():
        numbers = _read_numbers(folder / NUMBERS_NAME, len(files))
    return replace(frames, stated_white=white if is_deep(files[0]) else None, gamma=gamma, numbers=numbers)


def _read_numbers(path: Path, num_frames: int) -> Int64[np.ndarray, " frames"]:
    rows, lines = read_rows(path, "number")
    check_one_each(path.parent, num_frames, path, len(rows), "numbers")
    values = parse_numbers(path, rows, lines)[:, 0]
    wrong = (values != np.rint(values)) | (np.diff(values, prepend=-1) <= 0) | (values > COUNT[1])
    if wrong.any():
        first = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}, line {lines[first]} holds {rows[first][0]}, but whole numbers from 0 to {COUNT[1]:,} were "
            "expected, each above the one before."
        )
    return values.astype(np.int64)


def _images_in(folder: Path) -> list[Path]:
    kinds = Image.registered_extensions()
    return [file for file in files_in(folder, "*") if file.suffix.lower() in kinds]


def _named(folder: Path, mounting: Float64[np.ndarray, "4 4"]) -> list[NamedFrames]:
    """Returns the frames of a folder, if it has some."""
    if not (folder / STAMPS_NAME).exists():
        return []
    files = _images_in(folder)
    return [NamedFrames(files, read_stamps(files, folder / STAMPS_NAME, "ns", folder), mounting)]


def _write_frames(frames: Frames, folder: Path, depth_folder: Path) -> None:
    """Copies frames and their depth; the numbers of the frames become names that sort in the same order."""
    folder.mkdir()
    digits = max(5, len(str(frames.numbers[-1])))
    names = [f"{number:0{digits}d}" for number in frames.numbers.tolist()]
    for name, source in zip(names, frames.filenames, strict=True):
        picture = load_picture(source)  # raises RecordingError if it is damaged
        if file_of(source) == source:
            shutil.copyfile(source, folder / f"{name}{source.suffix.lower()}")
        else:
            Image.fromarray(picture[..., 0]).save(folder / f"{name}.png")
    (folder / "stamps_ns.txt").write_text("".join(f"{time}\n" for time in frames.times.tolist()))
    if (frames.numbers != np.arange(len(frames.numbers))).any():
        (folder / NUMBERS_NAME).write_text("".join(f"{number}\n" for number in frames.numbers.tolist()))
    if frames.exposures is not None:
        (folder / EXPOSURES_NAME).write_text("".join(f"{exposure}\n" for exposure in frames.exposures.tolist()))
    if frames.depth_filenames and folder.name == "frames":
        depth_folder.mkdir()
        for name, source in zip(names, frames.depth_filenames, strict=True):
            depth = load_depth_map(source)  # raises RecordingError if it is no depth map
            if file_of(source) == source:
                shutil.copyfile(source, depth_folder / f"{name}.npy")
            else:
                np.save(depth_folder / f"{name}.npy", depth)


def _parse_white_level(about: Value) -> float | None:
    value = about.get("white_level")
    if value is None:
        return None
    expected = "a number above 0, the value of full brightness in files of more than 8 bits, was"
    if (white := float(value.numbers((), expected))) <= 0:
        raise value.wrong(expected)
    return white


def _parse_gamma(about: Value) -> float:
    value = about.get("frame_gamma")
    if value is None:
        return 1.0
    expected = f"a number from 1 to {LARGEST_GAMMA:g}, which makes the values of frames linear as their exponent, was"
    if not 1.0 <= (gamma := float(value.numbers((), expected))) <= LARGEST_GAMMA:
        raise value.wrong(expected)
    return gamma


class EventRecordingWriter(Writer):
    """Writer of this project's own layout."""

    layout = "event_recording"
    frame_folders = ("frames", "blurred_frames")
    stamps_name = "stamps_ns.txt"

    def _stamps(self, time: int) -> dict[str, str]:
        exposures = (0, self.setup.exposure) if self.setup.exposure else (0,)
        folders = zip(self.frame_folders, exposures, strict=False)
        return super()._stamps(time) | {f"{folder}/{EXPOSURES_NAME}": f"{exposure}\n" for folder, exposure in folders}

    def _check(self) -> None:
        if self.setup.frame_camera.model == "lookup":
            raise FlagError(
                "The layout event_recording holds no table of directions for the frame camera; give its distortion."
            )

    def _write_calibration(self) -> None:
        if self.setup.event_camera.directions is not None:
            self._replace("camera_directions.npy", encode_npy(self.setup.event_camera.directions, np.float64))
        self._write_about()

    def _write_about(self) -> None:
        setup = self.setup
        rig = setup.event_camera, setup.frame_camera, setup.event_from_frame
        frame_camera = mounted_camera_json(*rig[1:]) if is_second_camera(*rig) else None
        self._replace("recording.json", _encode_about(rig[0], frame_camera, setup, self.depth_range))

    def _write_poses(self, trajectory: Trajectory) -> None:
        write_poses(self.folder / "poses.txt", trajectory.times, trajectory.positions, trajectory.quaternions)

    def _open_events(self) -> EventFiles:
        return _ColumnFiles(self.folder / "events")

    def _write_depth_range(self) -> None:
        self._write_about()


class _ColumnFiles:
    """Writer of the files x.npy, y.npy, t.npy and p.npy."""

    def __init__(self, folder: Path):
        self._files = {name: GrowingArray(folder / f"{name}.npy", dtype) for name, dtype in STORED_TYPES.items()}
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


FORMAT = Format(
    name="event_recording",
    command="event-recording",
    description="Events in the folder layout of enerf-ns, from any camera.",
    files=FILES,
    read=read,
    takes_poses=True,
    writer=EventRecordingWriter,
)
