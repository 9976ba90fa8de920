"""Reads the frames of a folder, in the order of their names, with the table of their stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from enerf_ns.dataparsers.formats.text_tables import parse_numbers, read_rows, read_times
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, check_is_folder, files_in, load_array, of_file
from enerf_ns.dataparsers.recording.recording import LONGEST_EXPOSURE, Frames
from enerf_ns.dataparsers.recording.time_units import Times, check_units, check_usual_units
from enerf_ns.dataparsers.recording.trajectory import Trajectory


def images_in(folder: Path) -> tuple[Path, ...]:
    """Returns the .png files of a folder in order, or else its .jpg files; none if the folder is missing.

    Raises:
        RecordingError: The place is a file.
    """
    check_is_folder(folder, "a folder of frames")
    return tuple(files_in(folder, "*.png") or files_in(folder, "*.jpg"))


def read_stamps(files: Sequence[Path], stamps_file: Path, unit: str, folder: Path) -> Int64[np.ndarray, " frames"]:
    """Returns the time (ns) of each image from a file with one time in each line.

    Args:
        files: The images.
        stamps_file: The table of times.
        unit: The unit of the times, "s", "us" or "ns".
        folder: The folder of the images, for error messages.

    Raises:
        RecordingError: The table cannot be read, or it does not have one time for each image.
    """
    times = read_times(stamps_file, unit)
    check_one_each(folder, len(files), stamps_file, len(times), "stamps")
    return times


def check_one_each(folder: Path, num_images: int, table: Path, num_rows: int, what: str) -> None:
    """Raises RecordingError unless a table has one row for each image of a folder."""
    if num_images != num_rows:
        name = f"its {table.name}" if table.parent == folder else table
        raise RecordingError(
            f"{folder} holds {num_images:,} images, but {name} holds {num_rows:,} {what}; give one for each image."
        )


def read_frames(
    files: Sequence[Path],
    stamps_file: Path,
    camera: Camera,
    trajectory: Trajectory,
    depth_files: Sequence[Path] = (),
    exposures_file: Path | None = None,
    exposure: int | None = None,
    poses_file: Path | None = None,
) -> Frames | None:
    """Returns the frames of one camera; of images and depth maps, only the headers are read.

    Args:
        files: The images in order of time.
        stamps_file: The table beside them, with one time (ns) in each line.
        camera: The camera of all frames.
        trajectory: The trajectory of this camera.
        depth_files: One .npy file for each frame, or none.
        exposures_file: The table with one exposure (ns) in each line, in the order of the stamps; may be missing.
        exposure: The exposure (ns) of all frames, if there is no such table.
        poses_file: The file of the poses, for error messages. Default: the folder.

    Returns:
        None if there are neither images nor stamps.

    Raises:
        RecordingError: The numbers of stamps, exposures, depth maps and images differ, a file cannot be read, a size is
            not the camera's, an exposure is out of range, or stamps and poses are in different units.
    """
    check_is_folder(stamps_file.parent, "a folder of frames")
    if not files and not stamps_file.exists():
        return None
    times = read_stamps(files, stamps_file, "ns", stamps_file.parent)
    columns = [Times.of_rows("poses", poses_file or stamps_file.parent, "ns", trajectory.times)]
    columns.append(Times.of_rows("frames", stamps_file, "ns", times))
    check_units(stamps_file.parent, columns)
    check_image_sizes(files, camera.width, camera.height)
    if depth_files and len(depth_files) != len(files):
        raise RecordingError(
            f"{depth_files[0].parent} holds {len(depth_files)} depth maps, but {stamps_file.parent} holds "
            f"{len(files)} images; give one for each image."
        )
    for file in depth_files:
        shape = load_array(file, mmap_mode="r").shape
        if shape != (camera.height, camera.width):
            raise RecordingError(
                f"{file} holds an array of shape {shape}, but the frames have (height, width) = "
                f"{(camera.height, camera.width)}."
            )
    exposures = None if exposure is None else np.full(len(times), min(exposure, LONGEST_EXPOSURE))
    if exposures_file is not None and exposures_file.exists():
        rows, numbers = read_rows(exposures_file, "exposure_ns")
        values = parse_numbers(exposures_file, rows, numbers)[:, 0].clip(-LONGEST_EXPOSURE, LONGEST_EXPOSURE)
        exposures = np.copysign(np.ceil(np.abs(values)), values).astype(np.int64)  # a fraction must not become 0
    try:
        return Frames(tuple(files), times, camera, trajectory, tuple(depth_files) or None, exposures)
    except ValueError:
        check_usual_units(stamps_file.parent, columns)
        if exposures_file is None:
            raise
        with of_file(exposures_file):
            raise
