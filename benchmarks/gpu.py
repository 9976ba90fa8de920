"""Training on a GPU: time of a step by part, time to a PSNR, peak memory, and rendered pictures per second.

Prints Markdown tables, and stores their numbers under --json. Recordings are simulated; `benchmarks/gpu.sh` runs this
script with its companions. --small shrinks all sizes, to test the script on a CPU.

    python benchmarks/gpu.py --json gpu.json
    python benchmarks/gpu.py --small --device cpu
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gc
import json
import statistics
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from enerf_ns.bench.runner import steps_of
from enerf_ns.evaluation.history import read_history
from enerf_ns.method.runs import Run, method_config, set_up, train
from enerf_ns.method.stopwatch import seconds_of
from enerf_ns.report.trade_offs import seconds_to_reach
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

WARM_UP, TIMED = 20, 30
"""Steps that are left out, and steps that are timed."""

TARGETS = (20.0, 22.0, 24.0, 26.0, 26.65)
"""PSNR in dB; the last is the paper's of shake-carpet1 by events alone."""

EVALUATION_SHARE = 0.2
"""Share of the training time that goes into scores, for many of them; it does not count as training."""

PICTURES = 5
"""Pictures of 640 x 480 that are rendered, of which the median counts."""


def step_by_part(name: str, config: Any) -> dict[str, Any]:
    """Milliseconds of a training step late in a run, by part and as a whole, and the most memory that it takes."""
    device = torch.device(config.machine.device_type)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    trainer = set_up(config)
    trainer.pipeline.train()
    watch, parts = trainer.pipeline.stopwatch, []

    def steps(number: int, timed: bool = False) -> None:
        for _ in range(number):
            if timed:
                watch.start()
            trainer.train_iteration(1001)
            if timed:
                watch.lap("optimiser")
                parts.append(watch.stop())

    steps(WARM_UP)
    whole = seconds_of(lambda: steps(TIMED), device) / TIMED
    steps(TIMED, timed=True)
    peak = torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else float("nan")
    manager = trainer.pipeline.datamanager
    found = {
        "setting": name,
        "rays": manager.get_train_rays_per_batch(),
        "ms": 1e3 * whole,
        "peak_gb": peak,
        "parts_ms": {part: 1e3 * statistics.median(each[part] for each in parts) for part in parts[0]},
    }
    del trainer, manager, watch
    gc.collect()
    return found


def error_against_time(name: str, config: Any, budget: str) -> tuple[dict[str, Any], Run]:
    """Seconds of training to each of `TARGETS`, and the scores at the end."""
    config.evaluation_share = EVALUATION_SHARE
    config.max_num_iterations = steps_of(budget, config)
    run = train(config)
    history = read_history(run.config_file.parent)
    reached = {target: seconds_to_reach(history, "psnr", target) for target in TARGETS}
    return {
        "recording": name,
        "steps": config.max_num_iterations,
        "seconds": history[-1].seconds,
        "scores": history[-1].scores,
        "seconds_to": {str(target): found and found[0] for target, found in reached.items()},
    }, run


@torch.no_grad()
def pictures_a_second(run: Run) -> float:
    """Of the first held-out camera, at 640 pixels' width."""
    pipeline = run.pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(pipeline.device)
    camera.rescale_output_resolution(640 / int(camera.width))
    times = [
        seconds_of(lambda: pipeline.model.get_outputs_for_camera(camera), pipeline.device) for _ in range(PICTURES + 1)
    ]
    return 1.0 / statistics.median(times[1:])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--json", type=Path)
    flags = parser.parse_args()
    device = torch.cuda.get_device_name() if flags.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    results: dict[str, Any] = {"device": device, "torch": torch.__version__, "small": flags.small}

    def store() -> None:
        if flags.json:
            flags.json.write_text(json.dumps(results, indent=1))

    tell = functools.partial(print, file=sys.stdout)  # the tables alone; what training says goes to stderr
    with contextlib.redirect_stdout(sys.stderr), tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        shapes, carpet = folder / "shapes", folder / "shake-carpet1"
        width = 32 if flags.small else None
        simulate(SimulationSettings("shapes", width=width), shapes)
        simulate(SimulationSettings("shake-carpet1", width=width), carpet)

        def config(method: str, recording: Path, changes: Mapping[str, Any] = {}) -> Any:
            found = method_config(method, recording, folder / "runs", {"machine.device_type": flags.device, **changes})
            found.timestamp = f"{method}-{len(list((folder / 'runs').glob('*/*/*')))}"
            return found

        tell(f"PyTorch {torch.__version__}, {device}\n")
        many = {f"pipeline.datamanager.{name}": 128 if flags.small else pairs for name, pairs in PAPER_PAIRS.items()}
        steps = results["steps"] = []
        for name, method, changes in (("enerf", "enerf", {}), ("enerf, 30096 pairs", "enerf", many)):
            steps.append(step_by_part(name, config(method, shapes, changes)))
            store()
        steps.append(step_by_part("enerf-paper", config("enerf-paper", shapes, many if flags.small else {})))
        store()
        names = list(steps[0]["parts_ms"])
        tell(f"| setting | rays a step | a step, ms | {' | '.join(names)} | peak memory, GB |")
        tell("|---" * (len(names) + 4) + "|")
        for step in steps:
            parts = " | ".join(f"{step['parts_ms'][name]:.1f}" for name in names)
            tell(f"| {step['setting']} | {step['rays']} | {step['ms']:.1f} | {parts} | {step['peak_gb']:.2f} |")

        budgets = ("2s", "2s") if flags.small else ("60s", "150s")
        runs = results["runs"] = []
        for recording, budget in zip((shapes, carpet), budgets, strict=True):
            preset = None if recording == shapes else "shake-carpet1"
            found, run = error_against_time(recording.name, config("enerf", recording, {"preset": preset}), budget)
            runs.append(found | {"pictures_a_second": pictures_a_second(run)})
            store()
        tell(
            f"\n| recording | training, s | steps | PSNR, dB | {' | '.join(f'{t:g} dB, s' for t in TARGETS)} |", end=""
        )
        tell(" pictures of 640 x 480 a second |")
        tell("|---" * (len(TARGETS) + 5) + "|")
        for found in runs:
            reached = " | ".join("-" if s is None else f"{s:.1f}" for s in found["seconds_to"].values())
            tell(
                f"| {found['recording']} | {found['seconds']:.0f} | {found['steps']} | "
                f"{found['scores'].get('psnr', float('nan')):.2f} | {reached} | {found['pictures_a_second']:.2f} |"
            )


PAPER_PAIRS = {"event_pairs": 30096, "silent_pairs": 0}
"""Batch of the paper."""

if __name__ == "__main__":
    main()
