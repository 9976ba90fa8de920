"""Poses from the files of trackers, visual odometry and structure from motion, in their usual conventions.

    tum         text, t px py pz qx qy qz qw (TUM RGB-D benchmark, evo, most visual odometry and motion capture)
    euroc       CSV, t px py pz qw qx qy qz ..., times in ns (EuRoC MAV); names of the columns may state another order
    colmap      folder of a sparse model: images.bin or images.txt, world to camera, one image each, without times
    nerfstudio  transforms.json: matrices, camera to world in OpenGL's axes, one image each, without times
    bag         ROS 1 (.bag) or ROS 2 (folder): PoseStamped, PoseWithCovarianceStamped, TransformStamped,
                Odometry, Path, tf

To add a format, write a function that reads it, and name it in `POSE_FORMATS`.

Sturm et al., IROS 2012; Burri et al., IJRR 2016; COLMAP: colmap.github.io/format.html; docs.nerf.studio, "Data
conventions".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import islice
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import unit_quaternions
from enerf_ns.dataparsers.formats.json_values import open_json
from enerf_ns.dataparsers.formats.ros_poses import read_bag
from enerf_ns.dataparsers.formats.text_tables import MOST_ROWS, parse_numbers, parse_times, read_poses, read_rows
from enerf_ns.dataparsers.recording.camera import check_rotation
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_TABLE, LONGEST_LINE, of_file, read_text, reading
from enerf_ns.dataparsers.recording.recording import nanoseconds

Order = Literal["xyzw", "wxyz"]
Direction = Literal["camera-to-world", "world-to-camera"]
Axes = Literal["opencv", "opengl", "ros"]

FROM_OPENCV: dict[Axes, Float64[np.ndarray, "3 3"]] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""Rotation from OpenCV's axes of the camera to others. Multiplied from the right, it makes poses of others OpenCV's."""

PoseRows = tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]
"""Times (ns), positions and quaternions xyzw of poses."""


@dataclass(frozen=True)
class PoseFlags:
    """Conventions of a file of poses, where they differ from those of its format."""

    poses_unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of the times in the files of --poses and --poses-times. Default: s; in CSV (EuRoC) ns. ROS states it."""
    poses_direction: Direction | None = None
    """Direction of the transformation that a pose states. Default: camera-to-world; of COLMAP world-to-camera."""
    poses_axes: Axes | None = None
    """Axes of the camera: opencv (x right, y down, z forward), opengl (x right, y up, z backward) or ros (x forward, y
    left, z up). Default: opencv; of transforms.json opengl."""
    poses_quaternions: Order | None = None
    """Order of the numbers of a quaternion. Default: xyzw; of COLMAP and EuRoC wxyz."""
    poses_scale: float = 1.0
    """Metres in a unit of length of the poses. COLMAP and visual odometry with one camera leave it open."""
    poses_delay_ms: float = 0.0
    """Milliseconds by which the poses are stamped later than events of the same instant. They are taken off."""
    poses_times: Path | None = None
    """For poses of images (COLMAP, transforms.json): text file with the time and the name of an image in each line.
    Default: the frames of the recording, by the names of their files."""
    poses_topic: str | None = None
    """For a ROS bag: topic of the poses. Default: the only one with poses."""
    poses_frames: tuple[str, str] | None = None
    """For a ROS bag with tf: names of two frames, the world and the camera (or the tracked body)."""
    hand_eye: Path | None = None
    """Text file with the pose of the event camera in the axes of the tracked body, from hand-eye calibration: a matrix
    of 4 x 4 numbers, or px py pz qx qy qz qw, metres. Default: the tracked body is the event camera."""


@dataclass(frozen=True)
class NamedFrames:
    """Frames of a recording, which poses of images may name."""

    files: Sequence[Path]
    times: Int64[np.ndarray, " frames"]
    """Times in nanoseconds."""
    mounting: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Pose of their camera in the axes of the camera whose poses are read, metres."""


