"""The history of a run: losses and scores against time, recorded during training in history.jsonl."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from enerf_ns.dataparsers.recording.files import write_together, write_whole

if TYPE_CHECKING:
    from enerf_ns.evaluation.scores import NotScored

HISTORY_FILE = "history.jsonl"
"""Name of the file in the folder of a run, with one `HistoryRow` on each line."""


@dataclass(frozen=True)
class HistoryRow:
    """Losses and scores of a run at one moment of its training."""

    step: int
    """Number of training steps done."""
    seconds: float
    """Time spent on training steps, without evaluation, checkpoints and the viewer."""
    losses: dict[str, float] = field(default_factory=dict)
    """Weighted terms of the loss of the last step, by name."""
    scores: dict[str, float] = field(default_factory=dict)
    """Available scores by name: psnr (dB), ssim, lpips, correlation and depth_rmse (metres) over the scored held-out
    frames, and the `enerf_ns.evaluation.metrics.event_scores` over held-out events. The last row of a run also has the
    other numbers of `enerf_ns.evaluation.scores.summary_scores`."""
    num_frames: int = 0
    """Number of scored held-out frames."""
    parts: dict[str, float] = field(default_factory=dict)
    """Seconds of one step by part, in the order of the step; empty if not measured."""
    final: bool = False
    """Whether this row is the end of the run, scored over all held-out frames."""
    not_scored: NotScored = field(default_factory=dict)
    """Missing scores with their reasons."""
    protocol: str = ""
    """Name of the protocol in `enerf_ns.evaluation.protocols`."""
    verdict: str = ""
    """Sentence of the `enerf_ns.evaluation.verdict` on whether the events are explained; empty without events."""


def append_row(folder: Path, row: HistoryRow) -> None:
    """Appends a row to the history in the folder of a run, whole or not at all, without numbers that are not finite.

    Raises:
        OSError: The file cannot be written.
    """
    write_together(folder, {}, {HISTORY_FILE: json.dumps(asdict(_finite(row))) + "\n"})


def read_history(folder: Path) -> list[HistoryRow]:
    """The rows in the folder of a run, oldest first; empty if there is no history.

    The first line that is no row, and all lines after it, are left out. Such a line is still being written, or was cut
    short by a full disk or a kill.

    Raises:
        OSError: The file cannot be read.
    """
    rows: list[HistoryRow] = []
    try:
        lines = (folder / HISTORY_FILE).read_bytes().splitlines()
    except FileNotFoundError:
        return rows
    for line in lines:
        try:
            rows.append(_finite(HistoryRow(**json.loads(line))))
        except (ValueError, TypeError, AttributeError):  # not text, not JSON, or not a row
            break
    return rows


def _finite(row: HistoryRow) -> HistoryRow:
    """The row without values that are not finite numbers.

    Raises:
        ValueError: The step is not an integer, or the time is not a finite number.
    """

    def is_number(value: object) -> bool:
        return isinstance(value, (int, float)) and math.isfinite(value)

    if not isinstance(row.step, int) or not is_number(row.seconds):
        raise ValueError(f"a row with step {row.step!r} after {row.seconds!r} s")
    numbers = {
        name: {key: value for key, value in getattr(row, name).items() if is_number(value)}
        for name in ("losses", "scores", "parts")
    }
    return replace(row, **numbers)


def cut_history(folder: Path, step: int) -> list[HistoryRow]:
    """Removes the rows after a step, and the row of the end, before a run continues from that step.

    Returns:
        The remaining rows.

    Raises:
        OSError: The file cannot be written.
    """
    rows = [row for row in read_history(folder) if row.step <= step and not row.final]
    if (folder / HISTORY_FILE).exists():
        write_whole(folder / HISTORY_FILE, "".join(json.dumps(asdict(row)) + "\n" for row in rows))
    return rows
