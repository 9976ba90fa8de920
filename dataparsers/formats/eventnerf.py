"""Reader of EventNeRF's sequences, synthetic and real, and of the variant of their folders that E-3DGS has.

    train/pose/r_00000.txt ...          16 numbers for each view, 4 x 4 row by row: camera to world, OpenCV axes
    train/intrinsics/r_00000.txt ...    16 numbers, 4 x 4, or 20, whose last row is k1 k2 0 0; for each view the same
    train/events/NAME.npz               x, y, t, p of one length: column, row, time, polarity
    train/rgb/r_00000.png ...           a picture of each view (optional)
    validation/ or test/                pose, intrinsics and rgb of other views (optional)

E-3DGS has these files in place of those above:

    train/pose/N_..._T.txt              T is the time of the view in the unit of t; "usable" and "start" are no poses
    train/intrinsics/intrinsics.txt     4 x 4, beside radial_distortion.txt
    train/intrinsics/color_mask_undistorted.png    colour filter of the events after undistortion
    train/events/*undistort*.npz        the events that are read, if there are several files
    train/pose_NAME/                    other poses with the names of those in train/pose, as --pose-set asks for:
                                        perturbed, or deg=0.3_cm=2 as its tool for noise names them
    validation/rgb/000000.png ...       the picture of the view N

What the files do not state is known from the loaders of both projects:

* The sensor has 346 x 260 pixels with a colour filter RGGB. Pictures, where there are some, state the size instead.
* The unit of t is arbitrary. N views are evenly spaced from t = 0 to the largest t, unless their names state times. The
  reader lets one step between views last 1 ms, unless --duration-s states a time. Refractory periods and delays that
  are measured are in these units. The reader refuses events that do not fill the time of the views.
* The synthetic streams may begin with a burst of events, which EventNeRF's training leaves out. If the first view has
  far more events than the others, the poses begin at the second view.
* Principal points count from the corner of the first pixel. A pixel at (x, y) = ((u - cx) / fx, (v - cy) / fy) sees in
  the direction (x / d, y / d, 1) with d = 1 + k1 r^2 + k2 r^4. No model of OpenCV describes this, so the camera is a
  table. E-3DGS's events are undistorted already.
* Pictures are gamma-encoded: linear brightness is their value to the power 2.2.
* The unit of length is arbitrary: all cameras lie within a sphere of radius 1 around the origin, as a note checks.

Rudnev, Elgharib, Theobalt, Golyanik, "EventNeRF: Neural radiance fields from a single colour event camera", CVPR 2023;
Zahid, Rudnev, Ilg, Golyanik, "E-3DGS: Event-based novel view rendering of large-scale scenes using 3D Gaussian
splatting", 3DV 2025.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import LATEST, check_lengths, unit_quaternions
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in
from enerf_ns.dataparsers.formats.npz_arrays import EXPECTED, Form, StoredArray, open_arrays
from enerf_ns.dataparsers.formats.robust_enerf import checked_camera
from enerf_ns.dataparsers.formats.text_tables import parse_numbers
from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import (
    check_image_sizes,
    check_is_folder,
    files_in,
    image_size,
    load_image,
    of_file,
    read_text,
    reading,
)
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("train*/pose/*.txt", "train*/events/*.npz", "train*/intrinsics/*.txt")

SENSOR = 346, 260
"""Width and height of the sensor in pixels, which no file states."""

BAYER_PATTERN = "RGGB"
GAMMA = 2.2
"""Exponent that makes the pictures linear."""

VIEW_STEP = 1_000_000
"""Time from view to view (ns), if no flag states the duration."""

LARGEST_VIEW = 2**14
"""Most bytes of the text of a pose or of intrinsics."""

MOST_VIEWS = 2**17
"""Most views of a folder."""

SAME_INTRINSICS = 1e-4
"""Largest difference between the intrinsics of two views, as a share of the focal length."""

BURST_RATIO = 20
"""Least ratio between the events of the first step and those of a usual step for a burst."""

MOST_IN_FIRST_STEP = 0.5
"""Largest share of the events in the first step between views."""

LEAST_OVERLAP = 0.5
"""Least share of the time of the views that events fill."""

HELD_OUT_SPLITS = ("validation", "test")


@dataclass(frozen=True)
class EventNerfOptions(FormatOptions):
    """Options of the reader."""

    split: Optional[str] = None  # noqa: UP045 - tyro reads these annotations on Python 3.10
    """Folder with events and views to train on, such as train1. None: train, or the only folder train*."""
    pose_set: Optional[str] = None  # noqa: UP045
    """Name of the poses that are read, such as perturbed for train/pose_perturbed. None: those in train/pose."""
    duration_s: Optional[float] = None  # noqa: UP045
    """Time from the first view to the last, seconds. None: 1 ms from view to view, since the files have no unit."""


def read(
    folder: Path, split: str | None = None, pose_set: str | None = None, duration_s: float | None = None
) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder of a scene, with the files that the module describes.
        split: Name of the folder with the events.
        pose_set: Name of other poses of that split; views that are held out keep theirs.
        duration_s: Time from the first view to the last, seconds.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
        FlagError: There is no such split or set of poses, or the duration is not above 0.
    """
    notes: list[str] = []
    views = folder / _split(folder, split)
    pose_files, numbers = _pose_files(_pose_folder(views, pose_set))
    poses = np.stack([_read_pose(file) for file in pose_files])
    events_file = _events_file(views / "events", notes)
    num_events, span = _survey_times(events_file)
    times, ns_per_unit = _view_times(pose_files, numbers, events_file, span, duration_s)
    images = images_in(views / "rgb")
    kept = _without_burst(events_file, num_events, times, ns_per_unit, notes)
    positions = poses[kept:, :3, 3]
    rotations = Rotation.from_matrix(poses[kept:, :3, :3]).as_quat()
    quaternions = unit_quaternions(
        pose_files[0].parent, positions, rotations, notes, lambda row: pose_files[kept + row].name
    )
    trajectory = Trajectory(times[kept:], positions, quaternions)
    farthest = float(np.linalg.norm(positions, axis=1).max())
    if farthest > 1.0:
        notes.append(
            f"Cameras lie up to {farthest:.3g} from the origin, but EventNeRF scales scenes to cameras within 1, so "
            "the unit of length is another one."
        )
    held_out_images = [(name, images_in(folder / name / "rgb")) for name in HELD_OUT_SPLITS]
    all_images = [*images, *(file for _, files in held_out_images for file in files)]
    camera, bayer_pattern = _read_camera(views, len(pose_files), all_images, notes)
    frames, held_out = None, None
    if images:
        matched = _matched(images, pose_files, views)
        check_image_sizes(images, camera.width, camera.height)
        chosen = np.array([view for view in matched if view >= kept], dtype=np.int64)
        files = tuple(file for file, view in zip(images, matched, strict=True) if view >= kept)
        if len(files):
            frames = Frames(files, times[chosen], camera, trajectory, gamma=GAMMA)
            _note_transparency(files[0], notes)
    else:
        held_out = _read_held_out(folder, held_out_images, camera, notes)
    return EventRecording(
        path=folder,
        format="eventnerf",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(events_file, num_events, ns_per_unit),
        event_files=(events_file,),
        frames=frames,
        held_out_frames=held_out,
        bayer_pattern=bayer_pattern,
        notes=tuple(notes),
        num_events=num_events,
        times_in={
            "events": (events_file, "ns"),
            "poses": (pose_files[0].parent, "ns"),
            "frames": (views / "rgb", "ns"),
        },
    )


