"""`enerf bench`: each table of the paper, and further experiments, with one command."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Optional  # tyro reads these annotations on Python 3.10

import tyro
from rich.console import Console

from enerf_ns.bench.settings import BenchSettings
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, printable, quoted

if TYPE_CHECKING:
    from enerf_ns.report.tables import Table

CONSOLE = Console(width=140)


@dataclass
class Bench:
    """Train and score all rows of an experiment, and print their table. Without an experiment, list all experiments."""

    experiment: Annotated[Optional[str], tyro.conf.Positional] = None  # noqa: UP045
    """Name of the experiment. Default: all experiments are listed."""
    settings: Annotated[BenchSettings, tyro.conf.arg(name="")] = field(default_factory=BenchSettings)

    def main(self) -> None:
        if self.experiment is None:
            CONSOLE.print(_experiments().rich())
            return
        from enerf_ns.bench.runner import Bench as Runs
        from enerf_ns.bench.tables import LARGEST_LOSS, changes_since, changes_table, remarks, scores_table

        bench = Runs(self.experiment, self.settings)
        numbers = {cell: number for number, cell in enumerate(bench.cells, 1)}
        results = []
        for cell, result in bench.run():
            name = f"[{numbers[cell]}/{len(numbers)}] {cell.sequence}, {cell.row}, seed {cell.seed}"
            if result is None:
                print(f"{name} …", flush=True)
                continue
            results.append(result)
            outcome = result.get("failure") or f"{result['seconds']:.0f} s, {result['steps']} steps"
            print(printable(f"{name}: {outcome}"), flush=True)
        table = bench.results(results)
        CONSOLE.print(scores_table(table).rich())
        for remark in remarks(table):
            print(printable(f"* {remark}"))
        where = bench.output_dir / self.experiment
        drawn = ", error against time in .png" if where.with_suffix(".png").exists() else ""
        print(printable(f"The table is in {where}.md, .json and .csv{drawn}"))
        later = f"--output-dir NEW --against {quoted(where.with_suffix('.json'))}"
        print(printable(f"compare later results with it: {bench.command(of_machine=True)} {later}"))
        if bench.before is not None:
            changes = changes_since(table, bench.before)
            CONSOLE.print(changes_table(changes, str(self.settings.against)).rich())
            lost = [f"{change.sequence}, {change.row}" for change in changes if change.loses]
            if lost or not changes:
                what = f"{'; '.join(lost)} lost more than {LARGEST_LOSS:g} dB" if lost else "No row is in both tables"
                raise FlagError(f"{what} against {self.settings.against}.")
        failed = sum("failure" in result for result in results)
        if failed:
            raise RecordingError(f"{failed} of {len(results)} trainings failed, for the reasons above.")


def _experiments() -> Table:
    """The experiments, with the number of trainings that each takes."""
    from enerf_ns.bench.experiments import EXPERIMENTS
    from enerf_ns.report.tables import Table

    rows = []
    for name, experiment in EXPERIMENTS.items():
        recordings = "simulated" if experiment.sequences else ""
        if experiment.recorded:
            recordings = f"{recordings}, or --data" if recordings else "--data"
        trainings = len(experiment.rows) * len(experiment.sequences or experiment.recorded)
        rows.append([name, experiment.sentence, str(trainings), recordings])
    note = "Each training takes its --budget (default: 120 s) and some time for scores. Sequences are simulated once."
    return Table("enerf bench EXPERIMENT", ["experiment", "compares", "trainings", "recordings"], rows, note, 4)
