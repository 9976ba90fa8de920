"""`enerf reconstruct`: write a recording with frames that a network or a filter reconstructs from its events."""

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
    """Reconstruct frames from the events of a recording, and write a recording with these frames to train on."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a recording in any known format. Nothing is written into it. One that enerf convert wrote without poses
    serves as well."""
    output_dir: Path
    """New folder for the recording. It keeps the original frames for evaluation."""
    options: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=format_flags())
    weights: Path | None = None
    """Published checkpoint of E2VID or FireNet. Default: a complementary filter, which needs no checkpoint."""
    cutoff_frequency: float | None = None
    """Cut-off frequency of the complementary filter in Hz: it forgets brightness that changes more slowly.
    Default: 0.5."""
    frames_per_second: float | None = None
    """Number of frames per second, for a recording without frames. Default: 30. In a recording with frames, they are
    reconstructed at the times of these frames."""

    def main(self) -> None:
        source, output_dir = absolute(self.source), absolute(self.output_dir)
        if not source.is_dir():
            raise RecordingError(f"{source} is not a folder of a recording; enerf convert makes one of an event file.")
        weights = self.weights and expanded(self.weights)
        chosen = self.options.given()
        sentences = reconstruct(source, output_dir, weights, self.frames_per_second, self.cutoff_frequency, **chosen)
        for sentence in sentences:
            print(printable(sentence))
        print(printable(f"The recording is in {output_dir}"))
        if (output_dir / "poses.txt").exists():
            print(f"train: ns-train enerf --data {quoted(output_dir)} --pipeline.datamanager.supervision frames")