def _split(folder: Path, stated: str | None) -> str:
    found = [path.parent.name for path in files_in(folder, "*/events") if path.is_dir()]
    if stated is not None:
        if stated not in found:
            raise FlagError(
                f"--split {stated} is none of the folders of {folder} with events; give one of {', '.join(found)}."
                if found
                else f"--split {stated} needs a folder {folder / stated} with events, but none has events/."
            )
        return stated
    trained = [name for name in found if name.startswith("train")]
    if "train" not in trained and len(trained) != 1:
        raise RecordingError(
            f"{folder} holds {', '.join(trained) or 'no folder train/'} with events, but one was expected; name the "
            "folder with --split."
        )
    return "train" if "train" in trained else trained[0]


def _pose_folder(views: Path, pose_set: str | None) -> Path:
    if pose_set is None:
        return views / "pose"
    known = [path.name.removeprefix("pose_") for path in files_in(views, "pose_*") if path.is_dir()]
    if pose_set not in known:
        raise FlagError(
            f"--pose-set {pose_set} asks for pose_{pose_set}, which {views} lacks; "
            + (f"give one of {', '.join(known)}, or leave it out." if known else "leave it out.")
        )
    return views / f"pose_{pose_set}"


def _pose_files(folder: Path) -> tuple[list[Path], list[int] | None]:
    """Returns the files of the poses in order of time, and the last number of each name, if all names have one."""
    check_is_folder(folder, "a folder of poses")
    files = [file for file in files_in(folder, "*.txt") if not {"usable", "start"} & set(re.split(r"[_.]", file.name))]
    if not 2 <= len(files) <= MOST_VIEWS:
        raise RecordingError(f"{folder} holds {len(files):,} poses (.txt), but from 2 to {MOST_VIEWS:,} were expected.")
    last = [re.search(r"(\d{1,18})$", file.stem) for file in files]
    if not all(last):
        return files, None
    numbers = [int(found[1]) for found in last if found]
    order = np.argsort(numbers, kind="stable").tolist()
    for one, other in pairwise(order):
        if numbers[one] == numbers[other]:
            raise RecordingError(f"{files[one]} and {files[other].name} have the same number; give one pose for each.")
    return [files[i] for i in order], [numbers[i] for i in order]


