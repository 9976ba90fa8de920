"""Reader of EVIMO2 (version 2), one sequence of one event camera, in its NPZ format.

    <camera>/<category>/<split>/<sequence>/     camera: samsung_mono, left_camera or right_camera
        dataset_events_t.npy                    (n,) or (n, 1) floats: seconds
        dataset_events_xy.npy                   (n, 2) whole numbers: column and row
        dataset_events_p.npy                    (n,) or (n, 1): 0 or 1; of samsung_mono, 1 is darker
        dataset_depth.npz                       depth_0000000017 and so on: (res_y, res_x) uint16, millimetres, 0
                                                without depth; the number is a place in meta['frames'] (optional)
        dataset_info.npz                        K (3, 3), D (4) and meta, a pickled dict, of which are read
            meta['meta']                        fx fy cx cy, k1 k2 k3 k4 p1 p2, res_x res_y, dist_model
            meta['full_trajectory'][i]          about 200 a second: 'cam' and the objects by number, each with 'ts'
                                                (seconds) and 'pos': 't' x y z (metres) and 'q' w x y z; the camera to
                                                the world, objects to the camera
            meta['frames'][i]                   'ts' of a depth map (seconds) and its 'id'

The pickle is read by `plain_pickle`, which runs nothing. The recording's clock is that of the files.

Distortion: `dist_model` is radtan (k1 k2 p1 p2) or equidistant (k1 k2 k3 k4). D holds k1 k2 k3 k4 for both models, so
that it lacks p1 and p2 and is not used. K must agree with `meta`. The data set does not state whether whole numbers are
the centres of pixels. The reader takes them as such, as OpenCV's calibration does.

Direction of the poses: an object that stands still keeps its place in the world only if the poses lead from the camera
to the world. The reader checks that, and names objects that move. Sequences of the category sfm stand still.

Numbers of depth maps: the documents call them the 'id' of a frame, but in a published file they are its place in
meta['frames'], as in the code that wrote it. They are read as places if all are below the number of frames, else as
'id'. `enerf inspect` compares the depth maps with the events.

The instants without Vicon poses are missing in `full_trajectory`, and are gaps of the poses. The world is the pose of
the camera at the start, so that worlds of two cameras differ. The data set does not publish where the frame camera
flea3_7 is mounted, so its frames are not read, and neither are masks and inertial measurements.

Burner, Mitrokhin, Fermüller, Aloimonos, "EVIMO2", 2022; https://better-flow.github.io/evimo/download_evimo_2.html.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import LATEST, check_lengths, unit_quaternions
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.json_values import Value
from enerf_ns.dataparsers.formats.npz_arrays import EXPECTED, load_arrays
from enerf_ns.dataparsers.formats.plain_pickle import loads
from enerf_ns.dataparsers.formats.text_tables import MOST_ROWS
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError, printable, shortened
from enerf_ns.dataparsers.recording.files import LARGEST_ARRAY, check_npy_header, load_array, of_file, reading
from enerf_ns.dataparsers.recording.hdf5_files import load_depth_map
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

INFO, DEPTH = "dataset_info.npz", "dataset_depth.npz"
COLUMNS = {"t": "dataset_events_t.npy", "xy": "dataset_events_xy.npy", "p": "dataset_events_p.npy"}
FILES = (*COLUMNS.values(), INFO)

IS_INVERTED = {"samsung_mono": True, "left_camera": False, "right_camera": False}
"""Whether a polarity of 1 means darker, by the name of the event camera."""

INTRINSICS_TOLERANCE = 1e-3
"""Largest difference between K and `meta`, pixels."""

LARGEST_MOVE = 0.02
"""Farthest that an object seems to move in the world if it stands still, metres. It is half a millimetre in the
published sequences of sfm."""

MOST_INSTANTS = 500
"""Most instants at which the places of objects are compared."""

COARSEST_TIME = 1000
"""Largest step of stored times without a note, nanoseconds."""


@dataclass(frozen=True)
class Evimo2Options(FormatOptions):
    """Options of the reader."""

    event_camera: Literal["samsung_mono", "left_camera", "right_camera"] | None = None
    """The event camera of the folder, if no folder above is named after it. The polarity of samsung_mono is
    inverted."""


def read(
    folder: Path, event_camera: Literal["samsung_mono", "left_camera", "right_camera"] | None = None
) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder of a sequence, with the files that the module describes.
        event_camera: The event camera of the folder. Default: the one after which a folder above is named.

    Raises:
        RecordingError: A file is missing, empty or cannot be used, the name of the event camera is not known, or the
            poses do not lead from the camera to the world.
    """
    notes: list[str] = []
    is_inverted = IS_INVERTED[event_camera or _camera_above(folder)]
    events = _StoredEvents(folder, is_inverted, notes)
    info = folder / INFO
    meta = _read_meta(info)
    camera = _read_camera(info, meta["meta"])
    instants = _read_instants(meta["full_trajectory"])
    times, positions, quaternions = _read_poses(instants, "cam")
    _check_times(info, times)
    quaternions = unit_quaternions(info, positions, quaternions, notes, lambda row: f"pose {row + 1} of the camera")
    _check_still(info, instants, notes)
    trajectory = Trajectory(times, positions, quaternions)
    with of_file(info):
        return EventRecording(
            path=folder,
            format="evimo2",
            camera=camera,
            trajectory=trajectory,
            stream_events=events.stream,
            event_files=tuple(folder / name for name in COLUMNS.values()),
            depth_maps=_read_depth_maps(folder / DEPTH, meta["frames"], camera, trajectory),
            notes=tuple(notes),
            num_events=events.num_events,
            times_in={"events": (folder / COLUMNS["t"], "s"), "poses": (info, "s"), "depth maps": (info, "s")},
        )


