"""Evaluation over the whole set of held-out frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from enerf_ns.enerf_datamanager import EnerfDataManager, EnerfDataManagerConfig
from enerf_ns.enerf_model import EnerfModel, EnerfModelConfig
from enerf_ns.evaluation.metrics import correlation
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import held_out_views, save_pictures
from enerf_ns.sensor.response import linlog, pixel_brightness
from enerf_ns.sensor.sensor_model import measured_change


@dataclass
class EnerfPipelineConfig(VanillaPipelineConfig):
    """Nerfstudio's pipeline, with one brightness fit over all held-out frames."""

    _target: Type = field(default_factory=lambda: EnerfPipeline)  # noqa: UP006
    datamanager: EnerfDataManagerConfig = field(default_factory=EnerfDataManagerConfig)
    model: EnerfModelConfig = field(default_factory=EnerfModelConfig)


class EnerfPipeline(VanillaPipeline):
    """Scores held-out frames together, because events fix brightness only up to one scale and offset."""

    datamanager: EnerfDataManager
    config: EnerfPipelineConfig

    @property
    def model(self) -> EnerfModel:
        return super().model  # type: ignore

    @torch.no_grad()
    def event_correlation(self, num_pairs: int = 8192) -> float:
        """Linear correlation of rendered and measured changes of log brightness over random event pairs.

        What can be said of a field whose recording has no frames; the pairs are drawn from those of the training.
        """
        self.eval()
        manager, thresholds = self.datamanager, self.model.config.contrast_thresholds
        assert thresholds is not None
        manager.setup_events(manager.eval_dataset.recording)
        generator = torch.Generator(self.device).manual_seed(0)
        pairs = manager.pair_sampler.sample(num_pairs, generator)
        rays = manager.event_rays(pairs.pixels.repeat(2), torch.cat([pairs.start, pairs.end])).reshape((2, num_pairs))
        rendered = self.model.get_outputs_for_camera_ray_bundle(rays)["rgb"]
        channel = None if manager.pixel_channels is None else manager.pixel_channels[pairs.pixels].expand(2, -1)
        start, end = linlog(pixel_brightness(rendered, channel))
        self.train()
        return correlation(end - start, measured_change(pairs.on, pairs.off, thresholds))

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Mean scores over the held-out frames: psnr, ssim, correlation, and lpips and depth_rmse where available.

        Of a recording without frames, the correlation of its events alone.

        Args:
            step: Ignored; Nerfstudio passes it.
            output_path: Folder for one picture a frame, recorded beside rendered.
            get_std: Give the standard deviation over the frames too.
        """
        views, summary = held_out_views(self)
        if output_path is not None:
            save_pictures(views, output_path)
        return summary | mean_scores(views, with_std=get_std)
