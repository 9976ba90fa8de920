"""`enerf demo`: simulate, train, score and report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from enerf_ns.dataparsers.recording.errors import printable
from enerf_ns.dataparsers.recording.files import absolute


@dataclass
class Demo:
    """Simulate an event camera, train on its events alone, score the field, and write a report."""

    output_dir: Path = Path("outputs/demo")
    """Folder for the recording, the run and the report."""
    max_num_iterations: int | None = None
    """Number of training steps. Default: that of the method enerf."""

    def main(self) -> None:
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.choices.ranges import check_ranges
        from enerf_ns.dataparsers.formats.registry import check_outside_recordings
        from enerf_ns.method.runs import method_config, train
        from enerf_ns.report.writing import write_report
        from enerf_ns.scripts.simulate import Simulate
        from enerf_ns.simulator.settings import SimulationSettings

        output_dir = absolute(self.output_dir)
        check_outside_recordings("--output-dir", output_dir)
        recording = output_dir / "recording"
        config = method_config("enerf", recording, output_dir / "runs")
        if self.max_num_iterations is not None:
            config.max_num_iterations = self.max_num_iterations
        check_ranges(config)
        if recording.exists():
            print(printable(f"The recording in {recording} is used again; remove it to simulate anew."))
        else:
            Simulate(recording, SimulationSettings("shapes")).main()
        run = train(config)
        CONSOLE.print(write_report([run], output_dir))
        print(printable(f"The report is {output_dir / 'report.html'}"))
