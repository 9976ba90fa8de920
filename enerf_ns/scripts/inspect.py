"""`enerf inspect`: contents and problems of a recording, in the terminal and as a page of pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from enerf_ns.dataparsers.formats.event_recording import rest_poses
from enerf_ns.dataparsers.formats.registry import check_outside_recordings, read_recording
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.errors import OutputError, printable, quoted
from enerf_ns.dataparsers.recording.files import absolute, write_whole
from enerf_ns.scripts.format_options import format_flags, refuse_beside_run

CONSOLE = Console(width=120)


@dataclass
class Inspect:
    """Check a recording before training: print its contents and problems, and write a page of pictures."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of the recording. Nothing is written into it. One that enerf convert wrote without poses serves as
    well."""
    output: Path | None = None
    """HTML file for the pictures. Default: inspect-NAME.html in the current folder, where NAME is the recording's."""
    options: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=format_flags())
    run: Path | None = None
    """Folder or config.yml of a run that was trained on the recording. Clock, poses and lens are those that this run
    refined, and the page compares them with the recording's own. Default: the recording's own alone."""

    def main(self) -> None:
        data = absolute(self.data)
        output = absolute(self.output or Path(f"inspect-{data.name}.html"))
        if output.is_dir():
            raise OutputError(f"--output {output} is a folder; give the name of an HTML file.")
        check_outside_recordings("--output", output, data)
        corrections, chosen = None, self.options.given()
        if self.run is None:
            recording = read_recording(data, poses=rest_poses(data), **chosen)
        else:
            refuse_beside_run(chosen)
            from enerf_ns.report.pose_figure import corrections_over_time  # here, since Nerfstudio takes seconds
            from enerf_ns.report.run_files import refined_recording

            recording = refined_recording(self.run, data)
            if recording.as_read is None:
                print(
                    printable(
                        f"{self.run} corrected neither clock nor poses nor lens; they are those of the recording."
                    )
                )
            corrections = corrections_over_time(recording)
        inspection = Inspection.of(recording)
        inspection.print_tables(CONSOLE)
        page = inspection.page(corrections)
        try:
            write_whole(output, page)
        except OSError as error:
            reason = f"could not be written ({error.strerror})"
            raise OutputError(f"--output {output} {reason}; give another file.") from error
        print(printable(f"Pictures are in {output}"))
        if not recording.has_poses:
            print("Before training, add poses, as docs/tutorial-poses.md shows.")
        elif not chosen and self.run is None:
            print(f"train: ns-train enerf --data {quoted(data)}")
