"""One kind of table for reports, benchmarks and checks, and the tables of runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from rich.markup import escape
from rich.table import Table as RichTable

from enerf_ns.evaluation.history import HistoryRow
from enerf_ns.report.figures import AT_END, SCORES
from enerf_ns.report.trade_offs import seconds_to_reach

NONE = "-"
"""Cell without a value."""

MEANINGS = {
    "psnr": "Peak signal-to-noise ratio of renders against held-out frames; higher is better. At 20 dB the root mean "
    "square error is 10 % of white, and at 30 dB 3 %.",
    "ssim": "Structural similarity of renders and held-out frames; 1 is best.",
    "lpips": "Perceptual distance between renders and held-out frames, by AlexNet; 0 is best.",
    "lpips_vgg": "Perceptual distance between renders and held-out frames, by VGG-16; 0 is best.",
    "correlation": "Correlation of render and frame before the brightness of the render is corrected; 1 is best.",
    "depth_rmse": "Root mean square error of rendered depth, over all pixels whose true depth is known; 0 is best. "
    "Plain surfaces cause no events, so their depth is a guess.",
    "depth_rmse_known": "The same error over the pixels where the field is confident of its depth.",
    "depth_known": "Share of the pixels where the field is confident of its depth.",
    "depth_rmse_spread": "The same error after known depth was spread over plain surfaces.",
    "event_correlation": "Correlation between changes of log brightness that are rendered and those that held-out "
    "events measured. At 1 the render explains all changes, and at 0 none. The square is the share of their variance "
    "that is explained. It ignores a wrong scale of brightness. Noise of the sensor keeps it below 1.",
    "event_rmse": "Root mean square difference between rendered and measured changes, in contrast thresholds; 0 is "
    "best, and 1 is the change of one event.",
    "event_sign": "Share of the changes whose rendered sign is the measured one; 1 is best, and 0.5 is chance.",
}
"""Meaning of each score for readers."""

HOW_TO_READ = {SCORES[name]: meaning for name, meaning in MEANINGS.items()}
"""Meaning of each score by its label."""


@dataclass(frozen=True)
class Table:
    """A table that is shown as Markdown, in a terminal, or on a page (`report.html`)."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    """Sentences that explain the table."""
    num_words: int = 1
    """Number of columns, from the left, that hold words; the others hold numbers."""

    def markdown(self) -> str:
        """The table in Markdown, without its title."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
        return "\n".join(f"| {' | '.join(line)} |" for line in cells)

    def rich(self) -> RichTable:
        """The table for the terminal."""
        table = RichTable(title=escape(self.title), caption=escape(self.note), title_justify="left",
                          caption_justify="left")  # fmt: skip
        for number, name in enumerate(self.header):
            table.add_column(escape(name), justify="left" if number < self.num_words else "right")
        for row in self.rows:
            table.add_row(*map(escape, row))
        return table


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows as the text of a CSV file."""
    content = io.StringIO()
    csv.writer(content, lineterminator="\n").writerows(rows)
    return content.getvalue()


def score_cell(name: str, value: object) -> str:
    """A score as text, or `NONE`."""
    return format(value, ".2f" if name == "psnr" else ".3f") if isinstance(value, (int, float)) else NONE


def reach_table(runs: Sequence[tuple[str, Sequence[HistoryRow]]], targets: Sequence[float]) -> Table:
    """Training time after which each run reaches each PSNR (dB)."""
    rows = []
    for name, history in runs:
        cells = []
        for target in targets:
            found = seconds_to_reach(history, "psnr", target)
            not_reached = "not reached" if any("psnr" in row.scores for row in history) else NONE
            cells.append(not_reached if found is None else f"{'at most ' * found[1]}{found[0]:,.3g} s")
        rows.append([name, *cells])
    header = ["run", *(f"{target:g} dB" for target in targets)]
    note = (
        "Training time until the run first has this PSNR, interpolated linearly between two rows of its history. At "
        "most: the first row already has it."
    )
    return Table("Time to reach a PSNR", header, rows, note)


def step_parts(history: Sequence[HistoryRow]) -> dict[str, float]:
    """Seconds of each part of a training step: the median over the rows of a history that measured it."""
    parts = dict.fromkeys(part for row in history for part in row.parts)
    return {part: median(row.parts[part] for row in history if part in row.parts) for part in parts}


def step_table(runs: Sequence[tuple[str, dict[str, float]]]) -> Table:
    """Milliseconds and share of each part of a training step, by run.

    Args:
        runs: Name, and seconds by part.
    """
    parts = list(dict.fromkeys(part for _, seconds in runs for part in seconds))
    rows = []
    for name, seconds in runs:
        total = sum(seconds.values())
        cells = [
            f"{1e3 * seconds[part]:,.3g} ms ({seconds[part] / total:.0%})" if part in seconds and total else NONE
            for part in parts
        ]
        rows.append([name, *cells, f"{1e3 * total:,.3g} ms"])
    return Table(
        "A training step", ["run", *parts, "total"], rows, "Each value is a median over the rows of the history."
    )


def history_csv(runs: Sequence[tuple[str, Sequence[HistoryRow]]]) -> str:
    """All rows of all histories as CSV. The cell of a score or loss that a row lacks is empty."""
    rows = [(name, row) for name, history in runs for row in history]
    optional = ("lpips_vgg", *AT_END)
    scores = [name for name in SCORES if name not in optional or any(name in row.scores for _, row in rows)]
    losses = list(dict.fromkeys(loss for _, row in rows for loss in row.losses))
    lines: list[list[object]] = [["run", "seconds", "step", *scores, "num_frames", *losses]]
    for name, row in rows:
        values = [row.scores.get(score, "") for score in scores]
        terms = [row.losses.get(loss, "") for loss in losses]
        lines.append([name, row.seconds, row.step, *values, row.num_frames, *terms])
    return csv_text(lines)
