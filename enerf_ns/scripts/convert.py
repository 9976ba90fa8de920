"""`enerf convert`: a recording of any format, or an event file of a camera's maker, in the layout event_recording."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.files import read_json
from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.event_files import EventFile, open_event_file
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.text_tables import read_poses

CONSOLE = Console(width=120)


@dataclass
class Convert:
    """Write a recording, or an event file (Prophesee RAW and DAT, AEDAT4), as a folder in this project's own layout."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a recording in any known format, or event file: .raw (EVT2, EVT2.1, EVT3), .dat or .aedat4."""
    output_dir: Path
    """New folder for the recording."""
    event_camera: Literal["left", "right"] | None = None
    """Of a TUM-VIE recording, which of the two event cameras. None: the left one."""
    poses: Path | None = None
    """For an event file: lines t px py pz qx qy qz qw, on the clock of the file; camera to world, OpenCV axes."""
    poses_unit: Literal["s", "us", "ns"] = "s"
    """Unit of the times in --poses."""
    camera: Path | None = None
    """For an event file: a JSON file with width, height, model, fx, fy, cx, cy and distortion."""

    def main(self) -> None:
        source, output_dir = self.source.expanduser().resolve(), self.output_dir.expanduser().resolve()
        self._check(source, output_dir)
        partial = output_dir.with_name(f".{output_dir.name}.partial-{os.getpid()}")
        try:
            partial.mkdir(parents=True)
            sentences = self._write_file(source, partial) if source.is_file() else self._write_folder(source, partial)
            if output_dir.exists():
                output_dir.rmdir()
            partial.rename(output_dir)
        except OSError as error:
            raise RecordingError(
                f"{output_dir} could not be written ({error}), and nothing was left there; is the disk full?"
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        for sentence in sentences:
            CONSOLE.print(sentence, soft_wrap=True, highlight=False)
        CONSOLE.print(f"The recording is in {output_dir}", soft_wrap=True, highlight=False)

    def _check(self, source: Path, output_dir: Path) -> None:
        if not source.exists():
            raise RecordingError(f"{source} does not exist; give the folder of a recording or an event file.")
        if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())):
            raise RecordingError(
                f"{output_dir} exists already and is not an empty folder; give another --output-dir or move it away."
            )
        if output_dir == source or source in output_dir.parents:
            raise RecordingError(f"{output_dir} lies in the recording, which is only read; give another --output-dir.")
        if source.is_file() and self.event_camera is not None:
            raise RecordingError(f"--event-camera is for folders of TUM-VIE, but {source} is a file; leave it out.")
        for flag, value in (("--poses", self.poses), ("--camera", self.camera)):
            if value is not None and source.is_dir():
                raise RecordingError(f"{flag} is for event files, but {source} is a folder with its own; leave it out.")

    def _write_folder(self, source: Path, folder: Path) -> list[str]:
        """Copies a recording into an empty folder, and says what was found."""
        if self.event_camera is None:
            recording = read_recording(source)
        else:
            recording = read_recording(source, "tum_vie", event_camera=self.event_camera)
        num_events = event_recording.write(recording, folder)
        num_poses = len(recording.trajectory.times)
        num_frames = sum(len(frames.times) for frames in (recording.frames, recording.blurred_frames) if frames)
        sentences = [
            *recording.notes,
            f"{num_events:,} events, {num_poses:,} poses and {num_frames:,} frames are written.",
        ]
        if recording.held_out_frames is not None:
            views = len(recording.held_out_frames.times)
            sentences.insert(0, f"{views:,} held-out views are left out, since they lie on a trajectory of their own.")
        return sentences

    def _write_file(self, source: Path, folder: Path) -> list[str]:
        """Writes the events of a file into an empty folder, and says what is still missing there."""
        file = open_event_file(source)
        sentences: list[str] = []
        camera = self._camera_json(file)
        poses = read_poses(self.poses.expanduser(), self.poses_unit, sentences) if self.poses else None
        event_recording.write_json(folder / "recording.json", {"camera": camera})
        if poses is not None:
            event_recording.write_poses(folder / "poses.txt", poses[0] - file.start, *poses[1:])
        num_events, last = event_recording.write_events(
            file.stream(), folder / "events", camera["width"], camera["height"], lambda i: f"{source}, event {i + 1},"
        )
        if poses is not None and (poses[0][-1] < file.start or poses[0][0] > file.start + last):
            raise RecordingError(
                f"{self.poses} holds poses from {poses[0][0] * 1e-9:.6f} s to {poses[0][-1] * 1e-9:.6f} s, but the "
                f"events of {source} lie from {file.start * 1e-9:.6f} s to {(file.start + last) * 1e-9:.6f} s; give "
                "both on one clock, and the unit of the poses as --poses-unit."
            )
        sentences.append(
            f"{num_events:,} events of {last * 1e-9:.3f} s ({file.encoding}) are written; their time 0, that of the "
            f"first event, is {file.start} ns on the clock of the file."
        )
        missing = ["poses.txt"] * (poses is None)
        missing += ["model, fx, fy, cx, cy and distortion of the camera in recording.json"] * (self.camera is None)
        if missing:
            sentences.append(
                f"Before training, add {' and '.join(missing)}, as README.md shows under “Write a recording yourself”."
            )
        return sentences

    def _camera_json(self, file: EventFile) -> dict:
        """What recording.json is to say about the camera: all of --camera, or the size of the sensor."""
        if self.camera is None:
            if file.size is None:
                raise RecordingError(
                    f"{file.path} does not state the size of its sensor; give a --camera file with width and height."
                )
            return {"width": file.size[0], "height": file.size[1]}
        path = self.camera.expanduser()
        camera = event_recording.parse_camera(path, "camera", read_json(path))
        if file.size not in (None, (camera.width, camera.height)):
            raise RecordingError(
                f"{path} is the calibration of {camera.width} x {camera.height} pixels, but {file.path} states a "
                f"sensor of {file.size[0]} x {file.size[1]}; give the calibration for this resolution."
            )
        return event_recording.camera_json(camera)
