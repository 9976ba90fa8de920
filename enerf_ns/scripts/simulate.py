"""`enerf simulate`: simulate a recording of an event camera, with frames, depth and poses.

The source is a scene that is made from a seed, a mesh, a folder of images, a video or a trained run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Optional  # tyro reads these annotations on Python 3.10

import tyro

from enerf_ns.dataparsers.recording.errors import FlagError, printable
from enerf_ns.scripts.next_steps import print_next
from enerf_ns.sensor.response import Logarithm
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings


@dataclass
class Simulate:
    """Simulate a recording of an event camera with sharp and blurred frames, depth and poses."""

    output_dir: Path
    """New folder for the recording."""
    settings: Annotated[SimulationSettings, tyro.conf.arg(name="")] = field(default_factory=SimulationSettings)
    log_eps: Optional[float] = None  # noqa: UP045
    """EPS in --response logarithm:EPS, as a flag of its own."""
    preview: bool = False
    """Also write preview.mp4, which shows frame, blurred frame, events and depth side by side."""

    def main(self) -> None:
        settings = self.settings
        if self.log_eps is not None:
            if settings.sensor.response != SensorSettings().response:
                raise FlagError(
                    f"--log-eps {self.log_eps} contradicts --response {settings.sensor.response}; leave one out."
                )
            sensor = replace(settings.sensor, response=Logarithm(self.log_eps).name)
            settings = replace(settings, sensor=sensor)
        made = simulate(settings, self.output_dir, self.preview)
        for note in made.notes:
            print(printable(f"note: {note}"))
        seconds = made.duration * 1e-9
        print(
            printable(f"{made.num_events:,} events and {made.num_frames} frames of {seconds:g} s are in {made.folder}")
        )
        if not made.has_poses:
            print("Before training, add poses.txt, as docs/formats.md shows (“Write a recording yourself”).")
        elif made.num_events:
            print_next(made.folder)
