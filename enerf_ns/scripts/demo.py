"""`enerf demo`: from nothing to a novel-view video."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from pathlib import Path

from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.scripts.simulate import Simulate
from enerf_ns.simulator.settings import SimulationSettings


@dataclass
class Demo:
    """Simulate an event camera, train on its events alone, score the field, write a picture and a video."""

    output_dir: Path = Path("outputs/demo")
    """Folder for the recording, the run, scores.json, side-by-side.png and video.mp4."""
    max_num_iterations: int | None = None
    """Training steps. None: as many as the method enerf takes."""

    def main(self) -> None:
        from nerfstudio.configs.method_configs import all_methods
        from nerfstudio.scripts.train import train_loop
        from nerfstudio.utils.eval_utils import eval_setup
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.enerf_pipeline import EnerfPipeline
        from enerf_ns.scripts.report import render_video, write_scores_and_picture

        output_dir = self.output_dir.expanduser().resolve()
        recording = output_dir / "recording"
        if recording.exists():
            CONSOLE.print(f"The recording in {recording} is used again; remove it to simulate anew.")
        else:
            Simulate(recording, SimulationSettings("shapes")).main()

        config = copy.deepcopy(all_methods["enerf"])
        config.data = config.pipeline.datamanager.data = recording
        config.output_dir = output_dir / "runs"
        config.vis = "tensorboard"
        config.steps_per_eval_image = config.steps_per_eval_batch
        if self.max_num_iterations is not None:
            config.max_num_iterations = self.max_num_iterations
        config.set_timestamp()
        config.save_config()
        start = time.perf_counter()
        train_loop(local_rank=0, world_size=1, config=config)
        train_seconds = time.perf_counter() - start

        run_config = config.get_base_dir() / "config.yml"
        _, pipeline, _, _ = eval_setup(run_config)
        assert isinstance(pipeline, EnerfPipeline)
        events = len(index_events(pipeline.datamanager.train_dataset.recording))
        extra = {"train_seconds": round(train_seconds, 1), "events": events}
        scores = write_scores_and_picture(pipeline, output_dir, extra)
        render_video(pipeline, run_config, output_dir)
        CONSOLE.print(scores)
        CONSOLE.print(f"scores.json, side-by-side.png and video.mp4 are in {output_dir}")
