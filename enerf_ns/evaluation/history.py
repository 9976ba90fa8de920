"""Error against time of a run, as it is recorded while the run trains: history.jsonl in the run's folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from enerf_ns.dataparsers.files import write_together, write_whole

HISTORY_FILE = "history.jsonl"
"""Name of the file in a run's folder, one `HistoryRow` a line."""


@dataclass(frozen=True)
class HistoryRow:
    """What was known of a run at one moment of its training."""

    step: int
    """Training steps done by then."""
    seconds: float
    """Time spent on training steps by then; evaluation, checkpoints and the viewer excluded."""
    losses: dict[str, float] = field(default_factory=dict)
    """Each term of the last step's loss, with its weight."""
    scores: dict[str, float] = field(default_factory=dict)
    """Scores by name, those that there are of psnr (dB), ssim, lpips, correlation and depth_rmse (metres) over the
    held-out frames looked at, and the `enerf_ns.evaluation.metrics.event_scores` over held-out events."""
    num_frames: int = 0
    """Held-out frames looked at."""
    parts: dict[str, float] = field(default_factory=dict)
    """Seconds of one step by what they were spent on, in the order in which it is done; empty where not measured."""
    final: bool = False
    """Whether this is the end of the run, over all held-out frames."""


def append_row(folder: Path, row: HistoryRow) -> None:
    """Adds a row to the history of the run in a folder, whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    write_together(folder, {}, {HISTORY_FILE: json.dumps(asdict(row)) + "\n"})


def read_history(folder: Path) -> list[HistoryRow]:
    """The rows of the run in a folder, oldest first; none where it has no history. A last line that is still being
    written, or that a full disk or a kill cut short, is left out, as are those after it.

    Raises:
        OSError: The file cannot be read.
    """
    rows: list[HistoryRow] = []
    try:
        lines = (folder / HISTORY_FILE).read_text().splitlines()
    except FileNotFoundError:
        return rows
    for line in lines:
        try:
            rows.append(HistoryRow(**json.loads(line)))
        except (ValueError, TypeError):
            break
    return rows


def cut_history(folder: Path, step: int) -> list[HistoryRow]:
    """Removes the rows after a step, from which a run goes on, and the mark of an end; returns those that stay.

    Raises:
        OSError: The file cannot be written.
    """
    rows = [row for row in read_history(folder) if row.step <= step and not row.final]
    if (folder / HISTORY_FILE).exists():
        write_whole(folder / HISTORY_FILE, "".join(json.dumps(asdict(row)) + "\n" for row in rows))
    return rows
