"""Space beyond the box: left out, or contracted as mip-NeRF 360 does.

    python benchmarks/unbounded.py

Simulates things at 1 to 2 m before walls at 30 and 300 m, trains on the events with either, and prints a Markdown table
of held-out scores; depths are those of the things at 1 to 2 m.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from enerf_ns.evaluation.runs import method_config, train
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import held_out_views
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

NEAR = 0.9, 2.6
SCENE = {
    "parts": [
        {"shape": "plane", "size": [60, 50], "position": [-14, 30, 0], "rotation": [90, 0, 0], "texture": "mosaic"},
        {"shape": "plane", "size": [700, 500], "position": [0, 300, 0], "rotation": [90, 0, 0], "texture": "bricks"},
        {"shape": "box", "size": [0.5, 0.4, 0.6], "position": [-0.4, 1.5, -0.2], "texture": "bricks"},
        {"shape": "ball", "size": 0.45, "position": [0.45, 1.3, 0.15], "texture": "clouds"},
        {"shape": "box", "size": [0.3, 0.3, 0.9], "position": [0.15, 1.9, -0.1], "texture": "mosaic"},
    ],
    "camera": [0, 0, 0],
    "target": [0, 2, 0],
    "light": None,
}
PATH = "0 -0.25 0 0 0 2 0\n0.25 -0.08 0 0.06 0 2 0\n0.5 0.1 0 -0.05 0 2 0\n0.7 0.25 0 0.03 0 2 0\n"


@dataclass
class Unbounded:
    """Train on an unbounded scene with and without contraction."""

    steps: int = 800
    """Training steps."""
    seeds: int = 3
    """Trainings of each."""
    output_dir: Path = Path("outputs/unbounded")
    """Folder for the recording and the runs."""

    def main(self) -> None:
        recording = self.output_dir / "recording"
        if not recording.exists():
            self.output_dir.mkdir(parents=True, exist_ok=True)
            (self.output_dir / "scene.json").write_text(json.dumps(SCENE))
            (self.output_dir / "path.txt").write_text(PATH)
            scene, path = str(self.output_dir / "scene.json"), self.output_dir / "path.txt"
            simulate(SimulationSettings(scene, key_frames=path, width=120, height=90, num_frames=29), recording)
        print("| contraction | seed | train s | psnr | ssim | correlation | median depth error, m |")
        print("|---|---|---|---|---|---|---|")
        for contraction in (False, True):
            for seed in range(self.seeds):
                settings = {
                    "max_num_iterations": self.steps,
                    "machine.seed": seed,
                    "pipeline.model.contraction": contraction,
                    "pipeline.datamanager.dataparser.depth_range": NEAR,
                }
                run = train(method_config("enerf", recording, self.output_dir / "runs", settings))
                views, _ = held_out_views(run.pipeline)
                scores, _ = mean_scores(views)
                errors = []
                for view in views:
                    assert view.recorded_depth is not None
                    near = (view.recorded_depth > 0) & (view.recorded_depth < NEAR[1])
                    errors.append((view.depth - view.recorded_depth)[near].abs())
                cells = [f"{scores.get(name, torch.nan):.3f}" for name in ("psnr", "ssim", "correlation")]
                cells.append(f"{float(torch.cat(errors).median()):.3f}")
                kept = "kept" if contraction else "left out"
                print(f"| {kept} | {seed} | {run.train_seconds:.0f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    tyro.cli(Unbounded).main()