def _read_numbers(path: Path, counts: Sequence[int], expected: str) -> Float64[np.ndarray, " numbers"]:
    text = read_text(path, expected, LARGEST_VIEW)
    cells = [(cell, number) for number, line in enumerate(text.splitlines(), 1) for cell in line.split()]
    if len(cells) not in counts:
        raise RecordingError(f"{path} holds {len(cells)} numbers, but {expected} was expected.")
    return parse_numbers(path, [[cell] for cell, _ in cells], [number for _, number in cells])[:, 0]


def _read_pose(path: Path) -> Float64[np.ndarray, "4 4"]:
    pose = _read_numbers(path, (16,), "a pose of 4 x 4 numbers").reshape(4, 4)
    try:
        check_rotation(pose[:3, :3])
    except ValueError as error:
        raise RecordingError(
            f"{path} holds a pose whose upper left 3 x 3 part {error}; camera to world was expected."
        ) from error
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise RecordingError(f"{path} holds a pose whose last row is {pose[3].tolist()}, but 0 0 0 1 was expected.")
    return pose


def _read_camera(views: Path, num_views: int, images: Sequence[Path], notes: list[str]) -> tuple[Camera, str | None]:
    """Returns the camera of all views, and the Bayer pattern of the events."""
    folder = views / "intrinsics"
    check_is_folder(folder, "a folder of intrinsics")
    expected = "a matrix of 4 x 4 numbers, with or without k1 k2 0 0,"
    files = files_in(folder, "*.txt")
    one = folder / "intrinsics.txt"
    is_undistorted = one in files
    if is_undistorted:
        files = [one]
    elif len(files) not in (1, num_views):
        raise RecordingError(
            f"{folder} holds {len(files):,} files of intrinsics (.txt), but one for each of {num_views:,} poses was "
            "expected."
        )
    every = [np.pad(values, (0, 20 - len(values))) for values in (_read_numbers(f, (16, 20), expected) for f in files)]
    first = every[0]
    for file, values in zip(files, every, strict=True):
        if np.abs(values - first).max() > SAME_INTRINSICS * abs(first[0]):
            raise RecordingError(
                f"{file} holds other intrinsics than {files[0].name}, but those of one camera were expected."
            )
    width, height = image_size(images[0]) if images else SENSOR
    matrix, (k1, k2, *rest) = first[:16].reshape(4, 4)[:3, :3].copy(), first[16:]
    if any(rest) or (first[[3, 7, 11, 12, 13, 14]] != 0).any() or first[15] != 1:
        raise RecordingError(
            f"{files[0]} holds {first.tolist()}, but fx 0 cx 0, 0 fy cy 0, 0 0 1 0, 0 0 0 1 and perhaps k1 k2 0 0 were "
            "expected."
        )
    matrix[:2, 2] -= 0.5
    camera = checked_camera(files[0], width, height, matrix, "", np.zeros(0))
    if k1 or k2:
        with of_file(files[0]):
            camera = _with_distortion(camera, k1, k2)
    pattern: str | None = BAYER_PATTERN
    if is_undistorted:
        lens = folder / "radial_distortion.txt"
        if lens.exists():
            notes.append(f"{lens.name} is not used, since the events of E-3DGS are undistorted.")
        pattern = _pattern_of_mask(folder / "color_mask_undistorted.png", notes)
    return camera, pattern


