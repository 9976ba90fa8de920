"""Commands for a recording that a command has written."""

from __future__ import annotations

from pathlib import Path

from enerf_ns.dataparsers.recording.errors import quoted


def print_next(recording: Path, has_poses: bool = True) -> None:
    """Prints the commands that check a recording and, if it has poses, train on it, to be pasted into a shell."""
    print(f"check it: enerf inspect {quoted(recording)}")
    if has_poses:
        print(f"train: ns-train enerf --data {quoted(recording)}")
