"""`enerf convert`: write a recording of any format, or an event file, in the layout event_recording."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from enerf_ns.dataparsers.formats.conversion import convert_event_file, convert_recording, new_folder, write_recording
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags, RestPoses
from enerf_ns.dataparsers.inspection.pose_search import mend_poses
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, printable
from enerf_ns.dataparsers.recording.files import absolute, expanded
from enerf_ns.scripts.format_options import format_flags, refuse_beside_run
from enerf_ns.scripts.next_steps import print_next


@dataclass
class Convert:
    """Write a recording, or an event file (Prophesee RAW and DAT, AEDAT4), in the format event_recording."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a recording in any known format, or event file: .raw (EVT2, EVT2.1, EVT3), .dat or .aedat4."""
    output_dir: Path
    """New folder for the recording."""
    options: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=format_flags())
    run: Path | None = None
    """Folder or config.yml of a run that was trained on the recording. The new recording has the poses, clocks and
    lens parameters that this run refined. Default: the recording's own."""
    poses: Path | None = None
    """Poses of the event camera, on the clock of its events: text (TUM), CSV (EuRoC), the folder of a sparse model of
    COLMAP, transforms.json of Nerfstudio, or a ROS bag. Default: those of the recording; an event file has none."""
    without_poses: bool = False
    """Write all but the poses of a recording that has none yet, or wrong ones, so that COLMAP can find them for its
    frames. The poses are added to the new recording by --poses."""
    pose_flags: Annotated[PoseFlags, tyro.conf.arg(name="")] = field(default_factory=PoseFlags)
    accept_found: bool = False
    """Search other conventions and another clock of the poses with the events, as enerf inspect does, and write the
    poses that fit."""
    camera: Path | None = None
    """For an event file: JSON file of the camera with width, height, model, fx, fy, cx, cy and distortion."""

    def main(self) -> None:
        source, output_dir = absolute(self.source), absolute(self.output_dir)
        if not source.exists():
            raise RecordingError(f"{source} does not exist; give the folder of a recording or an event file.")
        chosen, poses = self.options.given(), self._given_poses()
        finish = (lambda folder: mend_poses(folder, output_dir)) if self.accept_found else None
        if self.without_poses:
            if source.is_file():
                raise FlagError(f"--without-poses is for folders of recordings, but {source} is a file; leave it out.")
            for flag, value in {"--poses": poses, "--run": self.run, "--accept-found": self.accept_found}.items():
                if value:
                    raise FlagError(f"--without-poses writes no poses, but {flag} states some; leave one of both out.")
        if source.is_file():
            for option in chosen:
                flag = f"--{option.replace('_', '-')}"
                raise FlagError(f"{flag} is for folders of recordings, but {source} is a file; leave it out.")
            if self.run is not None:
                raise FlagError(f"--run is for folders of recordings, but {source} is a file; leave it out.")
            if self.accept_found and (self.poses is None or self.camera is None):
                raise FlagError(f"--accept-found compares poses with {source}; give --poses and --camera, too.")
            sentences = convert_event_file(source, output_dir, poses, self.camera and expanded(self.camera), finish)
        else:
            if self.camera is not None:
                raise FlagError(f"--camera is for event files, but {source} is a folder with its own; leave it out.")
            if self.run is None:
                poses = RestPoses(source) if self.without_poses else poses
                sentences = convert_recording(source, output_dir, poses, finish, **chosen)
            else:
                others = {"poses": self.poses, "accept_found": self.accept_found}
                refuse_beside_run([*chosen, *(name for name, value in others.items() if value)])
                sentences = self._convert_refined(self.run, source, output_dir)
        for sentence in sentences:
            print(printable(sentence))
        print(printable(f"The recording is in {output_dir}"))
        if source.is_dir() or self.camera is not None:
            print_next(output_dir, (output_dir / "poses.txt").exists())

    def _given_poses(self) -> GivenPoses | None:
        """The poses that the user gave.

        Raises:
            FlagError: A flag for poses is given without them.
        """
        given = {option.name: getattr(self.pose_flags, option.name) for option in fields(PoseFlags)}
        paths = {name: expanded(value) for name, value in given.items() if isinstance(value, Path)}
        if self.poses is not None:
            return GivenPoses(expanded(self.poses), replace(self.pose_flags, **paths))
        for option in fields(PoseFlags):
            if given[option.name] != option.default:
                flag = f"--{option.name.replace('_', '-')}"
                raise FlagError(f"{flag} is for poses of --poses, which is not given; give both, or leave it out.")
        return None

    def _convert_refined(self, run: Path, source: Path, output_dir: Path) -> list[str]:
        """Writes the recording with the poses that a run refined, and returns sentences about it."""
        from enerf_ns.report.run_files import refined_recording  # here, since Nerfstudio takes seconds

        refined = refined_recording(run, source)
        with new_folder(source, output_dir) as folder:
            return write_recording(refined, folder)
