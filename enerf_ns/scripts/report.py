"""`enerf report`: error against time, scores, pictures and videos of runs."""

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
    """Scores, error against time, pictures and videos of runs, on one page.

    Of runs that are still going or crashed, and of those whose recording is gone, whatever there is.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or above runs, or files config.yml."""
    output_dir: Optional[Path] = None  # noqa: UP045
    """Folder for the report. None: that of the run; of several, ./report."""
    reach: Optional[tuple[float, ...]] = None  # noqa: UP045
    """PSNR in dB whose training time is told. None: some that the runs reach."""
    video: bool = True
    """Render a flight past the held-out cameras."""
    scoring: Annotated[Scoring, tyro.conf.arg(name="")] = field(default_factory=Scoring)
    """How held-out frames are scored; what is not the default is scored anew."""

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