def _with_distortion(camera: Camera, k1: float, k2: float) -> Camera:
    """Returns the camera whose pixels see along EventNeRF's distorted rays.

    Raises:
        ValueError: The directions of the pixels do not increase along rows and columns.
    """
    directions = camera.pixel_directions()[..., :2]
    squares = np.sum(directions**2, axis=-1, keepdims=True)
    with np.errstate(all="ignore"):
        directions = directions / (1 + k1 * squares + k2 * squares**2)
    increases = np.diff(directions[..., 0], axis=1).min() > 0 and np.diff(directions[..., 1], axis=0).min() > 0
    if not increases:
        raise ValueError(f"the distortion k1 = {k1:g} and k2 = {k2:g}, which fits no lens")
    return replace(camera, model="lookup", directions=directions)


def _pattern_of_mask(path: Path, notes: list[str]) -> str | None:
    """Returns RGGB if there is no mask of colours or the mask states it; else None, which is grey."""
    if not path.exists():
        return BAYER_PATTERN
    mask = load_image(path) != 0
    expected = np.zeros((*mask.shape[:2], 3), bool)
    for (row, column), channel in zip(((0, 0), (0, 1), (1, 0), (1, 1)), (0, 1, 1, 2), strict=True):
        expected[row::2, column::2, channel] = True
    if mask.shape == expected.shape and any(np.array_equal(mask[..., ::step], expected) for step in (1, -1)):
        return BAYER_PATTERN
    notes.append(
        f"{path.name} states no RGGB pattern, since undistortion moved the pixels of the colour filter; the events are "
        "read as those of a grey sensor."
    )
    return None


def _events_file(folder: Path, notes: list[str]) -> Path:
    check_is_folder(folder, "a folder of events")
    files = files_in(folder, "*.npz")
    undistorted = [file for file in files if "undistort" in file.name]
    chosen = files if len(files) == 1 else undistorted
    if len(chosen) != 1:
        raise RecordingError(
            f"{folder} holds {len(files)} files .npz, of which {len(undistorted)} have undistort in their names, but "
            "one file of events was expected; take the others out."
        )
    if len(files) > 1:
        notes.append(f"Of {len(files)} files of events, the undistorted ones of {chosen[0].name} are read.")
    return chosen[0]


def _open_events(path: Path, stack: ExitStack, names: str = "xytp") -> dict[str, StoredArray]:
    forms: dict[str, Form] = {name: ("numbers or booleans" if name == "p" else "numbers", (None,)) for name in names}
    columns = dict(zip(names, open_arrays(path, forms, stack), strict=True))
    check_lengths(path, {name: len(column) for name, column in columns.items()})
    if not len(columns["t"]):
        raise RecordingError(f"{path} holds no events; give a recording with some.")
    return columns


