"""Error against time of a run, as it is recorded while the run trains: history.jsonl in the run's folder."""

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
    held-out frames looked at, and the `enerf_ns.evaluation.metrics.event_scores` over held-out events; at the end the
    other numbers of `enerf_ns.evaluation.scores.summary_scores` too."""
    num_frames: int = 0
    """Held-out frames looked at."""
    parts: dict[str, float] = field(default_factory=dict)
    """Seconds of one step by what they were spent on, in the order in which it is done; empty where not measured."""
    final: bool = False
    """Whether this is the end of the run, over all held-out frames."""
    not_scored: NotScored = field(default_factory=dict)
    """What has no score, and why."""
    protocol: str = ""
    """How frames, or events where there are none, are scored: a name of `enerf_ns.evaluation.protocols`."""


def append_row(folder: Path, row: HistoryRow) -> None:
    """Adds a row to the history of the run in a folder, whole or not at all; numbers that are not finite are left out.

    Raises:
        OSError: It cannot be written.
    """
    write_together(folder, {}, {HISTORY_FILE: json.dumps(asdict(_finite(row))) + "\n"})


def read_history(folder: Path) -> list[HistoryRow]:
    """The rows of the run in a folder, oldest first; none where it has no history. The first line that is no row, such
    as one that is still being written, or that a full disk or a kill cut short, is left out, as are those after it.

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
        except (ValueError, TypeError, AttributeError):  # no text or no JSON, or another thing than a row
            break
    return rows


def _finite(row: HistoryRow) -> HistoryRow:
    """The row without what is no finite number.

    Raises:
        ValueError: Its step or its time is none.
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
    """Removes the rows after a step, from which a run goes on, and the mark of an end; returns those that stay.

    Raises:
        OSError: The file cannot be written.
    """
    rows = [row for row in read_history(folder) if row.step <= step and not row.final]
    if (folder / HISTORY_FILE).exists():
        write_whole(folder / HISTORY_FILE, "".join(json.dumps(asdict(row)) + "\n" for row in rows))
    return rows