@dataclass(frozen=True)
class GivenPoses:
    """A file of poses that the user gives for a recording."""

    path: Path
    flags: PoseFlags = PoseFlags()

    @property
    def unit(self) -> str:
        """Unit of the times, s, ms, us or ns."""
        return self.flags.poses_unit or _format_of(self.path).unit

    def rows(self, frames: Sequence[NamedFrames], notes: list[str]) -> PoseRows:
        """Returns the poses of the event camera on the clock of the file: camera to world, OpenCV axes, metres.

        Args:
            frames: The frames of the recording.
            notes: Gets sentences on what was left out or renormalised, and on frames of a second camera.

        Raises:
            RecordingError: A file is missing, damaged, or holds fewer than two poses.
            FlagError: A flag changes nothing for this format, is out of range, or is missing for frames that share a
                name.
        """
        flags, format = self.flags, _format_of(self.path)
        self._check_flags(format)
        keys, positions, values, order = format.read(self.path, flags, self.unit, notes)
        order = flags.poses_quaternions or order
        turns = Rotation.from_quat(values if order == "xyzw" else values[:, [1, 2, 3, 0]])
        if (flags.poses_direction or format.direction) == "world-to-camera":
            turns = turns.inv()
            positions = -turns.apply(positions)
        positions = positions * flags.poses_scale
        if flags.hand_eye is not None:
            mount = read_hand_eye(flags.hand_eye)
            positions, turns = positions + turns.apply(mount[:3, 3]), turns * Rotation.from_matrix(mount[:3, :3])
        turns = turns * Rotation.from_matrix(FROM_OPENCV[flags.poses_axes or format.axes])
        quaternions = turns.as_quat()
        if not isinstance(keys, np.ndarray):
            keys, chosen, mountings = self._times_of(keys, frames, notes)
            positions, quaternions = positions[chosen], quaternions[chosen]
            if flags.hand_eye is None and (mountings != np.eye(4)).any():
                notes.append(
                    f"The poses in {self.path.name} are of frames of a second camera, and those of the event camera "
                    "follow from its mounting in metres, as which --poses-scale must make them."
                )
                mounts, turns = np.linalg.inv(mountings), Rotation.from_quat(quaternions)
                positions = positions + turns.apply(mounts[:, :3, 3])
                quaternions = (turns * Rotation.from_matrix(mounts[:, :3, :3])).as_quat()
        return keys - nanoseconds(flags.poses_delay_ms * 1e-3), positions, quaternions

    def _check_flags(self, format: PoseFormat) -> None:
        for one in fields(PoseFlags):
            if one.name in format.without and getattr(self.flags, one.name) != one.default:
                flag = f"--{one.name.replace('_', '-')}"
                raise FlagError(
                    f"{flag} changes nothing for {self.path}, which is read as {format.name}; leave it out."
                )
        scale, delay = self.flags.poses_scale, self.flags.poses_delay_ms
        if not 1e-9 <= scale <= 1e9:
            raise FlagError(f"--poses-scale is {scale:g}, but must be from 1e-9 to 1e9 (metres).")
        if not abs(delay) < 1e15:
            raise FlagError(f"--poses-delay-ms is {delay:g}, but must be within 1e15.")

    def _times_of(
        self, names: Sequence[str], frames: Sequence[NamedFrames], notes: list[str]
    ) -> tuple[Int64[np.ndarray, " poses"], list[int], Float64[np.ndarray, "poses 4 4"]]:
        """Returns the times of images with these names, in order, and the number and the mounting of each image."""
        where = "the frames of the recording"
        if self.flags.poses_times is not None:
            if self.flags.hand_eye is None and any((group.mounting != np.eye(4)).any() for group in frames):
                notes.append(
                    f"Poses in {self.path.name} are taken as those of the event camera; if they are those of the "
                    "frame camera, give the pose of the event camera in its axes as --hand-eye."
                )
            where = str(self.flags.poses_times)
            rows, numbers = read_rows(self.flags.poses_times, f"t_{self.unit} name")
            times = parse_times(self.flags.poses_times, [row[0] for row in rows], numbers, self.unit, "frames")
            frames = [NamedFrames([Path(row[1]) for row in rows], times)]
        whole: dict[str, list[tuple[int, np.ndarray]]] = {}
        stems: dict[str, list[tuple[int, np.ndarray]]] = {}
        for group in frames:
            for file, time in zip(group.files, group.times.tolist(), strict=True):
                whole.setdefault(file.name, []).append((time, group.mounting))
                stems.setdefault(file.stem, []).append((time, group.mounting))
        table = stems | whole
        self._check_names([Path(name).name for name in names], table, where)
        at = {i: table[Path(name).name][0] for i, name in enumerate(names) if Path(name).name in table}
        if len(at) < 2:
            raise RecordingError(
                f"{self.path} holds poses of images such as {names[0]}, but {len(at)} of them have a time, as {where} "
                f"{'states' if self.flags.poses_times else 'state'} it; give --poses-times FILE with lines “t name”."
            )
        if len(at) < len(names):
            notes.append(f"{len(names) - len(at):,} of {len(names):,} poses in {self.path.name} are left out, because "
                         "their image has no time.")  # fmt: skip
        chosen = sorted(at, key=lambda i: at[i][0])
        times = np.array([at[i][0] for i in chosen], np.int64)
        if (np.diff(times) <= 0).any():
            first = int(np.argmax(np.diff(times) <= 0))
            one, other = names[chosen[first]], names[chosen[first + 1]]
            raise RecordingError(
                f"{self.path} holds poses of {one} and {other}, which have the same time; leave one out."
            )
        return times, chosen, np.stack([at[i][1] for i in chosen])

    def _check_names(self, names: Sequence[str], table: dict[str, list[tuple[int, np.ndarray]]], where: str) -> None:
        """Checks that frames of one name have one time, and one camera unless --hand-eye states where it is."""
        for name in names:
            (first, mounting), *others = table.get(name) or [(0, np.eye(4))]
            for time, other_mounting in others:
                if time != first:
                    raise FlagError(
                        f"{self.path} holds a pose of {name}, but two times of it are known from {where}, {first} ns "
                        f"and {time} ns; give --poses-times FILE with one line “t name” for each image."
                    )
                if self.flags.hand_eye is None and (other_mounting != mounting).any():
                    raise FlagError(
                        f"{self.path} holds a pose of {name}, but {where} of this name are of two cameras; give "
                        "--hand-eye FILE with the pose of the event camera in the axes of the one whose poses these "
                        "are, 0 0 0 0 0 0 1 if it is the event camera."
                    )