def _time_pieces(path: Path) -> Iterator[Float64[np.ndarray, " events"]]:
    with ExitStack() as stack:
        column = _open_events(path, stack, "t")["t"]
        for start in range(0, len(column), EVENTS_AT_A_TIME):
            with reading(path, EXPECTED):
                times = column.rows(min(EVENTS_AT_A_TIME, len(column) - start)).astype(np.float64)
            good = np.isfinite(times)
            if not good.all():
                bad = int(np.argmin(good))
                raise RecordingError(
                    f"{path}, event {start + bad + 1} holds t = {times[bad]}, but a number was expected."
                )
            yield times


def _survey_times(path: Path) -> tuple[int, tuple[float, float]]:
    """Returns the number of events, and the least and the largest time in the file."""
    with ExitStack() as stack:
        num_events = len(_open_events(path, stack)["t"])
    extremes = np.array([(piece.min(), piece.max()) for piece in _time_pieces(path)])
    return num_events, (float(extremes[:, 0].min()), float(extremes[:, 1].max()))


def _view_times(
    pose_files: Sequence[Path],
    numbers: list[int] | None,
    events_file: Path,
    span: tuple[float, float],
    duration_s: float | None,
) -> tuple[np.ndarray, float]:
    """Returns the time of each view (ns), and the length of a unit of the events' times (ns)."""
    first, last = span
    folder, steps = pose_files[0].parent, np.arange(len(pose_files))
    if duration_s is not None and not 0 < duration_s < 1e9:
        raise FlagError(f"--duration-s {duration_s:g} is no time; give a number of seconds above 0.")
    duration = VIEW_STEP * (len(steps) - 1) if duration_s is None else round(duration_s * 1e9)
    if numbers is None or numbers[-1] - numbers[0] == len(numbers) - 1:
        if last <= 0 or last - first < LEAST_OVERLAP * last:
            raise RecordingError(
                f"{events_file} holds times from {first:g} to {last:g}, but times from about 0 on were expected, since "
                "the views are spread from 0 to the last one; subtract the time of the first view."
            )
        return np.rint(steps * (duration / steps[-1])).astype(np.int64), duration / last
    stated = np.array(numbers, np.float64)
    overlap = min(last, stated[-1]) - max(first, stated[0])
    if overlap < LEAST_OVERLAP * (stated[-1] - stated[0]):
        raise RecordingError(
            f"{folder} holds poses whose names end in {numbers[0]} to {numbers[-1]}, which are times unless they count "
            f"by 1, but the events of {events_file.name} lie from {first:g} to {last:g}; give all poses, and events in "
            "the unit of their names."
        )
    ns_per_unit = duration / (stated[-1] - stated[0])
    times = np.rint(stated * ns_per_unit)
    if times[-1] >= LATEST or (np.diff(times) <= 0).any():
        raise RecordingError(f"{folder} holds poses whose names state times that are too close; give one at each time.")
    return times.astype(np.int64), ns_per_unit


def _without_burst(path: Path, num_events: int, times: np.ndarray, ns_per_unit: float, notes: list[str]) -> int:
    """Returns the number of views to leave out at the start: 1 if the stream begins with a burst, else 0."""
    end, count = times[1] / ns_per_unit, 0
    for piece in _time_pieces(path):
        count += int(np.count_nonzero(piece < end))
        if piece[-1] >= end:
            break
    share = count / num_events
    if len(times) > 2 and share > MOST_IN_FIRST_STEP:
        raise RecordingError(
            f"{path} holds {count:,} of {num_events:,} events before the second of {len(times):,} views, but events "
            "during all views were expected; give times from 0 on, and the poses of the whole stream."
        )
    usual = (num_events - count) / max(len(times) - 2, 1)
    if len(times) < 4 or count <= BURST_RATIO * usual:
        return 0
    notes.append(
        f"The stream begins with a burst: {count:,} of {num_events:,} events lie before the second view, and "
        f"{usual:,.0f} between other views; the poses begin at the second view."
    )
    return 1


