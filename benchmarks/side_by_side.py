"""Speed of two simultaneous trainings on one machine, relative to that of one training.

Trains on the simulated demo, alone and then twice at once, each time for some seconds after the first, and prints
steps a second and their ratio.

    python benchmarks/side_by_side.py
"""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from enerf_ns.method.runs import method_config, set_up
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

SETTLING, TIMED = 10.0, 15.0
"""Seconds of training that are left out, and that are timed."""


def steps_a_second(recording: Path, folder: Path) -> float:
    """Steps per second of a training on all cores."""
    config = method_config("enerf", recording, folder, {"evaluation_share": 0.0, "machine.device_type": "cpu"})
    trainer = set_up(config)
    trainer.pipeline.train()
    start, steps, first = time.perf_counter(), 0, 0.0
    while (now := time.perf_counter() - start) < SETTLING + TIMED:
        trainer.train_iteration(steps)
        if now < SETTLING:
            first = time.perf_counter() - start
        else:
            steps += 1
    return steps / (time.perf_counter() - start - first)


def at_once(number: int, recording: Path, folder: Path) -> list[float]:
    """Steps per second of each of several simultaneous trainings."""
    command = [sys.executable, __file__, str(recording), str(folder)]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) for _ in range(number)
    ]
    return [float(process.communicate()[0].split()[-1]) for process in running]


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        recording = Path(temporary) / "shapes"
        with contextlib.redirect_stdout(io.StringIO()):
            simulate(SimulationSettings("shapes"), recording)
        print(f"PyTorch {torch.__version__}, CPU, {torch.get_num_threads()} threads\n")
        print("| alone, steps a second | of two at once, each | share kept |\n| --- | --- | --- |")
        (alone,) = at_once(1, recording, Path(temporary) / "alone")
        both = at_once(2, recording, Path(temporary) / "both")
        shares = ", ".join(f"{speed / alone:.2f}" for speed in both)
        print(f"| {alone:.2f} | {', '.join(f'{speed:.2f}' for speed in both)} | {shares} |")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        with contextlib.redirect_stdout(sys.stderr):
            speed = steps_a_second(Path(sys.argv[1]), Path(sys.argv[2]))
        print(speed)
    else:
        main()
