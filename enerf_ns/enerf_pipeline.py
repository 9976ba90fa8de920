"""Evaluation over the whole set of held-out frames."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track
from torch import Tensor
from tyro.conf import Fixed, Suppress

from enerf_ns.checkpoints import allow_numpy_scalars_in_checkpoints
from enerf_ns.choices import MethodDefaults, Resolution, resolve
from enerf_ns.dataparsers.errors import exit_with_a_sentence
from enerf_ns.enerf_datamanager import EnerfDataManager, EnerfDataManagerConfig
from enerf_ns.enerf_model import EnerfModel, EnerfModelConfig
from enerf_ns.evaluation.lpips import lpips
from enerf_ns.evaluation.metrics import align_brightness, align_channels, correlation, depth_rmse, image_metrics
from enerf_ns.ffmpeg import make_ffmpeg_available
from enerf_ns.supervision.event_supervision import brightness_change


@dataclass
class EnerfPipelineConfig(VanillaPipelineConfig):
    """Nerfstudio's pipeline, with one brightness fit over all held-out frames."""

    _target: Type = field(default_factory=lambda: EnerfPipeline)  # noqa: UP006
    datamanager: EnerfDataManagerConfig = field(default_factory=EnerfDataManagerConfig)
    model: EnerfModelConfig = field(default_factory=EnerfModelConfig)
    defaults: Fixed[Suppress[MethodDefaults]] = field(default_factory=MethodDefaults)
    """What is used where neither flag nor preset says otherwise."""
    resolution: Fixed[Suppress[Resolution]] = field(default_factory=Resolution)
    """What was chosen for the recording, and why; empty before that."""

    def setup(self, **kwargs: Any) -> EnerfPipeline:
        """The pipeline, with what the resolution says in place of what is open here.

        Raises:
            SystemExit: The recording cannot be used, or not so; with one sentence.
        """
        make_ffmpeg_available()
        allow_numpy_scalars_in_checkpoints()
        with exit_with_a_sentence():
            resolution = self.resolution
            if not resolution.choices:
                resolution = resolve(self, self.datamanager.dataparser.setup().recording())
            return self._target(resolution.applied_to(self), **kwargs)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Reads config.yml of runs from before choices were stored apart from what was set, too."""
        self.__dict__.update({"defaults": MethodDefaults(), "resolution": Resolution(), **state})


@dataclass
class HeldOutView:
    """One held-out frame and what the field shows there. Tensors of shape (height, width, channels) on the CPU."""

    recorded: Tensor | None
    """Frame in [0, 1], three channels; None where the recording has no frames."""
    rendered: Tensor
    """Render in [0, 1], three channels, its brightness aligned where absolute brightness is not observable."""
    unaligned: Tensor
    """Render before its brightness was aligned."""
    depth: Tensor
    """Rendered depth in metres along the optical axis, one channel."""
    recorded_depth: Tensor | None
    """Depth in metres along the optical axis, 0 where unknown; None where the recording has none."""
    time: int
    """Instant in ns."""


class EnerfPipeline(VanillaPipeline):
    """Scores held-out frames together, because events fix brightness only up to one scale and offset."""

    datamanager: EnerfDataManager
    config: EnerfPipelineConfig

    @property
    def model(self) -> EnerfModel:
        return super().model  # type: ignore

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of the next batch."""
        sensor = self.model.sensor
        batch = self.datamanager.next_batch(sensor)
        outputs = self._model(self.datamanager.rays(batch, sensor))
        metrics = self.model.get_metrics_dict(outputs, batch)
        return outputs, self.model.get_loss_dict(outputs, batch, metrics), metrics

    def get_eval_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        """As `get_train_loss_dict`, rendered as in evaluation."""
        self.eval()
        with torch.no_grad():
            results = self.get_train_loss_dict(step)
        self.train()
        return results

    @torch.no_grad()
    def held_out_views(self) -> tuple[list[HeldOutView], dict[str, float]]:
        """Render every held-out frame; align brightness over all of them where the field learnt from events alone.

        Returns:
            The views, and numbers about the whole set: rendering speed; scale and offset of the brightness fit, of
            each channel where the sensor has a colour filter; for a recording without frames, the correlation of its
            events.
        """
        self.eval()
        manager = self.datamanager
        dataset, metres = manager.eval_dataset, 1.0 / manager.train_dataparser_outputs.dataparser_scale
        has_frames = dataset.are_frames
        views: list[HeldOutView] = []
        start = time.perf_counter()
        for index in track(range(len(dataset)), "Rendering held-out frames", console=CONSOLE, transient=True):
            data = dataset[index]
            camera = dataset.cameras[index : index + 1].to(self.device)
            rays = camera.generate_rays(camera_indices=0, keep_shape=True)
            outputs = self.model.get_outputs_for_camera_ray_bundle(rays)
            z_depth = metres * outputs["depth"] / rays.metadata["directions_norm"]
            views.append(
                HeldOutView(
                    recorded=data["image"][..., :3] if has_frames else None,
                    rendered=outputs["rgb"].cpu(),
                    unaligned=outputs["rgb"].cpu(),
                    depth=z_depth.cpu(),
                    recorded_depth=data.get("depth"),
                    time=int(dataset.frames.times[index]),
                )
            )
        seconds = time.perf_counter() - start
        summary = {
            "num_rays_per_sec": sum(view.depth.numel() for view in views) / seconds,
            "fps": len(views) / seconds,
        }
        if not has_frames:
            summary["event_correlation"] = self.event_correlation()
        elif manager.config.supervision == "events":
            recorded = [view.recorded for view in views if view.recorded is not None]
            rendered = [view.rendered for view in views]
            if dataset.recording.bayer_pattern is None:
                aligned, fit = align_brightness(rendered, recorded)
                fits = {"": fit}
            else:
                aligned, channel_fits = align_channels(rendered, recorded)
                fits = dict(zip(("_red", "_green", "_blue"), channel_fits, strict=True))
            for view, image in zip(views, aligned, strict=True):
                view.rendered = image
            for name, (scale, offset) in fits.items():
                summary |= {f"brightness_scale{name}": scale, f"brightness_offset{name}": offset}
        self.train()
        return views, summary

    @torch.no_grad()
    def event_correlation(self, num_pairs: int = 8192) -> float:
        """Linear correlation of rendered and measured changes of log brightness over random event pairs.

        What can be said of a field whose recording has no frames; the pairs are drawn from those of the training.
        """
        self.eval()
        manager, sensor = self.datamanager, self.model.sensor
        generator = torch.Generator(self.device).manual_seed(0)
        batch = manager.pair_sampler.sample(num_pairs, generator)
        rays = manager.event_rays(batch, sensor).reshape((2, num_pairs))
        start, end = self.model.get_outputs_for_camera_ray_bundle(rays)["rgb"]
        self.train()
        change = brightness_change(start, end, batch, sensor)
        return correlation(change, sensor.measured_change(batch.on, batch.off, batch.pixels))

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
        views, summary = self.held_out_views()
        scores = [view_scores(view) for view in views]
        if output_path is not None:
            output_path.mkdir(parents=True, exist_ok=True)
            for index, view in enumerate(views):
                shown = [view.rendered] if view.recorded is None else [view.recorded, view.rendered]
                picture = torch.cat(shown, dim=1).clamp(0.0, 1.0)
                Image.fromarray((255.0 * picture.numpy()).round().astype(np.uint8)).save(
                    output_path / f"eval_img_{index:04d}.png"
                )
        for key in scores[0]:
            values = [score[key] for score in scores]
            summary[key] = float(np.mean(values))
            if get_std:
                summary[f"{key}_std"] = float(np.std(values))
        return summary


def view_scores(view: HeldOutView) -> dict[str, float]:
    """Scores of one held-out frame; none where there is no frame.

    The correlation is that of the render as it is, before brightness is aligned.
    """
    if view.recorded is None:
        return {}
    scores = image_metrics(view.rendered, view.recorded)
    scores["correlation"] = correlation(view.unaligned, view.recorded)
    perceptual = lpips(view.rendered, view.recorded)
    if perceptual is not None:
        scores["lpips"] = perceptual
    if view.recorded_depth is not None:
        scores["depth_rmse"] = depth_rmse(view.depth, view.recorded_depth)
    return scores