def _camera_above(folder: Path) -> str:
    """Returns the name of the event camera that the path of the folder holds."""
    for part in reversed(folder.parts):
        for name in IS_INVERTED:
            if name in part:
                return name
    raise RecordingError(
        f"{folder} lies in no folder {', '.join(IS_INVERTED)}, which would state the polarity of its events; name the "
        "event camera by --event-camera."
    )


class _StoredEvents:
    """The columns of the events, which are read in pieces.

    Args:
        folder: The folder of the files.
        is_inverted: Whether a polarity of 1 means darker.
        notes: Gets a sentence if the times are coarse.
    """

    num_events: int

    def __init__(self, folder: Path, is_inverted: bool, notes: list[str]):
        self._folder, self._is_inverted = folder, is_inverted
        columns = self._open()
        check_lengths(folder, {COLUMNS[name]: len(column) for name, column in columns.items()})
        times = columns["t"]
        self.num_events = len(times)
        if not self.num_events:
            raise RecordingError(f"{folder / COLUMNS['t']} holds no events; give a recording with some.")
        step = float(np.spacing(times[-1])) * 1e9
        if step > COARSEST_TIME:
            notes.append(
                f"The times of the events are stored as {times.dtype}, in steps of {step * 1e-3:.2g} µs at "
                f"{float(times[-1]):.3f} s."
            )

    def stream(self) -> Iterator[Events]:
        columns = self._open()
        if any(len(column) < self.num_events for column in columns.values()):
            raise RecordingError(f"{self._folder} held {self.num_events:,} events and holds fewer now; read it again.")
        for start in range(0, self.num_events, EVENTS_AT_A_TIME):
            stop = min(start + EVENTS_AT_A_TIME, self.num_events)
            seconds, places, polarities = (np.array(column[start:stop]) for column in columns.values())
            times = seconds.astype(np.float64) * 1e9
            self._check("t", seconds, np.abs(times) < LATEST, start, "finite seconds were")
            self._check("p", polarities, (polarities == 0) | (polarities == 1), start, "0 or 1 was")
            bright = polarities != self._is_inverted
            yield Events(places[:, 0], places[:, 1], np.rint(times).astype(np.int64), bright)

    def _open(self) -> dict[str, np.ndarray]:
        """Returns memory maps of t (n,), xy (n, 2) and p (n,)."""
        expected = {"t": ("f", "one number of seconds"), "xy": ("iu", "a column and a row"), "p": ("iub", "0 or 1")}
        columns = {}
        for name, (kinds, words) in expected.items():
            column = load_array(self._folder / COLUMNS[name], mmap_mode="r")
            if name != "xy" and column.ndim == 2 and column.shape[1] == 1:
                column = column[:, 0]
            if column.dtype.kind not in kinds or column.shape[1:] != ((2,) if name == "xy" else ()) or not column.ndim:
                raise RecordingError(
                    f"{self._folder / COLUMNS[name]} holds {column.dtype} of shape {column.shape}, but {words} for "
                    "each event was expected; unpack it again."
                )
            columns[name] = column
        return columns

    def _check(self, name: str, column: np.ndarray, good: np.ndarray, start: int, expected: str) -> None:
        if not good.all():
            bad = int(np.argmin(good))
            raise RecordingError(
                f"{self._folder / COLUMNS[name]}, event {start + bad + 1} holds {column[bad]}, but {expected} "
                "expected; download the file again, since early ones were wrong."
            )


