"""`enerf report`: scores, error against time, pictures and videos of runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Optional  # tyro reads these annotations on Python 3.10

import tyro

from enerf_ns.dataparsers.recording.errors import printable
from enerf_ns.dataparsers.recording.files import absolute
from enerf_ns.report.scoring import Scoring


@dataclass
class Report:
    """Write scores, error against training time, pictures and videos of runs on one page.

    Runs that are still training, runs that crashed, and runs whose recording is gone are reported as far as possible.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, folders that hold runs, or files config.yml."""
    output_dir: Optional[Path] = None  # noqa: UP045
    """Folder for the report. Default: the folder of the run, or ./report for several runs."""
    reach: Optional[tuple[float, ...]] = None  # noqa: UP045
    """Values of PSNR in dB. The report says after how much training each run reaches them. Default: up to four values
    that a run reaches."""
    video: bool = True
    """Render video.mp4, a flight past the held-out cameras; moving.webp, the recorded path; and mesh.webp, the mesh."""
    scoring: Annotated[Scoring, tyro.conf.arg(name="")] = field(default_factory=Scoring)
    """Scoring of held-out frames. With other values than the defaults, all held-out frames are rendered again."""

    def main(self) -> None:
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.report.run_files import find_runs
        from enerf_ns.report.writing import write_report

        runs = [run for path in self.runs for run in find_runs(path)]
        output_dir = self.output_dir
        if output_dir is None and len(runs) == 1:
            output_dir = runs[0] if runs[0].is_dir() else runs[0].parent
        output_dir = absolute(output_dir or Path("report"))
        scores = write_report(runs, output_dir, self.reach, self.scoring, self.video)
        CONSOLE.print(scores)
        print(printable(f"The report is {output_dir / 'report.html'}"))
