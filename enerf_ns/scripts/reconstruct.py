"""`enerf reconstruct`: a recording with frames that a network, or a filter, makes of its events."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from enerf_ns.dataparsers.recording.errors import RecordingError, printable, quoted
from enerf_ns.dataparsers.recording.files import absolute, expanded
from enerf_ns.reconstruction.reconstruction import reconstruct
from enerf_ns.scripts.format_options import format_flags


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
        source, output_dir = absolute(self.source), absolute(self.output_dir)
        if not source.is_dir():
            raise RecordingError(f"{source} is not a folder; give that of a recording.")
        weights = self.weights and expanded(self.weights)
        chosen = self.options.given()
        sentences = reconstruct(source, output_dir, weights, self.frames_per_second, self.cutoff_frequency, **chosen)
        for sentence in sentences:
            print(printable(sentence))
        print(printable(f"The recording is in {output_dir}"))
        print(f"train: ns-train enerf --data {quoted(output_dir)} --pipeline.datamanager.supervision frames")
