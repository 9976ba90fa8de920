"""What the parts that a scene does not need would cost: time and memory of a step, and the score.

    python benchmarks/left_out.py RECORDING

For a recording that is grey, bounded and rectified, and learnt from events alone, such as the demo's: everything forced
on, each part left out in turn, everything left out, and what is decided from the recording. Prints a Markdown table and
writes it to --output-dir. Frames are used for scores alone. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from enerf_ns.evaluation.runs import method_config, set_up
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import held_out_views

PARTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "silent pixels": ({"pipeline.datamanager.silent_pairs": 341}, {"pipeline.datamanager.silent_pairs": 0}),
    "refractory period": (
        {"pipeline.model.sensor.refractory_period_ns": 1000},
        {"pipeline.model.sensor.refractory_period_ns": 0},
    ),
    "colour": ({"pipeline.model.num_channels": 3}, {"pipeline.model.num_channels": 1}),
    "view direction": ({"pipeline.model.view_direction": True}, {"pipeline.model.view_direction": False}),
    "proposal network": (
        {"pipeline.model.sampling": "proposal"},
        {"pipeline.model.sampling": "uniform", "pipeline.model.num_samples": 64},
    ),
    "16 levels of the grid": ({"pipeline.model.num_levels": 16}, {"pipeline.model.num_levels": 10}),
    "opacity loss": ({"pipeline.model.opacity_loss_weight": 1.0}, {"pipeline.model.opacity_loss_weight": 0.0}),
    "dynamic range": ({"pipeline.model.brightness": "exponential"}, {"pipeline.model.brightness": "log-sigmoid"}),
}
"""What forces each part on, and what leaves it out; in place of the proposal network are 64 even samples."""


@dataclass
class LeftOut:
    """Time, memory and score of the parts of the method."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of the recording."""
    steps: int = 600
    """Training steps before the score."""
    seeds: int = 1
    """Trainings a row; scores are their means."""
    output_dir: Path = Path("outputs/left-out")
    """Folder for table.md and the runs."""

    def main(self) -> None:
        everything = {name: value for on, _ in PARTS.values() for name, value in on.items()}
        nothing = {name: value for _, off in PARTS.values() for name, value in off.items()}
        rows = {"everything forced on": everything}
        rows |= {f"without {part}": {**everything, **off} for part, (_, off) in PARTS.items()}
        rows |= {"everything left out": nothing, "as decided": {}}
        lines = ["| | ms a step | MB a step | psnr | correlation | depth_rmse |", "|---|---|---|---|---|---|"]
        print("\n".join(lines), flush=True)
        for name, changes in rows.items():
            lines.append(self.row(name, changes))
            print(lines[-1], flush=True)
        self.output_dir.mkdir(parents=True, exist_ok=True)
        (self.output_dir / "table.md").write_text("\n".join(lines) + "\n")

    def row(self, name: str, changes: dict[str, Any]) -> str:
        """A line of the table."""
        milliseconds, scores = [], []
        for seed in range(self.seeds):
            settings = {**changes, "machine.seed": seed, "max_num_iterations": self.steps}
            config = method_config("enerf", self.data, self.output_dir / "runs", settings)
            config.timestamp = f"{name.replace(' ', '-')}-{seed}"
            trainer = set_up(config)
            megabytes = saved_megabytes(trainer)
            trainer.pipeline.train()
            for step in range(self.steps):
                start = time.perf_counter()
                trainer.train_iteration(step)
                for callback in trainer.callbacks:
                    callback.func(step)
                if torch.cuda.is_available():
                    torch.cuda.synchronize()
                milliseconds.append(1e3 * (time.perf_counter() - start))
            scores.append(mean_scores(held_out_views(trainer.pipeline)[0])[0])
        cells = [f"{statistics.median(milliseconds):.0f}", f"{megabytes:.1f}"]
        for key in ("psnr", "correlation", "depth_rmse"):  # a negative, for one, has no PSNR
            found = [score[key] for score in scores if key in score]
            cells.append(f"{statistics.mean(found):.3f}" if found else "-")
        return f"| {name} | " + " | ".join(cells) + " |"


def saved_megabytes(trainer: Any) -> float:
    """What a step keeps in memory for its backward pass, and the parameters with their gradients and running means."""
    seen: dict[int, int] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        seen[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    trainer.pipeline.train()
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        _, losses, _ = trainer.pipeline.get_train_loss_dict(0)
    del losses
    parameters = sum(parameter.nbytes for parameter in trainer.pipeline.model.parameters())
    return (sum(seen.values()) + 4 * parameters) / 1e6


if __name__ == "__main__":
    tyro.cli(LeftOut).main()
