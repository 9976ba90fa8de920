"""Commands for a recording that a command has written."""

from __future__ import annotations

from pathlib import Path

from enerf_ns.dataparsers.recording.errors import quoted


def print_next(recording: Path) -> None:
    """Prints the commands that check a recording and train on it, to be pasted into a shell."""
    print(f"check it: enerf inspect {quoted(recording)}")
    print(f"train: ns-train enerf --data {quoted(recording)}")
