"""Error against run time: trains settings one after another and scores the held-out frames on the way.

    python benchmarks/error_against_time.py RECORDING --settings events blurred-frames events+blurred-frames

Prints a Markdown table, and writes it with a plot and the last pictures to --output-dir. Training time is wall time of
training steps alone; scoring stops the clock. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import json
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from enerf_ns.enerf_pipeline import EnerfPipeline
from enerf_ns.evaluation.runs import method_config, set_up
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import held_out_views
from enerf_ns.report.pictures import shown_numbers, side_by_side

SETTINGS: dict[str, dict[str, Any]] = {
    "events": {},
    "sharp-frames": {
        "pipeline.datamanager.supervision": "frames",
        "pipeline.datamanager.dataparser.train_frames": "sharp",
    },
    "blurred-frames": {"pipeline.datamanager.supervision": "frames"},
    "events+blurred-frames": {"pipeline.datamanager.supervision": "events+frames"},
    "successor-pairs": {"pipeline.datamanager.pair_mode": "successor"},
    "window-60ms": {"pipeline.datamanager.pair_mode": "window"},
    "uniform-samples": {"pipeline.model.sampling": "uniform", "pipeline.model.num_samples": 64},
    "no-silent-pairs": {"pipeline.datamanager.silent_pairs": 0},
    "no-distortion-loss": {"pipeline.model.distortion_loss_weight": 0.0},
    "view-direction": {"pipeline.model.view_direction": True},
    "16-levels-2^19": {"pipeline.model.num_levels": 16, "pipeline.model.log2_table_size": 19},
}
"""What each setting changes of the method `enerf`."""


@dataclass
class ErrorAgainstTime:
    """Train settings of enerf on a recording and score the held-out frames at several times."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of the recording."""
    settings: tuple[str, ...] = ("events",)
    """Names of settings (see SETTINGS)."""
    seconds: tuple[float, ...] = (30.0, 60.0, 120.0, 240.0)
    """Training times at which to score."""
    output_dir: Path = Path("outputs/error-against-time")
    """Folder for table.md, scores.json, plot.png and one picture a setting."""
    seed: int = 0
    """Seed of the training."""

    def main(self) -> None:
        unknown = set(self.settings) - set(SETTINGS)
        if unknown:
            raise SystemExit(f"--settings {' '.join(sorted(unknown))}: expected some of {', '.join(SETTINGS)}")
        self.output_dir.mkdir(parents=True, exist_ok=True)
        rows = [row for name in self.settings for row in self.train(name)]
        (self.output_dir / "scores.json").write_text(json.dumps(rows, indent=2))
        table = markdown(rows)
        device = torch.cuda.get_device_name() if torch.cuda.is_available() else f"{torch.get_num_threads()} CPU threads"
        (self.output_dir / "table.md").write_text(f"{self.data.name}, {device}, {platform.machine()}\n\n{table}\n")
        plot(rows, self.output_dir / "plot.png")
        print(table)

    def train(self, name: str) -> list[dict[str, Any]]:
        """Scores of one setting, a row for each time."""
        config = method_config(
            "enerf", self.data, self.output_dir / "runs", {**SETTINGS[name], "machine.seed": self.seed}
        )
        config.experiment_name, config.timestamp = name, "run"
        trainer = set_up(config)
        pipeline = trainer.pipeline
        assert isinstance(pipeline, EnerfPipeline)
        rows, step, trained = [], 0, 0.0
        for limit in sorted(self.seconds):
            pipeline.train()
            while trained < limit and step < config.max_num_iterations:
                start = time.perf_counter()
                trainer.train_iteration(step)
                for callback in trainer.callbacks:
                    callback.func(step)
                trained += time.perf_counter() - start
                step += 1
            views, summary = held_out_views(pipeline)
            row = {"setting": name, "seconds": round(trained, 1), "steps": step, **mean_scores(views)[0]}
            rows.append(row | {"rays_per_second": summary["num_rays_per_sec"]})
            print(rows[-1], flush=True)
        shown = [views[number] for number in shown_numbers(len(views))]
        picture = side_by_side(shown, pipeline.datamanager.eval_dataset.recording)
        picture.savefig(self.output_dir / f"{name}.png")
        return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """Table of all rows; a dash where a score does not exist."""
    columns = {"setting": "", "seconds": ".0f", "steps": "", "psnr": ".2f", "ssim": ".3f", "lpips": ".3f"}
    columns |= {"correlation": ".3f", "depth_rmse": ".3f"}
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        cells = [format(row[name], spec) if name in row else "-" for name, spec in columns.items()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """PSNR against training time, one line a setting."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained", dpi=120)
    axis = figure.subplots()
    for name in dict.fromkeys(row["setting"] for row in rows):
        chosen = [row for row in rows if row["setting"] == name]
        axis.plot([row["seconds"] for row in chosen], [row["psnr"] for row in chosen], marker="o", label=name)
    axis.set_xlabel("training time, s")
    axis.set_ylabel("PSNR on held-out frames, dB")
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(path)


if __name__ == "__main__":
    tyro.cli(ErrorAgainstTime).main()
