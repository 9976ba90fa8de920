"""Reader for the real scenes of E2NeRF, with the raw recording of the DAVIS346 beside the published folder.

    *.aedat4            events and frames, from the original data of the data set
    images/*.jpg        of view i, number 5 i, the blurred frame: every tenth frame of the recording; the others were
                        deblurred for COLMAP and are not read
    poses_bounds.npy    (5 views, 17) rows of LLFF: rows 5 i to 5 i + 4 are poses of view i, at the begin of the
                        exposure and each `STEP` later; and the nearest and the farthest depth

events.pt, which is published beside them, is not read: it counts the events of quarters of exposures, without times.
The poses are from COLMAP on deblurred frames, so that a unit of length is no metre, and the lens counts as without
distortion, with the principal point in the middle. Only exposures have poses; the time between them is a gap.

The exposures are those that the recording states. The reader checks that each is as long as its poses, to
`EXPOSURE_TOLERANCE`, which shows that views and frames belong together.

The synthetic scenes of E2NeRF are refused. Their views were simulated one by one, so that no events lie between them,
and the sum of events from one view to the next is not the change of brightness.

Qi et al., "E2NeRF: Event enhanced neural radiance fields from blurry images", ICCV 2023; github.com/iCVTEAM/E2NeRF.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.event_files import EventFile, open_event_file
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.frame_folders import images_in
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames
from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, files_in, load_array, of_file
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("*.aedat4", "events.pt", "poses_bounds.npy", "transform_train.json", "r_*/v2e-dvs-events.txt")

POSES_OF_A_VIEW, FRAMES_OF_A_VIEW = 5, 10
"""Poses of a view, and frames of the recording from one view to the next."""

STEP = 25_001_000
"""Time between the poses of a view, ns."""

EXPOSURE_TOLERANCE = 10_000_000
"""Largest difference between an exposure and the time that its poses span, ns."""


def read(folder: Path, poses: GivenPoses | None = None) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses in place of poses_bounds.npy, on the clock of the recording.

    Raises:
        RecordingError: A file is missing or cannot be used, or the scene is a synthetic one.
    """
    notes: list[str] = []
    file = open_event_file(_find_recording(folder))
    path = folder / "poses_bounds.npy"
    rows = load_array(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or len(rows) % POSES_OF_A_VIEW:
        raise RecordingError(
            f"{path} holds an array of shape {rows.shape}, but ({POSES_OF_A_VIEW} for each view, 17) was expected."
        )
    if not np.isfinite(rows).all():
        raise RecordingError(f"{path} holds numbers that are not finite; make it again.")
    camera = _camera(path, rows, file)
    exposures = _exposures(file, len(rows) // POSES_OF_A_VIEW)
    files = tuple(image for image in images_in(folder / "images") if image.stem.isdecimal())
    files = tuple(image for image in files if int(image.stem) % POSES_OF_A_VIEW == 0)
    if files and len(files) != len(exposures):
        raise RecordingError(
            f"{folder / 'images'} holds {len(files)} blurred frames (000, 005, ...), but {path.name} poses of "
            f"{len(exposures)} views; give one of each."
        )
    check_image_sizes(files, camera.width, camera.height)
    ends = np.minimum(exposures[:, 1], exposures[:, 0] + STEP * (POSES_OF_A_VIEW - 1))
    durations = ends - exposures[:, 0]
    middles = exposures[:, 0] + durations // 2
    if poses is None:
        times = (exposures[:, :1] + STEP * np.arange(POSES_OF_A_VIEW)).ravel()
        poses_file, unit, pose_rows = path, "ns", (times, *_poses(path, rows))
        notes.append(
            "The poses are from COLMAP, so that a unit of length is no metre, and the lens distortion is not known."
        )
    else:
        named = [NamedFrames(files, middles)] if files else []
        poses_file, unit, pose_rows = poses.path, poses.unit, poses.rows(named, notes)
    zero = int(min(file.start, pose_rows[0][0], exposures[0, 0]))
    trajectory = Trajectory(pose_rows[0] - zero, *pose_rows[1:])
    near, far = float(rows[:, 15].min()), float(rows[:, 16].max())
    frames = None
    if files:
        frames = Frames(files, middles - zero, camera, trajectory, exposures=durations)
    with of_file(path):
        return EventRecording(
            path=folder,
            format="e2nerf",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _shifted(file, file.start - zero),
            event_files=(file.path,),
            zero=zero,
            blurred_frames=frames,
            depth_range=(near, far) if 0 < near < far < np.inf else None,
            notes=tuple(notes),
            times_in={
                "events": (file.path, "us"),
                "poses": (poses_file, unit),
                "blurred frames": (file.path, "us"),
            },
        )


def _shifted(file: EventFile, by: int) -> Iterator[Events]:
    for events in file.stream():
        yield Events(events.x, events.y, events.t + by, events.p)


def _find_recording(folder: Path) -> Path:
    """Returns the .aedat4 file, or raises RecordingError that says what the folder is instead."""
    found = files_in(folder, "*.aedat4")
    if len(found) > 1:
        names = ", ".join(file.name for file in found[:8])
        raise RecordingError(f"{folder} holds {names}, but one .aedat4 file was expected; leave that of the scene.")
    if found:
        return found[0]
    if (folder / "transform_train.json").exists() or files_in(folder, "r_*/v2e-dvs-events.txt"):
        raise RecordingError(
            f"{folder} is a synthetic scene of E2NeRF, whose views were simulated one by one, so that no events lie "
            "between them, but events of a camera that moves through all views were expected; use enerf simulate."
        )
    what = "and events.pt, which counts events without their times" if (folder / "events.pt").exists() else ""
    raise RecordingError(
        f"{folder} holds no .aedat4 file {what or 'with events'}; put the recording of the scene there, from the "
        "original data of E2NeRF."
    )


def _camera(path: Path, rows: Float[np.ndarray, "poses 17"], file: EventFile) -> Camera:
    height, width, focal_length = rows[0, :15].reshape(3, 5)[:, 4].astype(float).tolist()
    if (width, height) != file.size:
        raise RecordingError(
            f"{path} states pictures of {width:g} x {height:g} pixels, but {file.path.name} a sensor of {file.size}; "
            "give both of one scene."
        )
    with of_file(path):
        return Camera(width, height, focal_length, focal_length, (width - 1) / 2, (height - 1) / 2)


def _exposures(file: EventFile, num_views: int) -> Int64[np.ndarray, "views 2"]:
    """Returns begin and end of the exposure of each view, ns on the clock of the recording."""
    path = file.path
    found = np.array([(frame.begin, frame.end) for frame in (file.frames() if file.frames else ())], np.int64)
    needed = FRAMES_OF_A_VIEW * (num_views - 1) + 1
    if len(found) < needed:
        raise RecordingError(
            f"{path} holds {len(found):,} frames, but {num_views} views are every tenth of at least {needed:,}; give "
            "the recording of this scene."
        )
    exposures = found[:needed:FRAMES_OF_A_VIEW]
    span = STEP * (POSES_OF_A_VIEW - 1)
    off = np.abs(exposures[:, 1] - exposures[:, 0] - span)
    if off.max() > EXPOSURE_TOLERANCE:
        view = int(np.argmax(off))
        lasts = (exposures[view, 1] - exposures[view, 0]) * 1e-6
        raise RecordingError(
            f"{path} states an exposure of {lasts:.1f} ms for view {view}, but its poses span {span * 1e-6:.1f} ms, so "
            "that they are not of these frames; give --poses of enerf convert, or the recording of this scene."
        )
    return exposures


def _poses(
    path: Path, rows: Float[np.ndarray, "poses 17"]
) -> tuple[Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]:
    """Returns positions and quaternions, OpenCV axes, of rows of LLFF, whose axes are down, right and backward."""
    matrices = rows[:, :15].reshape(-1, 3, 5).astype(np.float64)
    turns = np.stack([matrices[..., 1], matrices[..., 0], -matrices[..., 2]], axis=-1)
    for number, turn in enumerate(turns):
        try:
            check_rotation(turn)
        except ValueError as error:
            raise RecordingError(f"{path} holds in row {number} a pose whose rotation {error}.") from error
    return matrices[..., 3], Rotation.from_matrix(turns).as_quat()


FORMAT = Format(
    name="e2nerf",
    command="e2nerf-events",
    description="Raw events and blurred frames of E2NeRF's real scenes.",
    files=FILES,
    read=read,
    takes_poses=True,
)
