"""Frames that lie in a folder in the order of their names, with a table of stamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from enerf_ns.dataparsers.camera import Camera
from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.files import check_image_size, load_array
from enerf_ns.dataparsers.formats.text_tables import read_times
from enerf_ns.dataparsers.recording import Frames
from enerf_ns.dataparsers.trajectory import Trajectory


def read_frames(
    files: Sequence[Path], stamps_file: Path, camera: Camera, trajectory: Trajectory, depth_files: Sequence[Path] = ()
) -> Frames | None:
    """Frames of one camera; of images and depth maps, only the headers are read.

    Args:
        files: Images in order of time.
        stamps_file: Beside them, one time (ns) a line.
        camera: Of all of them.
        trajectory: Of this camera.
        depth_files: .npy, one for each frame, or none.

    Returns:
        None where there are neither images nor stamps.

    Raises:
        RecordingError: There are not as many stamps or depth maps as images, or one of them cannot be read or is of
            another size than the camera's.
    """
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
    return Frames(tuple(files), times, camera, trajectory, tuple(depth_files) or None)