@dataclass(frozen=True)
class RestPoses(GivenPoses):
    """Poses of a camera at rest, in place of those of a recording whose poses nobody knows yet."""

    times: tuple[int, ...] = ()
    """Times that the two poses enclose, beside those of all frames, ns."""

    @property
    def unit(self) -> str:
        return "ns"

    def rows(self, frames: Sequence[NamedFrames], notes: list[str]) -> PoseRows:
        times = [*self.times, *(time for group in frames for time in group.times.tolist())] or [0]
        ends = np.array([min(times), max(times) + 1])
        return ends, np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))


def poses_of(
    path: Path, unit: str, given: GivenPoses | None, frames: Sequence[NamedFrames], notes: list[str]
) -> PoseRows:
    """Returns the poses of a recording: those that the user gives, or else those of a text file in its folder.

    Args:
        path: The file, with lines t px py pz qx qy qz qw.
        unit: Unit of its times.
        given: Poses in place of the file.
        frames, notes: Arguments of `GivenPoses.rows`.

    Raises:
        RecordingError: A file is missing, damaged, or holds fewer than two poses.
        FlagError: `GivenPoses.rows` raises it.
    """
    if given is not None:
        return given.rows(frames, notes)
    if not path.exists():
        raise RecordingError(
            f"{path} is missing, a text file with the columns t_{unit} px py pz qx qy qz qw of the event camera; add "
            "it, or give poses as --poses of enerf convert, which also writes frames --without-poses, so that COLMAP "
            "can find them."
        )
    return read_poses(path, unit, notes)


