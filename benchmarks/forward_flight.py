"""What a camera that flies straight forward cannot tell, beside one that also looks around.

Simulates the recording `corridor` of the validation set as it is, and with a gaze that swings by some degrees. Trains
on the events and on the sharp frames of each, and prints a table. Beside PSNR, it has the root mean square error of log
brightness in coarse detail, larger than 12 pixels, and in fine detail, smaller than 2 pixels.

    python benchmarks/forward_flight.py
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from threshold import LEARNT_FROM, shown

from enerf_ns.bench.runner import made_whole
from enerf_ns.bench.validation import KEYS_PER_SECOND, ONLY_SCORED
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import HeldOutView, aligned_views
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import method_config, train
from enerf_ns.simulator.engine import simulate

STRAIGHT = ONLY_SCORED["corridor"]
PATH = "corridor.txt"
SWING_METRES, SWINGS_PER_SECOND = 0.35, (2.0, 2.6)
"""How far the target of the gaze, 4 to 5 m ahead, swings to the side and up, and how often."""
COARSE_PIXELS, FINE_PIXELS, DARKEST = 12.0, 2.0, 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--work", type=Path, default=Path("outputs/forward-flight"))
    arguments = parser.parse_args()
    recordings = {
        "straight": STRAIGHT,
        "looks around": replace(STRAIGHT, files={**STRAIGHT.files, PATH: looking_around(STRAIGHT.files[PATH])}),
    }
    rows = []
    for name, sequence in recordings.items():
        folder = arguments.work / name.replace(" ", "-")
        with made_whole(folder / "recording") as new:
            if new is not None:
                simulate(sequence.simulation_settings(folder), new)
        for learnt_from, supervision in LEARNT_FROM.items():
            changes = {"max_num_iterations": arguments.steps, "evaluation_share": 0.0, **supervision}
            found = []
            for seed in range(arguments.seeds):
                config = method_config(
                    "enerf", folder / "recording", folder / "runs", {**changes, "machine.seed": seed}
                )
                views, _ = held_out_views(train(config).pipeline, evidence=False)
                psnr = float(mean_scores(views, False, "log-affine-set", ())[0]["psnr"])
                found.append([psnr, *errors_by_detail(aligned_views(views)[0])])
            cells = [
                shown(list(values), digits) for values, digits in zip(zip(*found, strict=True), (2, 3, 3), strict=True)
            ]
            rows.append(f"| {name} | {learnt_from} | {' | '.join(cells)} |")
            print(rows[-1], flush=True)
    print(
        "\n| flight | trained on | PSNR, dB | error, coarse detail | error, fine detail |"
        "\n| --- | --- | --- | --- | --- |"
    )
    print(*rows, sep="\n")


def looking_around(path: str) -> str:
    """Key frames along a straight path, at which the target of the gaze swings."""
    ends = np.loadtxt(path.splitlines())
    times = np.arange(ends[0, 0], ends[-1, 0] + 1e-9, 1.0 / KEYS_PER_SECOND)
    rows = np.stack([times, *(np.interp(times, ends[:, 0], column) for column in ends[:, 1:].T)], axis=1)
    sideways, up = (2.0 * np.pi * rate * times for rate in SWINGS_PER_SECOND)
    rows[:, 4] += SWING_METRES * np.sin(sideways)
    rows[:, 6] += SWING_METRES * np.cos(up)
    return "".join(" ".join(f"{value:.6g}" for value in row) + "\n" for row in rows)


def errors_by_detail(views: list[HeldOutView]) -> tuple[float, float]:
    """Root mean square errors of log brightness of views, in coarse and in fine detail."""
    coarse, fine = [], []
    for view in views:
        assert view.recorded is not None
        frame, render = (
            np.log(part.mean(dim=-1).clamp(min=0.0).numpy() + DARKEST) for part in (view.recorded, view.rendered)
        )
        error = render - frame
        coarse.append(np.mean(gaussian_filter(error, COARSE_PIXELS) ** 2))
        fine.append(np.mean((error - gaussian_filter(error, FINE_PIXELS)) ** 2))
    return float(np.sqrt(np.mean(coarse))), float(np.sqrt(np.mean(fine)))


if __name__ == "__main__":
    main()
