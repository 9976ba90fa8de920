"""`enerf reconstruct`: a recording with frames that a network, or a filter, makes of its events."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.reconstruction.reconstruction import reconstruct
from enerf_ns.scripts.format_options import format_flags

CONSOLE = Console(width=120)


@dataclass
class Reconstruct:
    """Write a recording with frames reconstructed from its events, to learn from, in this project's own layout."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a recording in any known format. It is only ever read."""
    output_dir: Path
    """New folder for the recording. Its own frames stay there for evaluation."""
    options: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=format_flags())
    weights: Path | None = None
    """Published checkpoint of E2VID or FireNet. None: a complementary filter, which needs none."""
    cutoff_frequency: float | None = None
    """Of the complementary filter, Hz: brightness that changes more slowly is forgotten. None: 0.5."""
    frames_per_second: float | None = None
    """For a recording without frames. None: 30. Otherwise, frames are made at the instants of those that there are."""

    def main(self) -> None:
        source, output_dir = self.source.expanduser().resolve(), self.output_dir.expanduser().resolve()
        if not source.is_dir():
            raise RecordingError(f"{source} is not a folder; give that of a recording.")
        weights = self.weights and self.weights.expanduser()
        chosen = self.options.given()
        sentences = reconstruct(source, output_dir, weights, self.frames_per_second, self.cutoff_frequency, **chosen)
        for sentence in sentences:
            CONSOLE.print(sentence, soft_wrap=True, highlight=False, markup=False)
        CONSOLE.print(
            f"The recording is in {output_dir}\n"
            f"train: ns-train enerf --data {shlex.quote(str(output_dir))} --pipeline.datamanager.supervision frames",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
