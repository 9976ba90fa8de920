"""Reader of poses of LLFF with events.h5: Ev-DeblurNeRF (CDAVIS, Blender), Gen3-HandHeld and Gen3-DroneFlight.

    images_1/00.png ...          pictures without distortion, blurred and sharp ones
    images_1/timestamps.npz      timestamps, timestamps_start, timestamps_end (N): µs; start = end if it is sharp
    events.h5                    x, y, t, p at the root; µs, or ns in the Blender scenes; x and y may be floats
    poses_bounds.npy             (N, 17) of each picture: R | t | height width focal, row by row; two bounds of depth
    all_poses_bounds.npy         (M, 17), the same along the whole path
    all_timestamps.npy           (M,) of that path: µs
    ev_map.npz                   inv_mapx, inv_mapy (height, width): place of each pixel of the sensor in the pictures,
                                 only in CDAVIS, whose sensor has a colour filter RGGB
    K.yaml                       intrinsics of the pictures, only in Gen3
    NAME_poses_bounds.npy        other poses, with all_NAME_poses_bounds.npy and perhaps all_NAME_timestamps.npy, as
                                 --pose-set asks for: uslam and refined of Gen3, rot0.2_tran0.02 and others of Blender

The columns of R point down, right and back; poses are camera to world. Without K.yaml, the focal length is that of the
first row, and the principal point is the middle of the picture, counted from the corner of the first pixel.

The files leave the following open, and this is how it is decided:

* The unit of events is µs or ns, whichever makes events and poses overlap longer.
* Events with floats in x and y were moved to the places that the lens of the pictures shows. With ev_map.npz, they are
  the pixels of the sensor. Otherwise each pair of x and y is a pixel, as in the loader of the authors. The pixels get
  numbers in rows and columns in the order of their places. The direction of each is exact, from its place.
* Sharp pictures are held out for evaluation, with the poses in poses_bounds.npy. The blurred ones are frames to train
  on, whose poses are those of the whole path; a note tells if the poses of the pictures are far from them.
* The unit of length is that of the files.
* The loader of Gen3's authors does not read K.yaml, so that its keys are not known. It is read as a matrix of 3 x 3
  numbers or as fx fy cx cy, by itself or under K or camera_matrix, whose whole numbers are the centres of pixels, as in
  OpenCV. A note tells if it holds anything else, or if its focal length is far from that of the poses.

Cannici and Scaramuzza, "Mitigating motion blur in neural radiance fields with events and frames", CVPR 2024; Zou
et al., "Event-aided sharp radiance field reconstruction for fast-flying drones", T-RO 2026.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Optional

import numpy as np
import torch
from jaxtyping import Float64, Int64, UInt64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import check_lengths, check_times
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events
from enerf_ns.dataparsers.formats.npz_arrays import open_arrays
from enerf_ns.dataparsers.formats.robust_enerf import checked_trajectory
from enerf_ns.dataparsers.formats.yaml_values import read_yaml
from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, files_in, image_size, load_array, of_file, reading
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events.h5", "poses_bounds.npy", "all_poses_bounds.npy", "all_timestamps.npy", "images_1/timestamps.npz")

MICROSECOND = 1000
"""Unit of all stamps but those of events, ns."""

MOST_PLACES = 4
"""Most different places of events, as a multiple of the number of pixels of a picture."""

SPACINGS = (0.5, 2.0)
"""Least and largest distance between neighbouring places of events, pixels of the pictures."""

SAMPLED_PLACES = 20_000
"""Places whose neighbours are measured."""

FAR_SHARE, FAR_TURN = 0.02, 2.0
"""Distance between the pose of a picture and the path at its stamp that a note states: share of the extent, degrees."""

FAR_FOCAL_LENGTH = 0.02
"""Difference between the focal lengths of K.yaml and of the poses that a note states, as a share."""

BAYER_PATTERN = "RGGB"


@dataclass(frozen=True)
class LlffEventsOptions(FormatOptions):
    """Options of the reader."""

    pose_set: Optional[str] = None  # noqa: UP045 - tyro reads these annotations on Python 3.10
    """Name of the poses that are read, such as uslam for all_uslam_poses_bounds.npy. None: all_poses_bounds.npy."""


def read(folder: Path, pose_set: str | None = None) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Events without ev_map.npz whose coordinates are floats are read once to find their places.

    Args:
        folder: The folder with the files that the module describes.
        pose_set: Name of other poses.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
        FlagError: There are no such poses.
    """
    notes: list[str] = []
    path, stamps_file, own = _files_of_poses(folder, pose_set)
    rows, _, _ = _read_rows(path)
    trajectory = _read_trajectory(path, rows, stamps_file, notes)
    poses, sizes, bounds = _read_rows(folder / "poses_bounds.npy")
    images = images_in(folder / "images_1")
    if not images:
        raise RecordingError(
            f"{folder / 'images_1'} holds no pictures (.png or .jpg), but one for each pose was expected."
        )
    check_one_each(images[0].parent, len(images), folder / "poses_bounds.npy", len(poses), "poses")
    frame_camera = _read_camera(folder / "poses_bounds.npy", images, sizes)
    if (intrinsics := folder / "K.yaml").exists():
        frame_camera = _with_intrinsics(frame_camera, intrinsics, notes)

    events_file = folder / "events.h5"
    events = _open_events(events_file, trajectory)
    camera, find, pattern = _event_camera(folder, events, frame_camera, notes)
    starts, ends = _read_exposures(folder / "images_1/timestamps.npz", len(images))
    zero = min(events.first_time, trajectory.start)
    trajectory = Trajectory(trajectory.times - zero, trajectory.positions, trajectory.quaternions)
    is_sharp = starts == ends
    blurred = _blurred_frames(images, starts - zero, ends - zero, frame_camera, trajectory)
    if blurred is not None:
        of_images = poses if own is None else _read_rows(own)[0]
        if len(of_images) == len(images):
            _compare(of_images[~is_sharp], blurred, own or folder / "poses_bounds.npy", notes)
    near, far = float(bounds[:, 0].min()), float(bounds[:, 1].max())
    with of_file(folder):
        return EventRecording(
            path=folder,
            format="llff_events",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(events, zero, find),
            event_files=(events_file,),
            zero=zero,
            blurred_frames=blurred,
            held_out_frames=_held_out(images, poses, is_sharp, frame_camera, notes),
            bayer_pattern=pattern,
            depth_range=(near, far) if 0 < near < far < np.inf else None,
            notes=tuple(notes),
            num_events=events.num_events,
            times_in={
                "events": (events_file, events.unit),
                "poses": (stamps_file, "us"),
                "blurred frames": (folder / "images_1/timestamps.npz", "us"),
            },
        )


