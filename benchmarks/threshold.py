"""Quality that events reach by their contrast threshold, beside sharp frames of the same recording.

Simulates recordings of the validation set with an ideal sensor of another contrast threshold, trains on their events
alone, and prints a table. The last row of each recording is trained on its sharp frames alone.

    python benchmarks/threshold.py floor plain near
    python benchmarks/threshold.py floor --thresholds 0.05 --seeds 1
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

from enerf_ns.bench.runner import made_whole
from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import aligned_views
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import method_config, train
from enerf_ns.simulator.engine import simulate

DATA = "pipeline.datamanager."
LEARNT_FROM = {
    "events": {f"{DATA}supervision": "events"},
    "sharp frames": {f"{DATA}supervision": "frames", f"{DATA}dataparser.train_frames": "sharp"},
}
"""Changes to the configuration. By default, frames would be those that the exposure has blurred."""
IDEAL = {name: sequence for name, sequence in {**CHOSEN_ON, **ONLY_SCORED}.items() if sequence.sensor is None}
"""Recordings of the validation set whose sensor has no other faults."""
SHOWN = {"psnr": 2, "ssim": 3, "depth_rmse": 3, "brightness_scale": 3}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", choices=sorted(IDEAL))
    parser.add_argument("--thresholds", nargs="+", type=float, default=[0.2, 0.1, 0.05])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--work", type=Path, default=Path("outputs/threshold"))
    arguments = parser.parse_args()
    rows = []
    for name in arguments.recordings:
        for learnt_from, supervision in LEARNT_FROM.items():
            for threshold in arguments.thresholds if learnt_from == "events" else arguments.thresholds[:1]:
                changes = {"max_num_iterations": arguments.steps, **supervision}
                folder = recording(name, threshold, arguments.work)
                found = [trained(folder, {**changes, "machine.seed": seed}) for seed in range(arguments.seeds)]
                scores = [
                    shown([run[score] for run in found if score in run], digits) for score, digits in SHOWN.items()
                ]
                of = f"events, threshold {threshold:g}" if learnt_from == "events" else learnt_from
                rows.append(f"| {name} | {of} | {' | '.join(scores)} |")
    print(
        "\n| recording | trained on | PSNR, dB | SSIM | depth RMSE, m | scale |\n| --- | --- | --- | --- | --- | --- |"
    )
    print(*rows, sep="\n")


def recording(name: str, threshold: float, work: Path) -> Path:
    """Folder of a recording of the validation set, simulated once with both thresholds changed."""
    folder = work / f"{name}-{threshold:g}"
    with made_whole(folder) as new:
        if new is not None:
            simulate(IDEAL[name].simulation_settings(work, contrast_thresholds=(threshold, threshold)), new)
    return folder


def trained(folder: Path, changes: dict[str, Any]) -> dict[str, float]:
    """Scores of a training over held-out frames, after the fit of brightness, and the scale of this fit."""
    run = train(method_config("enerf", folder, folder.parent / "runs", {"evaluation_share": 0.0, **changes}))
    views, _ = held_out_views(run.pipeline, evidence=False)
    return {**mean_scores(views, False, "log-affine-set", ())[0], **aligned_views(views)[1]}


def shown(values: list[float], digits: int) -> str:
    """Mean and standard deviation; a dash if there is no value."""
    if not values:
        return "-"
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.{digits}f}{spread}"


if __name__ == "__main__":
    main()
