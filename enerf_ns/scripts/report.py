"""`enerf report`: scores, picture and video of a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from nerfstudio.utils.rich_utils import CONSOLE

from enerf_ns.evaluation.report import write_report
from enerf_ns.evaluation.runs import load


@dataclass
class Report:
    """Score a trained run on its held-out frames; write scores.json, side-by-side.png and video.mp4."""

    load_config: Annotated[Path, tyro.conf.Positional]
    """config.yml of the run."""
    output_dir: Path | None = None
    """Folder for the three files. None: the folder of the run."""

    def main(self) -> None:
        run = load(self.load_config)
        output_dir = self.output_dir or self.load_config.parent
        CONSOLE.print(write_report(run, output_dir))
        CONSOLE.print(f"scores.json, side-by-side.png and video.mp4 are in {output_dir.resolve()}", markup=False)