Keys = Int64[np.ndarray, " poses"] | Sequence[str]
"""Times of poses (ns), or the names of their images."""
Read = tuple[Keys, Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"], Order]
"""Keys, positions and unit quaternions as they are written, and the order of the numbers of a quaternion."""

OF_IMAGES, OF_BAGS = ("poses_times",), ("poses_topic", "poses_frames")


@dataclass(frozen=True)
class PoseFormat:
    """A format of files of poses, with its conventions."""

    name: str
    recognises: Callable[[Path], bool]
    """Function that decides by the name, the kind or the begin of a file whether it is of this format."""
    read: Callable[[Path, PoseFlags, str, list[str]], Read]
    """Function of the file, the flags, the unit of times and the notes. It raises RecordingError."""
    without: tuple[str, ...]
    """Flags that change nothing."""
    unit: str = "s"
    direction: Direction = "camera-to-world"
    axes: Axes = "opencv"


def read_hand_eye(path: Path) -> Float64[np.ndarray, "4 4"]:
    """Returns the pose of the event camera in the axes of the tracked body, from a text file.

    Args:
        path: 4 x 4 or 3 x 4 numbers row by row, or px py pz qx qy qz qw; brackets and commas count as spaces.

    Raises:
        RecordingError: The file is missing, or holds no rigid motion.
    """
    expected = "4 x 4 numbers row by row, or px py pz qx qy qz qw,"
    cells = re.sub(r"[\[\](){},;]", " ", read_text(path, expected.rstrip(","))).split()
    if len(cells) not in (7, 12, 16):
        raise RecordingError(f"{path} holds {len(cells)} numbers, but {expected} were expected.")
    values = parse_numbers(path, [cells], [1])[0]
    matrix = np.eye(4)
    if len(cells) == 7:
        turn = unit_quaternions(path, values[None, :3], values[None, 3:], [], lambda _: "line 1")
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(turn[0]).as_matrix(), values[:3]
    else:
        matrix[: len(cells) // 4] = values.reshape(-1, 4)
    try:
        check_rotation(matrix[:3, :3])
    except ValueError as error:
        raise RecordingError(f"{path} holds a matrix whose upper left 3 x 3 part {error}.") from error
    if (matrix[3] != [0, 0, 0, 1]).any():
        raise RecordingError(f"{path} holds the last row {matrix[3].tolist()}, but 0 0 0 1 was expected.")
    return matrix


def _read_tum(path: Path, flags: PoseFlags, unit: str, notes: list[str]) -> Read:
    return *read_poses(path, unit, notes), "xyzw"


def _read_euroc(path: Path, flags: PoseFlags, unit: str, notes: list[str]) -> Read:
    header: list[str] = []
    rows, numbers = [], []
    for number, line in _lines(path, "a CSV file of poses"):
        cells = [cell.strip() for cell in line.split(",")]
        if number == 1 and not re.match(r"[-+.\d]", line.strip()):
            header = cells
        elif line.strip() and not line.startswith("#"):
            if len(cells) < 8:
                expected = "at least 8 were expected: t, px, py, pz, and four of a quaternion"
                raise RecordingError(f"{path}, line {number} has {len(cells)} columns, but {expected}.")
            rows.append(cells[:8])
            numbers.append(number)
    if len(rows) < 2:
        raise RecordingError(f"{path} holds {len(rows)} poses, but at least 2 were expected.")
    times = parse_times(path, [row[0] for row in rows], numbers, unit)
    values = parse_numbers(path, [row[1:] for row in rows], numbers)
    letters = "".join(re.sub(r"[^wxyz]", "", re.sub(r"\[.*", "", name).lower())[-1:] for name in header[4:8])
    quaternions = unit_quaternions(path, values[:, :3], values[:, 3:], notes, lambda row: f"line {numbers[row]}")
    return times, values[:, :3], quaternions, "xyzw" if letters == "xyzw" else "wxyz"


def _read_colmap(path: Path, flags: PoseFlags, unit: str, notes: list[str]) -> Read:
    file = path / "images.bin"
    if file.exists():
        with (
            reading(file, "COLMAP's images.bin"),
            open(file, "rb") as opened,
            mmap(opened.fileno(), 0, access=ACCESS_READ) as content,
        ):
            rows = list(_binary_images(content))
    else:
        file = path / "images.txt"
        lines = _lines(file, "COLMAP's images.txt")
        written = ((number, line) for number, line in lines if not line.startswith("#"))
        rows = []
        for number, line in islice(written, 0, None, 2):  # below each image stands a line of points
            cells = line.split(maxsplit=9)
            if len(cells) != 10:
                expected = "10 were expected: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                raise RecordingError(f"{file}, line {number} has {len(cells)} columns, but {expected}.")
            rows.append((cells[9].strip(), parse_numbers(file, [cells[1:8]], [number])[0]))
    if not rows:
        raise RecordingError(f"{file} holds no images; give the folder of a sparse model with some.")
    names, values = [row[0] for row in rows], np.array([row[1] for row in rows])
    quaternions = unit_quaternions(file, values[:, 4:], values[:, :4], notes, lambda row: f"image {names[row]}")
    return names, values[:, 4:], quaternions, "wxyz"


def _lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """Yields the lines of a text file, with their numbers from 1."""
    with reading(path, expected, LARGEST_TABLE), open(path, encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if number > MOST_ROWS:
                raise RecordingError(
                    f"{path} has more than {MOST_ROWS:,} lines, but {expected} of at most so many was expected; give a "
                    "part of it."
                )
            yield number, line


def _binary_images(content: mmap) -> Iterator[tuple[str, Float64[np.ndarray, "7"]]]:
    """Yields name, quaternion wxyz and translation of each image of images.bin."""
    (count,) = struct.unpack_from("<Q", content)
    if count > MOST_ROWS:
        raise ValueError(f"it states {count:,} images")
    place = 8
    for _ in range(count):
        values = np.array(struct.unpack_from("<7d", content, place + 4))
        end = content.find(b"\0", place + 64, place + 64 + LONGEST_LINE)
        if end < 0:
            raise ValueError(f"the name of an image does not end within {LONGEST_LINE:,} letters")
        (points,) = struct.unpack_from("<Q", content, end + 1)
        yield content[place + 64 : end].decode(), values
        place = end + 9 + 24 * points
    if place != len(content):
        raise ValueError(f"{count} images end at byte {place:,} of {len(content):,}")


def _read_transforms(path: Path, flags: PoseFlags, unit: str, notes: list[str]) -> Read:
    frames = open_json(path)["frames"].values()
    if not frames:
        raise RecordingError(f"{path} holds no frames; give a file with the pose of each image.")
    matrices = np.stack([frame["transform_matrix"].pose() for frame in frames])
    names = [str(frame["file_path"].found) for frame in frames]
    return names, matrices[:, :3, 3], Rotation.from_matrix(matrices[:, :3, :3]).as_quat(), "xyzw"


def _read_bag(path: Path, flags: PoseFlags, unit: str, notes: list[str]) -> Read:
    times, positions, values = read_bag(path, flags.poses_topic, flags.poses_frames, notes)
    return times, positions, unit_quaternions(path, positions, values, notes, lambda row: f"pose {row + 1}"), "xyzw"


def _is_csv(path: Path) -> bool:
    if path.suffix.lower() == ".csv":
        return True
    with open(path, "rb") as file:
        lines = file.read(4096).decode(errors="replace").splitlines()
    return any("," in line for line in lines if line.strip() and not line.startswith("#"))


POSE_FORMATS = (
    PoseFormat(
        name="a ROS bag",
        recognises=lambda path: path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").exists(),
        read=_read_bag,
        without=("poses_unit", *OF_IMAGES),
    ),
    PoseFormat(
        name="a sparse model of COLMAP",
        recognises=Path.is_dir,
        read=_read_colmap,
        without=OF_BAGS,
        direction="world-to-camera",
    ),
    PoseFormat(
        name="transforms.json of Nerfstudio",
        recognises=lambda path: path.suffix.lower() == ".json",
        read=_read_transforms,
        without=(*OF_BAGS, "poses_quaternions"),
        axes="opengl",
    ),
    PoseFormat(name="CSV (EuRoC)", recognises=_is_csv, read=_read_euroc, without=(*OF_BAGS, *OF_IMAGES), unit="ns"),
    PoseFormat(name="text (TUM)", recognises=lambda _: True, read=_read_tum, without=(*OF_BAGS, *OF_IMAGES)),
)
"""All formats; the first that recognises a file reads it."""


def _format_of(path: Path) -> PoseFormat:
    if not path.exists():
        raise RecordingError(
            f"{path} is missing; poses (TUM, EuRoC, COLMAP, transforms.json or a ROS bag) were expected."
        )
    with reading(path, "a file of poses") if path.is_file() else of_file(path):
        return next(format for format in POSE_FORMATS if format.recognises(path))
