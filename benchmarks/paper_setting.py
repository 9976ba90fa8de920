"""PSNR of the default and of the setting of the paper, which trains ten times as long, on one recording.

Each seed trains `enerf` for some steps, and then `enerf-paper` for ten times as many seconds of the processor, or of
the clock on a GPU, there with as many pairs a step as in the paper, and on a CPU with those of the default. Prints a
Markdown table; PSNR is that of all held-out frames.

    python benchmarks/paper_setting.py outputs/demo/recording --steps 600 --seeds 3
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from threshold import shown

from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import method_config, set_up
from enerf_ns.method.trainer import EnerfTrainer

LONGER = 10
"""Times as long as the default the setting of the paper may take."""


def clock(device: str) -> float:
    """Seconds that this process has worked: of the CPU, or, on a GPU, as time goes by."""
    if device == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def train(trainer: EnerfTrainer, device: str, steps: int, seconds: float) -> tuple[int, float]:
    """Trains for so many steps, but no longer; the first one, which compiles, is not timed. Returns both."""
    trainer.pipeline.train()
    began, step = clock(device), 0
    while step < steps and (step < 1 or clock(device) - began < seconds):
        trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        if step == 0:
            began = clock(device)
        step += 1
    return step, clock(device) - began


def score(trainer: EnerfTrainer) -> float:
    """PSNR over all held-out frames, dB; nan where what is rendered is flat or a negative."""
    trainer.pipeline.eval()
    return mean_scores(held_out_views(trainer.pipeline, evidence=False)[0])[0].get("psnr", float("nan"))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=3)
    flags = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows: dict[str, list[tuple[int, float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(flags.seeds):
            common = {"machine.seed": seed, "evaluation_share": 0.0, "machine.device_type": device}
            default = set_up(
                method_config("enerf", flags.recording, Path(folder), common | {"max_num_iterations": flags.steps})
            )
            steps, seconds = train(default, device, flags.steps, float("inf"))
            rows.setdefault("enerf", []).append((steps, seconds, score(default)))
            if device == "cpu":
                common["pipeline.datamanager.event_pairs"] = default.pipeline.datamanager.config.event_pairs
            paper = set_up(method_config("enerf-paper", flags.recording, Path(folder), common))
            steps, seconds = train(paper, device, paper.config.max_num_iterations, LONGER * seconds)
            pairs = paper.pipeline.datamanager.config.event_pairs
            rows.setdefault(f"enerf-paper, {pairs} pairs a step", []).append((steps, seconds, score(paper)))
            for name, found in rows.items():
                print(f"seed {seed}, {name}: steps, seconds, dB: {found[-1]}", flush=True)
    print("\n| method | steps | s | PSNR, dB |\n| --- | --- | --- | --- |")
    for name, found in rows.items():
        steps, seconds, _ = np.mean(found, axis=0)
        print(f"| {name} | {steps:.0f} | {seconds:.0f} | {shown([row[2] for row in found], 2)} |")


if __name__ == "__main__":
    main()
