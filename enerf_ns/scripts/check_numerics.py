"""`enerf check-numerics`: extreme cases, each compared with a closed form, float64 or another library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.progress import track

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.files import write_together


@dataclass
class CheckNumerics:
    """Compute extreme cases, and print for each the expected result, the error, its bound, and pass or FAIL."""

    output_dir: Path | None = None
    """Folder for numerics.md and numerics.json. Default: the files are not written."""

    def main(self) -> None:
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.bench.numerics.all_cases import CASES
        from enerf_ns.bench.numerics.case import as_json, as_table, run
        from enerf_ns.dataparsers.formats.registry import check_outside_recordings

        if self.output_dir is not None:
            check_outside_recordings("--output-dir", self.output_dir)
        results = [run(case) for case in track(CASES, "Checking", console=CONSOLE, transient=True)]
        table = as_table(results)
        CONSOLE.print(table.rich())
        if self.output_dir is not None:
            files = {"numerics.md": f"{table.markdown()}\n".encode(), "numerics.json": as_json(results).encode()}
            try:
                write_together(self.output_dir, files)
            except OSError as error:
                raise OutputError(
                    f"--output-dir {self.output_dir} could not be written to ({error.strerror}); give another folder."
                ) from error
        failed = [result.case.name for result in results if not result.passed]
        if failed:
            raise SystemExit(f"enerf: {len(failed)} of {len(results)} cases fail: {'; '.join(failed)}.")