def _matched(images: Sequence[Path], pose_files: Sequence[Path], views: Path) -> list[int]:
    """Returns the number of the view of each image, increasing."""
    if len(images) == len(pose_files):
        return list(range(len(images)))
    names = [re.findall(r"\d+", file.stem) for file in pose_files]
    if not all(len(found) > 1 for found in names):  # as in EventNeRF
        check_one_each(views / "rgb", len(images), pose_files[0].parent, len(pose_files), "poses")
    by_number = {int(found[0]): view for view, found in enumerate(names)}
    matched = []
    for image in images:
        found = re.search(r"\d+", image.stem)
        view = by_number.get(int(found[0])) if found else None
        if view is None:
            raise RecordingError(
                f"{image} is the picture of no view, whose number begins the name of a pose; remove it."
            )
        matched.append(view)
    if sorted(set(matched)) != matched:
        raise RecordingError(f"{views / 'rgb'} holds several pictures of one view, or in another order than the poses.")
    return matched


def _note_transparency(image: Path, notes: list[str]) -> None:
    with reading(image, "an image"), Image.open(image) as opened:
        if opened.mode in ("LA", "RGBA"):
            notes.append(
                "The pictures are transparent and laid over white; events show the background of the renderer."
            )


def _read_held_out(
    folder: Path, splits: Sequence[tuple[str, Sequence[Path]]], camera: Camera, notes: list[str]
) -> Frames | None:
    """Returns the views of the first split with pictures, at times 0 s, 1 s, 2 s ... of their own clock."""
    name, images = next(((name, images) for name, images in splits if len(images) > 1), ("", ()))
    if not images:
        return None
    views = folder / name
    pose_files, _ = _pose_files(views / "pose")
    matched = _matched(images, pose_files, views)
    check_image_sizes(images, camera.width, camera.height)
    poses = np.stack([_read_pose(pose_files[view]) for view in matched])
    times = np.arange(len(images), dtype=np.int64) * 10**9
    trajectory = Trajectory(times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat())
    _note_transparency(images[0], notes)
    return Frames(tuple(images), times, camera, trajectory, gamma=GAMMA)


def _stream_events(path: Path, num_events: int, ns_per_unit: float) -> Iterator[Events]:
    with ExitStack() as stack:
        columns = _open_events(path, stack)
        if len(columns["t"]) != num_events:
            raise RecordingError(
                f"{path} held {num_events:,} events and holds {len(columns['t']):,} now; read the recording again."
            )
        for start in range(0, num_events, EVENTS_AT_A_TIME):
            with reading(path, EXPECTED):
                pieces = {
                    name: column.rows(min(EVENTS_AT_A_TIME, num_events - start)) for name, column in columns.items()
                }
            yield _events(path, pieces, start, ns_per_unit)


def _events(path: Path, pieces: dict[str, np.ndarray], start: int, ns_per_unit: float) -> Events:
    """Returns the events of columns of any type of numbers; `start` is the number of the first one in the file."""
    t = np.rint(pieces["t"].astype(np.float64) * ns_per_unit)
    whole = {name: pieces[name] for name in "xyp"}
    good = {name: (abs(c.astype(np.float64)) < 2**31) & (c == np.rint(c)) for name, c in whole.items()}
    good["t"] = abs(t) < LATEST
    for name, is_good in good.items():
        if not is_good.all():
            bad = int(np.argmin(is_good))
            expected = "a time during the views" if name == "t" else "a whole number"
            raise RecordingError(
                f"{path}, event {start + bad + 1} holds {name} = {pieces[name][bad]:g}, where {expected} was expected."
            )
    x, y, p = (whole[name].astype(np.int32) for name in "xyp")
    return Events(x, y, t.astype(np.int64), p)


FORMAT = Format(
    name="eventnerf",
    command="eventnerf-events",
    description="Events in the folders of EventNeRF's scenes, or of E-3DGS.",
    files=FILES,
    read=read,
    options=EventNerfOptions,
)
