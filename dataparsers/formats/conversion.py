"""Converts recordings of any format, and event files of camera makers, into the layout event_recording."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.event_files import EventFile, open_event_file
from enerf_ns.dataparsers.formats.json_values import open_json
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames
from enerf_ns.dataparsers.formats.registry import check_outside_recordings, read_recording
from enerf_ns.dataparsers.formats.writer import camera_json, encode_json
from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import encode_png, partial_of, write_whole
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.time_units import Times, check_units

Finish = Callable[[Path], list[str]]
"""Function that is called with a folder that was written, before it gets its name, and returns sentences about it."""


def convert_recording(
    source: Path, output_dir: Path, poses: GivenPoses | None = None, finish: Finish | None = None, **options: object
) -> list[str]:
    """Copies all events, poses, frames and depth of a recording into a new folder of the layout event_recording.

    Args:
        source: Folder of a recording of any registered format; it is only read.
        output_dir: New or empty folder. After an error it is as before.
        poses: Poses in place of those of the recording. Those of a camera at rest are not written.
        finish: Changes poses.txt in the new folder.
        options: Options of the format, by name.

    Returns:
        Sentences that state what was written and what was left out.

    Raises:
        RecordingError: The recording cannot be used.
        FlagError: The format lacks an option.
        OutputError: The folder holds something, lies in the recording, or cannot be written.
    """
    with new_folder(source, output_dir) as folder:
        recording = read_recording(source, poses=poses, **options)  # type: ignore[arg-type]
        sentences = write_recording(recording, folder)
        return sentences + (finish(folder) if finish else [])


def write_recording(recording: EventRecording, folder: Path) -> list[str]:
    """Writes a recording as `event_recording.write` does.

    Args:
        recording, folder: As there.

    Returns:
        Sentences that state what was written and what was left out.
    """
    num_events = event_recording.write(recording, folder)
    num_poses = len(recording.trajectory.times) if recording.has_poses else 0
    num_frames = sum(len(frames.times) for frames in (recording.frames, recording.blurred_frames) if frames)
    sentences = [
        *recording.notes,
        f"{num_events:,} events, {num_poses:,} poses and {num_frames:,} frames are written.",
    ]
    if recording.held_out_frames is not None:
        views = len(recording.held_out_frames.times)
        sentences.insert(0, f"{views:,} held-out views are left out, since they lie on a trajectory of their own.")
    if recording.zero:
        sentences.insert(0, f"Time 0 of the new recording is {recording.zero} ns on the clock of the files.")
    if recording.depth_maps is not None:
        maps = len(recording.depth_maps.times)
        sentences.insert(0, f"{maps:,} depth maps are left out, since the layout holds those at the times of frames.")
    if not recording.has_poses:
        sentences.append(
            "Before training, add poses. docs/tutorial-poses.md shows how COLMAP finds them for frames, and how "
            "`enerf convert` adds them to the new recording."
        )
    return sentences


def convert_event_file(
    source: Path,
    output_dir: Path,
    poses: GivenPoses | None = None,
    camera: Path | None = None,
    finish: Finish | None = None,
) -> list[str]:
    """Writes events and frames of a file, with poses and camera if given, into a folder of the layout event_recording.

    Args:
        source: .raw (EVT2, EVT2.1, EVT3), .dat or .aedat4; it is only read.
        output_dir: New or empty folder. After an error it is as before.
        poses: Poses on the clock of the event file.
        camera: JSON file with width, height, model, fx, fy, cx, cy and distortion.
        finish: Changes poses.txt in the new folder.

    Returns:
        Sentences that state what was written, and what must be added before training.

    Raises:
        RecordingError: A file cannot be used, or they do not fit together.
        OutputError: The folder holds something or cannot be written.
    """
    sentences: list[str] = []
    with new_folder(source, output_dir) as folder:
        file = open_event_file(source)
        about = _camera_json(file, camera)
        write_whole(folder / "recording.json", encode_json({"camera": about}))
        frames = _write_frames(file, folder / "frames", about["width"], about["height"], sentences)
        rows = poses.rows([frames], sentences) if poses is not None else None
        if rows is not None:
            event_recording.write_poses(folder / "poses.txt", rows[0] - file.start, *rows[1:])
        num_events, _, last = event_recording.write_events(
            file.stream(), folder / "events", about["width"], about["height"], lambda i: f"{source}, event {i + 1},"
        )
        if rows is not None and poses is not None:
            pixels = about["width"] * about["height"]
            events = Times.of_events(source, "us", num_events, last, pixels, is_certain=True)
            check_units(source, [events, Times.of_rows("poses", poses.path, poses.unit, rows[0], "--poses-unit")])
        if poses and rows and (rows[0][-1] < file.start or rows[0][0] > file.start + last):
            raise RecordingError(
                f"{poses.path} holds poses from {rows[0][0] * 1e-9:.6f} s to {rows[0][-1] * 1e-9:.6f} s, but the "
                f"events of {source} lie from {file.start * 1e-9:.6f} s to {(file.start + last) * 1e-9:.6f} s; give "
                "both on one clock, by --poses-delay-ms, and the unit of the poses as --poses-unit."
            )
        if finish is not None:
            sentences += finish(folder)
    sentences.append(
        f"{num_events:,} events of {last * 1e-9:.3f} s ({file.encoding}) are written; their time 0, that of the first "
        f"event, is {file.start} ns on the clock of the file."
    )
    sentences += file.notes
    missing = ["poses.txt"] * (poses is None)
    missing += ["model, fx, fy, cx, cy and distortion of the camera in recording.json"] * (camera is None)
    if missing:
        sentences.append(
            f"Before training, add {' and '.join(missing)}, as docs/formats.md shows (“Write a recording yourself”)."
        )
    return sentences


def _write_frames(file: EventFile, folder: Path, width: int, height: int, sentences: list[str]) -> NamedFrames:
    """Writes the frames of a file, with the table of their times, and adds a sentence on those that are left out.

    Returns:
        Their pictures, with times on the clock of the file.

    Raises:
        RecordingError: The file is damaged, or a frame goes back in time.
        OSError: The disk is full.
    """
    pictures: list[Path] = []
    times: list[int] = []
    exposures: list[int] = []
    num_others, last = 0, None
    for frame in file.frames() if file.frames is not None else ():
        if frame.pixels.shape[:2] != (height, width):
            num_others += 1
            continue
        middle = (frame.begin + frame.end) // 2
        if last is not None and middle <= last:
            raise RecordingError(
                f"{file.path} holds a frame at {middle} ns after one at {last} ns, but frames must be in time order; "
                "record it again."
            )
        last = middle
        folder.mkdir(exist_ok=True)
        pictures.append(folder / f"{len(pictures):05d}.png")
        pictures[-1].write_bytes(encode_png(frame.pixels))
        times.append(middle)
        exposures.append(frame.end - frame.begin)
    if times:
        stamps = [time - file.start for time in times]
        (folder / event_recording.STAMPS_NAME).write_text("".join(f"{stamp}\n" for stamp in stamps))
        sentences.append(f"{len(times):,} frames are written.")
    if any(exposures):
        (folder / event_recording.EXPOSURES_NAME).write_text("".join(f"{exposure}\n" for exposure in exposures))
    if num_others:
        total, sensor = num_others + len(times), f"sensor's {width} x {height} pixels"
        sentences.append(f"{num_others:,} of {total:,} frames are left out, since they are not of the {sensor}.")
    return NamedFrames(pictures, np.array(times, np.int64))


def _camera_json(file: EventFile, path: Path | None) -> dict[str, Any]:
    """Returns the camera for recording.json: the content of the file, or only the size of the sensor."""
    if path is None:
        if file.size is None:
            raise RecordingError(
                f"{file.path} does not state the size of its sensor; give a --camera file with width, height, model, "
                "fx, fy, cx and cy."
            )
        return {"width": file.size[0], "height": file.size[1]}
    camera = event_recording.parse_camera(open_json(path))
    if file.size not in (None, (camera.width, camera.height)):
        raise RecordingError(
            f"{path} is the calibration of {camera.width} x {camera.height} pixels, but {file.path} states a sensor of "
            f"{file.size[0]} x {file.size[1]}; give the calibration for this resolution."
        )
    return camera_json(camera)


def _check_is_free(output_dir: Path) -> None:
    """Raises OutputError if there is a file, or a folder with content."""
    if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())):
        raise OutputError(
            f"{output_dir} exists already and is not an empty folder; give another --output-dir or move it away."
        )


@contextmanager
def new_folder(source: Path, output_dir: Path) -> Iterator[Path]:
    """Yields a temporary folder, which becomes the output at the end of the block if no error occurs.

    Raises:
        OutputError: The output holds something, lies in the source, is a mount point, or cannot be written.
    """
    output_dir = output_dir.resolve() if output_dir.is_symlink() else output_dir
    check_outside_recordings("--output-dir", output_dir, source)
    if output_dir.is_mount():
        raise OutputError(
            f"{output_dir} is a mount point, which no new folder can replace; give a folder in it as --output-dir, "
            f"such as {output_dir / 'recording'}."
        )
    _check_is_free(output_dir)
    partial = partial_of(output_dir)
    try:
        partial.mkdir(parents=True)
        yield partial
        _check_is_free(output_dir)  # another command may have written it meanwhile
        if output_dir.exists():
            output_dir.rmdir()
        partial.rename(output_dir)
    except OSError as error:
        refused = partial if error.filename is None else Path(os.fsdecode(error.filename))
        if not (refused.is_relative_to(partial) or partial.is_relative_to(refused) or refused == output_dir):
            raise  # what is read
        raise OutputError(
            f"{output_dir} could not be written ({error.strerror}), and nothing was left there; make room, or give "
            "another --output-dir."
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