def _read_meta(path: Path) -> Value:
    """Returns the dict meta of `dataset_info.npz`."""
    with reading(path, EXPECTED), ZipFile(path) as archive:
        if "meta.npy" not in archive.namelist():
            raise RecordingError(f"{path} lacks the array meta, which holds the poses; unpack it again.")
        if (size := archive.getinfo("meta.npy").file_size) > LARGEST_ARRAY:
            raise RecordingError(
                f"{path} holds a meta of {size:,} bytes, but at most {LARGEST_ARRAY:,} were expected; give a part of "
                "the recording."
            )
        file = BytesIO(archive.read("meta.npy"))
        check_npy_header(file)
        major, _ = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, _, kind = header(file)
        with of_file(path):
            value = loads(file.read()) if kind.hasobject else None
    if shape != () or not isinstance(value, list) or len(value) != 1 or not isinstance(value[0], dict):
        raise RecordingError(f"{path} holds meta as {kind} of shape {shape}, but one pickled dict was expected.")
    return Value(path, value[0], "meta")


def _read_camera(path: Path, calibration: Value) -> Camera:
    intrinsics = calibration.each("fx", "fy", "cx", "cy")
    model = calibration["dist_model"].choice(("radtan", "equidistant"))
    names = ("k1", "k2", "p1", "p2") if model == "radtan" else ("k1", "k2", "k3", "k4")
    distortion = calibration.each(*names)
    if model == "radtan" and (k3 := calibration.each("k3")[0]):
        distortion.append(k3)
    size = calibration.each("res_x", "res_y")
    matrix, coefficients = load_arrays(path, {"K": ("numbers", (3, 3)), "D": ("numbers", (4,))})
    (fx, fy, cx, cy), stated = intrinsics, calibration.each("k1", "k2", "k3", "k4")
    same = np.allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=0, atol=INTRINSICS_TOLERANCE)
    if not (same and np.allclose(coefficients, stated, rtol=0, atol=1e-6)):
        raise RecordingError(
            f"{path} holds K and D that differ from fx, fy, cx, cy and k1 to k4 in meta['meta'], but the same "
            "calibration was expected in both; unpack it again."
        )
    return calibration.camera(size, intrinsics, distortion, "radtan" if model == "radtan" else "fisheye")


def _read_instants(trajectory: Value) -> list[Value]:
    if isinstance(trajectory.found, list) and len(trajectory.found) > MOST_ROWS:
        raise RecordingError(
            f"{trajectory.path} holds {len(trajectory.found):,} instants in {trajectory.name}, but at most "
            f"{MOST_ROWS:,} were expected; give a part of the recording."
        )
    return trajectory.values()


Poses = tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]
"""Times (ns), positions (metres) and quaternions xyzw of poses."""


def _read_poses(instants: list[Value], name: str) -> Poses:
    """Returns the poses of the camera or of an object at those instants that have one."""
    rows = []
    for instant in instants:
        pose = instant.found.get(name) if isinstance(instant.found, dict) else None
        if pose is None and isinstance(instant.found, dict):
            continue
        try:
            place, turn = pose["pos"]["t"], pose["pos"]["q"]  # type: ignore[index]
            values = pose["ts"], *(place[axis] for axis in "xyz"), *(turn[axis] for axis in "xyzw")  # type: ignore[index]
            row = [float(value) if type(value) in (int, float) else math.nan for value in values]
        except (KeyError, TypeError, OverflowError):
            row = [math.nan]
        if not all(map(math.isfinite, row)):
            raise RecordingError(
                f"{instant.path} holds in {instant.name} no pose of {shortened(printable(name))}, but ts, pos.t x y z "
                "and pos.q w x y z, all finite numbers, were expected; unpack it again."
            )
        rows.append(row)
    values = np.array(rows, dtype=np.float64).reshape(-1, 8)
    times = values[:, 0] * 1e9
    if not (np.abs(times) < LATEST).all():
        raise RecordingError(f"{instants[0].path} holds a pose at {values[:, 0].max():g} s, which is beyond 146 years.")
    return np.rint(times).astype(np.int64), values[:, 1:4], values[:, 4:]