def _files_of_poses(folder: Path, pose_set: str | None) -> tuple[Path, Path, Path | None]:
    """Returns the files of the poses and the stamps of the path, and of other poses of the pictures."""
    plain = folder / "all_timestamps.npy"
    if pose_set is None:
        return folder / "all_poses_bounds.npy", plain, None
    path = folder / f"all_{pose_set}_poses_bounds.npy"
    if not re.fullmatch(r"[\w.+-]+", pose_set) or not path.exists():
        sets = [re.fullmatch(r"all_(.+)_poses_bounds\.npy", file.name) for file in files_in(folder, "all_*")]
        known = ", ".join(found[1] for found in sets if found)
        raise FlagError(
            f"--pose-set {pose_set} asks for {path.name}, which {folder} lacks; "
            + (f"give one of {known}, or leave it out." if known else "leave it out.")
        )
    count = len(load_array(path, mmap_mode="r"))
    stated = folder / f"all_{pose_set}_timestamps.npy"
    others = [file for file in (folder / "all_uslam_timestamps.npy", plain) if file.exists()]
    fitting = [file for file in others if len(load_array(file, mmap_mode="r")) == count]
    stamps = stated if stated.exists() else next(iter(fitting), plain)
    own = folder / f"{pose_set}_poses_bounds.npy"
    return path, stamps, own if own.exists() else None


