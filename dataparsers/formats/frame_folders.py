"""Frames that lie in a folder in the order of their names, with a table of stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from enerf_ns.dataparsers.formats.text_tables import parse_numbers, read_rows, read_times
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_size, check_is_folder, load_array, of_file
from enerf_ns.dataparsers.recording.recording import LONGEST_EXPOSURE, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory


def read_frames(
    files: Sequence[Path],
    stamps_file: Path,
    camera: Camera,
    trajectory: Trajectory,
    depth_files: Sequence[Path] = (),
    exposures_file: Path | None = None,
) -> Frames | None:
    """Frames of one camera; of images and depth maps, only the headers are read.

    Args:
        files: Images in order of time.
        stamps_file: Beside them, one time (ns) a line.
        camera: Of all of them.
        trajectory: Of this camera.
        depth_files: .npy, one for each frame, or none.
        exposures_file: One exposure (ns) a line, in the order of the stamps; may be missing.

    Returns:
        None where there are neither images nor stamps.

    Raises:
        RecordingError: There are not as many stamps, exposures or depth maps as images, or one of them cannot be read,
            is of another size than the camera's, or is no exposure that a frame can have.
    """
    check_is_folder(stamps_file.parent, "a folder of frames")
    if not files and not stamps_file.exists():
        return None
    times = read_times(stamps_file, "ns")
    if len(times) != len(files):
        raise RecordingError(
            f"{stamps_file.parent} holds {len(files)} images, but its {stamps_file.name} holds {len(times)} stamps; "
            "give one each."
        )
    for file in files:
        check_image_size(file, camera.width, camera.height)
    if depth_files and len(depth_files) != len(files):
        raise RecordingError(
            f"{depth_files[0].parent} holds {len(depth_files)} depth maps, but {stamps_file.parent} holds "
            f"{len(files)} images; give one each."
        )
    for file in depth_files:
        shape = load_array(file, mmap_mode="r").shape
        if shape != (camera.height, camera.width):
            raise RecordingError(
                f"{file} holds an array of shape {shape}, but the frames have (height, width) = "
                f"{(camera.height, camera.width)}."
            )
    exposures = None
    if exposures_file is not None and exposures_file.exists():
        rows, numbers = read_rows(exposures_file, "exposure_ns")
        values = parse_numbers(exposures_file, rows, numbers)[:, 0].clip(-LONGEST_EXPOSURE, LONGEST_EXPOSURE)
        exposures = np.copysign(np.ceil(np.abs(values)), values).astype(np.int64)  # a fraction must not become 0
    with of_file(exposures_file or stamps_file):
        return Frames(tuple(files), times, camera, trajectory, tuple(depth_files) or None, exposures)