def _check_times(path: Path, times: Int64[np.ndarray, " poses"]) -> None:
    if len(times) < 2:
        raise RecordingError(f"{path} holds {len(times)} poses of the camera, but at least 2 were expected.")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        row = int(late[0]) + 1
        raise RecordingError(
            f"{path}, pose {row + 1} of the camera has the time {times[row] * 1e-9:.6f} s, which is not after that of "
            "the pose before; times must increase."
        )


def _read_depth_maps(path: Path, frames: Value, camera: Camera, trajectory: Trajectory) -> Frames | None:
    """Returns the instants with depth maps; None if there are none."""
    if not path.exists():
        return None
    with reading(path, EXPECTED), ZipFile(path) as archive:
        found = (re.fullmatch(r"depth_(\d{1,20})\.npy", name) for name in archive.namelist())
        names = {int(match[1]): path / match[0].removesuffix(".npy") for match in found if match}
    if not names:
        return None
    instants = frames.values()
    if max(names) < len(instants):
        at = {number: instants[number] for number in names}
    else:
        by_id = {instant["id"].found: instant for instant in instants}
        if missing := sorted(names.keys() - by_id.keys()):
            raise RecordingError(
                f"{path} holds the depth map {names[missing[0]].name}, but {frames.name} holds {len(instants):,} "
                "frames, and none with this number; unpack both again."
            )
        at = {number: by_id[number] for number in names}
    numbers = sorted(names)
    seconds = np.array([float(at[number]["ts"].numbers(())) for number in numbers])
    if not (np.abs(seconds) < LATEST * 1e-9).all() or not (np.diff(seconds) > 0).all():
        raise RecordingError(f"{frames.path} holds times of depth maps in {frames.name} that do not increase.")
    files = tuple(names[number] for number in numbers)
    shape = load_depth_map(files[0]).shape
    if shape != (camera.height, camera.width):
        raise RecordingError(
            f"{path} holds {files[0].name} of shape {shape}, but (res_y, res_x) = {(camera.height, camera.width)} was "
            "expected; unpack it again."
        )
    return Frames(files, np.rint(seconds * 1e9).astype(np.int64), camera, trajectory, files)


def _check_still(path: Path, instants: list[Value], notes: list[str]) -> None:
    """Checks by the places of objects that the poses lead from the camera to the world, and notes objects that move."""
    instants = [
        instant
        for instant in instants[:: max(1, len(instants) // MOST_INSTANTS)]
        if isinstance(instant.found, dict) and "cam" in instant.found
    ]
    names = sorted(
        {name for instant in instants for name in instant.found if isinstance(name, str) and name.isdecimal()}
    )
    moves = {}
    for name in names:
        both = [instant for instant in instants if name in instant.found]
        _, centres, turns = _read_poses(both, "cam")
        _, places, _ = _read_poses(both, name)
        if len(both) > 1 and turns.any(axis=1).all():
            turn = Rotation.from_quat(turns)
            moves[name] = _spread(turn.apply(places) + centres), _spread(turn.inv().apply(places - centres))
    if not moves:
        return
    stated, exchanged = np.median(list(moves.values()), axis=0)
    if stated > LARGEST_MOVE and exchanged < LARGEST_MOVE:
        raise RecordingError(
            f"{path} holds poses by which {len(moves)} objects stand still (within {exchanged * 1e3:.2g} mm) only if "
            "they lead from the world to the camera, but camera to world was expected; invert the poses of cam."
        )
    moving = {name: move for name, (move, _) in moves.items() if move > LARGEST_MOVE}
    if moving:
        which = ", ".join(list(moving)[:6]) + (", ..." if len(moving) > 6 else "")
        notes.append(
            f"{len(moving)} of {len(moves)} objects ({which}) move by up to {max(moving.values()):.2g} m, or are "
            "tracked wrongly, but the method learns a scene that stands still; sequences of the category sfm do."
        )


def _spread(places: Float64[np.ndarray, "instants 3"]) -> float:
    """Returns how far a place is usually from its median, metres; few wrong instants do not count."""
    return float(np.percentile(np.linalg.norm(places - np.median(places, axis=0), axis=1), 90))


FORMAT = Format(
    name="evimo2",
    command="evimo2-events",
    description="Events of one camera of a sequence of EVIMO2 (version 2, NPZ).",
    files=FILES,
    read=read,
    options=Evimo2Options,
)