def _read_rows(
    path: Path,
) -> tuple[Float64[np.ndarray, "poses 3 4"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 2"]]:
    """Returns poses (camera to world, OpenCV axes), height, width and focal length, and bounds of LLFF's rows."""
    rows = load_array(path).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise RecordingError(f"{path} holds an array of shape {rows.shape}, but (N, 17) was expected.")
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise RecordingError(f"{path}, row {np.argmin(finite) + 1} holds a number that is not finite; make it again.")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    axes = matrices[:, :, [1, 0, 2, 3]] * [1.0, 1.0, -1.0, 1.0]
    rotations = axes[:, :, :3]
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    suspects = (errors > 0.5e-3) | (np.linalg.det(rotations) < 0)
    for row in np.flatnonzero(suspects):
        try:
            check_rotation(rotations[row])
        except ValueError as error:
            raise RecordingError(
                f"{path}, row {row + 1} holds a pose whose 3 x 3 part {error}; columns down, right, back were expected."
            ) from error
    return axes, matrices[:, :, 4], rows[:, 15:]


def _read_stamps(path: Path, column: np.ndarray) -> Int64[np.ndarray, " rows"]:
    """Returns stamps in µs, of any type of numbers, in ns."""
    if column.ndim != 1 or column.dtype.kind not in "iuf" or not np.isfinite(column).all():
        raise RecordingError(
            f"{path} holds stamps as {column.dtype} of shape {column.shape}, but one finite number (µs) for each was "
            "expected."
        )
    check_times(path, column, "us")
    if column.dtype.kind == "f":
        return np.rint(column.astype(np.float64) * MICROSECOND).astype(np.int64)
    return column.astype(np.int64) * MICROSECOND


def _read_trajectory(
    path: Path, rows: Float64[np.ndarray, "poses 3 4"], stamps_file: Path, notes: list[str]
) -> Trajectory:
    times = _read_stamps(stamps_file, load_array(stamps_file))
    check_lengths(path, {"poses": len(rows), f"stamps in {stamps_file.name}": len(times)})
    return checked_trajectory(path, times, rows[:, :, 3], Rotation.from_matrix(rows[:, :, :3]).as_quat(), notes)


def _read_camera(path: Path, images: Sequence[Path], sizes: Float64[np.ndarray, "poses 3"]) -> Camera:
    width, height = image_size(images[0])
    check_image_sizes(images, width, height)
    if sizes[0, :2].tolist() != [height, width]:
        raise RecordingError(
            f"{path} states pictures of {sizes[0, 1]:g} x {sizes[0, 0]:g} pixels, but {images[0]} has {width} x "
            f"{height}; give pictures of the size that the focal length is for."
        )
    focal = float(sizes[0, 2])
    with of_file(path):
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _with_intrinsics(camera: Camera, path: Path, notes: list[str]) -> Camera:
    """Returns the camera with the intrinsics in a YAML file, if they can be read and lie within the pictures."""
    try:
        value = read_yaml(path, "intrinsics")[1]
        for key in ("K", "camera_matrix", "data"):
            value = (value.get(key) if isinstance(value.found, dict) else None) or value
        if isinstance(value.found, dict):
            stated = value.each("fx", "fy", "cx", "cy")
        elif isinstance(value.found, list) and len(value.found) == 4:
            stated = value.numbers((4,)).tolist()
        else:
            stated = value.intrinsics()
        found = value.camera((camera.width, camera.height), stated)
    except RecordingError as error:
        notes.append(f"The focal length is that of poses_bounds.npy, since {error}")
        return camera
    if abs(found.fx / camera.fx - 1) > FAR_FOCAL_LENGTH:
        notes.append(
            f"{path.name} states a focal length of {found.fx:.1f} pixels, which is used, and poses_bounds.npy one of "
            f"{camera.fx:.1f}."
        )
    return found


def _open_events(path: Path, trajectory: Trajectory) -> Hdf5Events:
    """Returns the events in the unit in which they and the poses overlap longer; µs if they never do."""
    events = Hdf5Events(path, "ns", floats=True)

    def overlap(factor: int) -> float:
        first, last = events.first_time * factor, events.last_time * factor
        shared = min(last, trajectory.end) - max(first, trajectory.start)
        return max(shared, 0) / max(max(last, trajectory.end) - min(first, trajectory.start), 1)

    return events if overlap(1) > overlap(MICROSECOND) else Hdf5Events(path, "us", floats=True)


Find = Callable[[np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]]
"""Function from x and y of events to their columns and rows; the third argument is the number of the first event."""


def _event_camera(
    folder: Path, events: Hdf5Events, pictures: Camera, notes: list[str]
) -> tuple[Camera, Find, str | None]:
    """Returns the camera of the events, the pixels of events, and the Bayer pattern."""
    path, map_file = events.path, folder / "ev_map.npz"
    if map_file.exists():
        table = _read_map(map_file, pictures)
        rows, columns = np.mgrid[: pictures.height, : pictures.width]
        keys = _keys(table[..., 0].ravel(), table[..., 1].ravel())
        order = np.argsort(keys)
        if (np.diff(keys[order]) == 0).any():
            raise RecordingError(f"{map_file} holds the same place for two pixels, but one for each was expected.")
        cells = np.column_stack([columns.ravel(), rows.ravel()])[order]
        camera = _lookup(map_file, pictures, table.astype(np.float64), (0.0, 0.0), 1.0)
        return camera, _finder(path, keys[order], cells, f"{map_file.name} lacks"), BAYER_PATTERN
    places = _places(events, MOST_PLACES * pictures.width * pictures.height)
    if places is None:
        return pictures, _whole, None
    keys = _keys(places[:, 0], places[:, 1])
    cells, start, spacing, (width, height) = _numbered(path, places.astype(np.float64), pictures)
    rows, columns = np.mgrid[:height, :width]
    table = np.dstack([start[0] + spacing * columns, start[1] + spacing * rows])
    table[cells[:, 1], cells[:, 0]] = places
    camera = _lookup(path, pictures, table, start, spacing)
    notes.append(
        f"The events lie at {len(places):,} places between the pixels of the pictures, which become the pixels of a "
        f"sensor of {width} x {height}."
    )
    order = np.argsort(keys)
    return camera, _finder(path, keys[order], cells[order], "no event had"), None


def _lookup(
    path: Path, pictures: Camera, table: Float64[np.ndarray, "height width 2"], start: Sequence[float], spacing: float
) -> Camera:
    """Returns the camera whose pixels lie at places in the pictures; a regular one has `start` and `spacing`."""
    directions = (table - [pictures.cx, pictures.cy]) / [pictures.fx, pictures.fy]
    height, width = table.shape[:2]
    fx, fy = pictures.fx / spacing, pictures.fy / spacing
    cx, cy = (pictures.cx - start[0]) / spacing, (pictures.cy - start[1]) / spacing
    with of_file(path):
        return Camera(width, height, fx, fy, cx, cy, model="lookup", directions=directions)


def _read_map(path: Path, pictures: Camera) -> np.ndarray:
    """Returns the place (x, y) of each pixel of the sensor in the pictures, float32."""
    size = (pictures.height, pictures.width)
    with ExitStack() as stack:
        arrays = open_arrays(path, {name: ("numbers", size) for name in ("inv_mapx", "inv_mapy")}, stack)
        with reading(path, "an .npz file of NumPy"):
            table = np.dstack([array.whole().astype(np.float32) for array in arrays])
    if not np.isfinite(table).all():
        raise RecordingError(f"{path} holds places that are not finite; copy it again from its source.")
    return table


def _keys(x: np.ndarray, y: np.ndarray) -> UInt64[np.ndarray, " places"]:
    """Returns one number for each pair of float32."""
    bits = [(column.astype(np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64) for column in (x, y)]
    return bits[0] << np.uint64(32) | bits[1]


def _places(events: Hdf5Events, most: int) -> np.ndarray | None:
    """Returns all pairs of x and y of events, float32 [places, 2]; None if all are whole numbers."""
    found, is_whole, count = np.zeros(0, np.uint64), True, 0
    for piece in events.stream(0):
        if piece.x.dtype.kind != "f" and piece.y.dtype.kind != "f":
            return None
        good = np.isfinite(piece.x) & np.isfinite(piece.y)
        if not good.all():
            raise RecordingError(
                f"{events.path}, event {count + int(np.argmin(good)) + 1} holds a place that is not finite; copy it "
                "again from its source."
            )
        count += len(piece)
        is_whole &= bool((piece.x == np.rint(piece.x)).all() and (piece.y == np.rint(piece.y)).all())
        found = np.union1d(found, _keys(piece.x, piece.y))
        if len(found) > most and not is_whole:
            raise RecordingError(
                f"{events.path} holds events at more than {most:,} places, but those of the pixels of one sensor were "
                "expected; give events that are not moved by an estimate of their motion."
            )
    if is_whole:
        return None
    pairs = np.column_stack([found >> np.uint64(32), found & np.uint64(2**32 - 1)]).astype(np.uint32)
    return pairs.view(np.float32)


def _numbered(
    path: Path, places: Float64[np.ndarray, "places 2"], pictures: Camera
) -> tuple[Int64[np.ndarray, "places 2"], tuple[float, float], float, tuple[int, int]]:
    """Returns a pixel (column, row) for each place, none twice, in the order of places along each row.

    Returns:
        The pixels, the place (x, y) of pixel (0, 0), the distance between pixels, and width and height of the sensor.
    """
    tree = KDTree(places)
    sample = places[:: max(len(places) // SAMPLED_PLACES, 1)]
    spacing = float(np.clip(np.median(tree.query(sample, k=2)[0][:, 1]), *SPACINGS)) if len(places) > 1 else 1.0
    low, high = places.min(axis=0), places.max(axis=0)
    if (low < -np.array([pictures.width, pictures.height])).any() or (
        high > 2 * np.array([pictures.width, pictures.height])
    ).any():
        raise RecordingError(
            f"{path} holds events from {low.round(1).tolist()} to {high.round(1).tolist()}, but places within pictures "
            f"of {pictures.width} x {pictures.height} pixels were expected."
        )
    wanted = np.rint((places - low) / spacing).astype(np.int64)
    order = np.lexsort((places[:, 0], wanted[:, 1]))
    rows = wanted[order, 1]
    begins = np.flatnonzero(np.diff(rows, prepend=-1))
    ends = np.append(begins[1:], len(rows))
    width = max(int(wanted[:, 0].max()) + 1, int((ends - begins).max()))
    cells = np.column_stack([np.zeros(len(places), np.int64), wanted[:, 1]])
    for begin, end in zip(begins, ends, strict=True):
        steps = np.arange(end - begin)
        columns = np.maximum.accumulate(wanted[order[begin:end], 0] - steps) + steps
        cells[order[begin:end], 0] = np.minimum(columns, width - len(steps) + steps)
    return cells, (float(low[0]), float(low[1])), spacing, (width, int(wanted[:, 1].max()) + 1)


def _whole(x: np.ndarray, y: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    return (x, y) if x.dtype.kind != "f" and y.dtype.kind != "f" else (x.astype(np.int64), y.astype(np.int64))


def _finder(path: Path, keys: UInt64[np.ndarray, " places"], cells: Int64[np.ndarray, "places 2"], lacks: str) -> Find:
    def find(x: np.ndarray, y: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
        wanted = _keys(x, y)
        places = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
        known = keys[places] == wanted
        if not known.all():
            bad = int(np.argmin(known))
            raise RecordingError(
                f"{path}, event {first + bad + 1} lies at ({x[bad]:g}, {y[bad]:g}), which {lacks}; give the events and "
                "the map of one recording."
            )
        return cells[places, 0], cells[places, 1]

    return find


def _stream_events(events: Hdf5Events, zero: int, find: Find) -> Iterator[Events]:
    first = 0
    for piece in events.stream(zero):
        x, y = find(piece.x, piece.y, first)
        first += len(piece)
        yield replace(piece, x=x, y=y)


def _read_exposures(path: Path, num_images: int) -> tuple[Int64[np.ndarray, " images"], Int64[np.ndarray, " images"]]:
    """Returns first and last instant of the exposure of each picture, ns."""
    names = ("timestamps", "timestamps_start", "timestamps_end")
    with ExitStack() as stack:
        arrays = open_arrays(path, {name: ("numbers", (num_images,)) for name in names}, stack)
        with reading(path, "an .npz file of NumPy"):
            columns = [array.whole() for array in arrays]
    middles, starts, ends = (_read_stamps(path, column) for column in columns)
    wrong = (starts > ends) | ((starts < ends) & ((middles < starts) | (middles > ends)))
    if wrong.any():
        image = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} holds for picture {image + 1} the exposure from {starts[image] // 1000} to {ends[image] // 1000} "
            f"µs with the stamp {middles[image] // 1000} µs, but a stamp between start and end was expected."
        )
    return starts, ends


def _blurred_frames(
    images: Sequence[Path], starts: np.ndarray, ends: np.ndarray, camera: Camera, trajectory: Trajectory
) -> Frames | None:
    chosen = np.flatnonzero(starts < ends)
    if not len(chosen):
        return None
    times = starts[chosen] + (ends - starts)[chosen] // 2
    backwards = np.diff(times) <= 0
    if backwards.any():
        image = images[chosen[int(np.argmax(backwards)) + 1]]
        raise RecordingError(f"{image} is not after the blurred picture before it; give stamps that increase.")
    with of_file(images[0].parent / "timestamps.npz"):
        files = tuple(images[i] for i in chosen)
        return Frames(files, times, camera, trajectory, exposures=(ends - starts)[chosen], numbers=chosen)


def _held_out(
    images: Sequence[Path], poses: np.ndarray, is_sharp: np.ndarray, camera: Camera, notes: list[str]
) -> Frames | None:
    """Returns the sharp pictures, at times 0 s, 1 s, 2 s ... of their own clock."""
    chosen = np.flatnonzero(is_sharp)
    if len(chosen) < 2:
        notes.append(
            f"{len(chosen)} pictures are sharp, by start = end, but at least 2 are needed, so none is held out."
        )
        return None
    times = np.arange(len(chosen), dtype=np.int64) * 10**9
    rotations = Rotation.from_matrix(poses[chosen][:, :, :3]).as_quat()
    trajectory = Trajectory(times, poses[chosen][:, :, 3], rotations)
    return Frames(tuple(images[i] for i in chosen), times, camera, trajectory, numbers=chosen)


def _compare(poses: np.ndarray, frames: Frames, path: Path, notes: list[str]) -> None:
    """Adds a note if the poses of pictures are far from the path at their stamps."""
    inside = frames.trajectory.covers(frames.times)
    if not inside.any():
        return
    of_path = frames.trajectory.poses(torch.from_numpy(frames.times[inside])).numpy()
    shifts = np.linalg.norm(of_path[:, :, 3] - poses[inside][:, :, 3], axis=1)
    one, other = (Rotation.from_matrix(matrices[:, :, :3]) for matrices in (of_path, poses[inside]))
    turns = np.degrees((one.inv() * other).magnitude())
    extent = float(np.linalg.norm(np.ptp(frames.trajectory.positions, axis=0)))
    if shifts.max() > FAR_SHARE * extent or turns.max() > FAR_TURN:
        notes.append(
            f"The poses of blurred pictures in {path.name} are up to {shifts.max():.3g} m and {turns.max():.3g} "
            f"degrees away from the path at their stamps, which spans {extent:.3g} m; poses and stamps may not be "
            "of one clock."
        )


FORMAT = Format(
    name="llff_events",
    command="llff-events",
    description="Events of Ev-DeblurNeRF, Gen3-HandHeld and Gen3-DroneFlight: LLFF with events.h5.",
    files=FILES,
    read=read,
    options=LlffEventsOptions,
)
