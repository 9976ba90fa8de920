"""Reader for the .npz layout into which Robust e-NeRF converts simulated recordings, TUM-VIE and EDS.

    raw_events.npz              position (N, 2): x y; timestamp (N): ns; polarity (N): true where it became brighter
    camera_poses.npz            T_wc_position (P, 3): metres; T_wc_orientation (P, 4): xyzw; T_wc_timestamp (P): ns;
                                camera to world, OpenCV axes
    camera_calibration.npz      intrinsics (3, 3); distortion_params (0 or 4); distortion_model: plumb_bob (radtan) or
                                equidistant (OpenCV's fisheye); img_width, img_height; pos_contrast_threshold,
                                neg_contrast_threshold; refractory_period: ns; bayer_pattern: such as RGGB, or empty
    views/                      or beside the folder (optional)
        transforms_test.json    or transforms_val.json: camera_angle_x (radians) or intrinsics (3, 3), and frames, each
                                with file_path (mostly without .png) and transform_matrix (4, 4): camera to world,
                                OpenGL axes

Stamps are nanoseconds from the recording's own zero. The views are rendered from places beside the path of the event
camera, and have no stamps; they serve for evaluation. Training views and depth maps in views/ are not read.

Low and Lee, "Robust e-NeRF: NeRF from sparse & noisy events under non-uniform motion", ICCV 2023;
https://github.com/wengflow/robust-e-nerf.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from enerf_ns.dataparsers.formats.columns import check_lengths, check_times
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.npz_arrays import EXPECTED, Form, StoredArray, load_arrays, open_arrays
from enerf_ns.dataparsers.formats.robust_enerf import (
    checked_camera,
    checked_trajectory,
    read_views,
    whole_nanoseconds,
)
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import of_file, reading
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("raw_events.npz", "camera_poses.npz", "camera_calibration.npz")


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    events_file, poses_file, calibration_file = (folder / name for name in FILES)
    trajectory = _read_trajectory(poses_file, notes)
    camera, contrast_thresholds, refractory_period, bayer_pattern = _read_calibration(calibration_file)
    with ExitStack() as stack:
        num_events = len(_open_events(events_file, stack)[1])
    views = read_views(folder, notes)
    with of_file(calibration_file):
        return EventRecording(
            path=folder,
            format="esim_npz",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(events_file, num_events),
            event_files=(events_file,),
            held_out_frames=views,
            contrast_thresholds=contrast_thresholds,
            refractory_period=refractory_period,
            bayer_pattern=bayer_pattern,
            notes=tuple(notes),
            num_events=num_events,
            times_in={"events": (events_file, "ns"), "poses": (poses_file, "ns")},
        )


def _read_trajectory(path: Path, notes: list[str]) -> Trajectory:
    forms = {
        "T_wc_timestamp": ("integers", (None,)),
        "T_wc_position": ("numbers", (None, 3)),
        "T_wc_orientation": ("numbers", (None, 4)),
    }
    times, positions, quaternions = load_arrays(path, forms)
    check_lengths(path, {"times": len(times), "positions": len(positions), "orientations": len(quaternions)})
    check_times(path, times)
    return checked_trajectory(
        path, times.astype(np.int64), positions.astype(np.float64), quaternions.astype(np.float64), notes
    )


def _read_calibration(path: Path) -> tuple[Camera, tuple[float, float], int, str | None]:
    names = ("img_width", "img_height", "pos_contrast_threshold", "neg_contrast_threshold", "refractory_period")
    forms = {
        **{name: ("numbers", ()) for name in names},
        "intrinsics": ("numbers", (3, 3)),
        "distortion_params": ("numbers", (None,)),
        "distortion_model": ("text", ()),
        "bayer_pattern": ("text", ()),
    }
    *scalars, matrix, distortion, model, pattern = load_arrays(path, forms)
    width, height, on, off, refractory_period = (float(scalar) for scalar in scalars)
    model, pattern = (_text(text) for text in (model, pattern))
    camera = checked_camera(path, width, height, matrix, model, distortion)
    return camera, (on, off), whole_nanoseconds(path, refractory_period), pattern or None


def _text(array: np.ndarray) -> str:
    text = array.item()
    return text.decode(errors="replace") if isinstance(text, bytes) else text


def _open_events(path: Path, stack: ExitStack) -> tuple[StoredArray, StoredArray, StoredArray]:
    """Returns positions, times and polarities, which stay open until the stack closes."""
    forms: dict[str, Form] = {
        "position": ("integers", (None, 2)),
        "timestamp": ("integers", (None,)),
        "polarity": ("whole numbers or booleans", (None,)),
    }
    position, time, polarity = open_arrays(path, forms, stack)
    check_lengths(path, {"positions": len(position), "timestamps": len(time), "polarities": len(polarity)})
    if len(time) == 0:
        raise RecordingError(f"{path} holds no events; give a recording with some.")
    if position.by_column:
        raise RecordingError(
            f"{path} holds position column by column (Fortran order), which cannot be read in pieces; save "
            "numpy.ascontiguousarray(position)."
        )
    return position, time, polarity


def _stream_events(path: Path, num_events: int) -> Iterator[Events]:
    with ExitStack() as stack:
        columns = _open_events(path, stack)
        if len(columns[0]) != num_events:
            raise RecordingError(
                f"{path} held {num_events:,} events and holds {len(columns[0]):,} now; read the recording again."
            )
        for start in range(0, num_events, EVENTS_AT_A_TIME):
            with reading(path, EXPECTED):
                position, time, polarity = (
                    column.rows(min(EVENTS_AT_A_TIME, num_events - start)) for column in columns
                )
            check_times(path, time)
            yield Events(position[:, 0], position[:, 1], time.astype(np.int64), polarity)


FORMAT = Format(
    name="esim_npz",
    command="esim-npz",
    description="Events in the .npz layout of Robust e-NeRF's simulated sequences.",
    files=FILES,
    read=read,
)
