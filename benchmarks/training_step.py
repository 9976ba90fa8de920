"""How much of a training step goes into drawing pairs and posing their rays.

    python benchmarks/training_step.py RECORDING

Prints a Markdown table: median milliseconds of drawing a batch with its rays, and of the whole step of the method
`enerf`.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from enerf_ns.enerf_pipeline import EnerfPipeline
from enerf_ns.evaluation.runs import method_config, set_up


@dataclass
class TrainingStep:
    """Time sampling and posing against whole training steps."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of the recording."""
    event_pairs: tuple[int, ...] = (1024, 30096)
    """Batch sizes."""
    repeats: int = 7
    """Steps timed for each."""

    def main(self) -> None:
        print("| event pairs | sample and pose, ms | whole step, ms | share |\n|---|---|---|---|")
        for pairs in self.event_pairs:
            with tempfile.TemporaryDirectory() as folder:
                changes = {"pipeline.datamanager.event_pairs": pairs}
                trainer = set_up(method_config("enerf", self.data, Path(folder), changes))
                sampling = self.median_ms(lambda pipeline=trainer.pipeline: self.draw(pipeline))
                step = self.median_ms(lambda trainer=trainer: trainer.train_iteration(0))
            print(f"| {pairs} | {sampling:.1f} | {step:.0f} | {100 * sampling / step:.1f} % |", flush=True)

    @staticmethod
    def draw(pipeline: EnerfPipeline) -> None:
        manager, sensor = pipeline.datamanager, pipeline.model.sensor
        manager.rays(manager.next_batch(sensor), sensor)

    def median_ms(self, call: Callable) -> float:
        """Median wall time of a call, after two that warm up."""
        times = []
        for _ in range(self.repeats + 2):
            start = time.perf_counter()
            call()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            times.append(time.perf_counter() - start)
        return 1e3 * statistics.median(times[2:])


if __name__ == "__main__":
    tyro.cli(TrainingStep).main()
