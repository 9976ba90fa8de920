"""`enerf check-numerics`: extreme cases, each against a closed form, float64 or another library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.progress import track
from rich.table import Table

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.files import write_together

if TYPE_CHECKING:
    from enerf_ns.bench.numerics.case import Result


@dataclass
class CheckNumerics:
    """Check that numbers hold at the extremes: one line a case, what is expected, the error, pass or fail."""

    output_dir: Path | None = None
    """Folder for numerics.md and numerics.json. None: they are not written."""

    def main(self) -> None:
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.bench.numerics.all_cases import CASES
        from enerf_ns.bench.numerics.case import as_json, as_markdown, run
        from enerf_ns.dataparsers.formats.registry import check_outside_recordings

        if self.output_dir is not None:
            check_outside_recordings("--output-dir", self.output_dir)
        results = [run(case) for case in track(CASES, "Checking", console=CONSOLE, transient=True)]
        CONSOLE.print(results_table(results))
        if self.output_dir is not None:
            files = {"numerics.md": as_markdown(results).encode(), "numerics.json": as_json(results).encode()}
            try:
                write_together(self.output_dir, files)
            except OSError as error:
                raise OutputError(
                    f"--output-dir {self.output_dir} could not be written to ({error.strerror}); give another folder."
                ) from error
        failed = [result.name for result in results if not result.passed]
        if failed:
            raise SystemExit(f"enerf: {len(failed)} of {len(results)} cases fail: {'; '.join(failed)}.")


def results_table(results: list[Result]) -> Table:
    """The results for the terminal."""
    from enerf_ns.bench.numerics.case import shown

    seconds = sum(result.seconds for result in results)
    table = Table(
        title="Numbers at the extremes", title_justify="left", caption=f"{len(results)} cases, {seconds:.0f} s"
    )
    for column in ("case", "expected", "error", "at most", ""):
        table.add_column(column)
    for result in results:
        error = result.failure if result.error is None else shown(result.error, result.unit)
        verdict = "[green]pass[/green]" if result.passed else "[red]fail[/red]"
        bound = shown(result.bound, result.unit)
        table.add_row(escape(result.name), escape(result.expected), escape(error), bound, verdict)
    return table
