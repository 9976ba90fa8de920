"""Held-out frames that a run renders, and numbers about them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor

from enerf_ns.evaluation.metrics import Score, is_known
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import EXPECTED_SCALE, HeldOutView
from enerf_ns.method.datamanager import EnerfDataManager
from enerf_ns.method.held_out_poses import held_out_numbers
from enerf_ns.method.model import EnerfModel
from enerf_ns.poses.corrections import Corrections
from enerf_ns.rendering.spread_depth import depth_evidence
from enerf_ns.sensor.response import Gamma
from enerf_ns.sensor.sensor_model import SensorModel


class RenderingPipeline(Protocol):
    """The part of a pipeline that rendering held-out frames needs. Pipelines of this package have it."""

    datamanager: EnerfDataManager

    @property
    def model(self) -> EnerfModel: ...

    @property
    def device(self) -> Any: ...

    def event_scores(self) -> dict[str, Score]: ...

    def eval(self) -> Any: ...

    def train(self) -> Any: ...


@torch.no_grad()
def held_out_view(pipeline: RenderingPipeline, number: int, reduced_by: int = 1) -> HeldOutView:
    """Renders one held-out frame. Its brightness is not aligned.

    Args:
        pipeline: Pipeline with a trained field, in evaluation mode.
        number: Number of the held-out frame, from 0.
        reduced_by: Side of the square of pixels that becomes one pixel of the view. The frame is averaged over it,
            depth is unknown if it is unknown at any of its pixels, and the ray goes through its middle.
    """
    manager = pipeline.datamanager
    dataset, metres = manager.eval_dataset, 1.0 / manager.train_dataparser_outputs.dataparser_scale
    data, rays, time = dataset[number], _rays(pipeline, number, reduced_by), int(dataset.frames.times[number])
    outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
    z_depth = metres * outputs["depth"] / rays.metadata["directions_norm"]
    rendered, exposure = outputs["rgb"], pipeline.model.exposure
    if exposure is not None:
        gain, offset = exposure.at(time)
        rendered = (gain * rendered + offset).clamp(min=0.0)
    has_depth = not pipeline.model.config.panorama
    depth = data.get("depth") if has_depth else None
    if depth is not None and reduced_by > 1:
        depth = _reduced(depth, reduced_by) * (_reduced(is_known(depth).float(), reduced_by) == 1.0)
    return HeldOutView(
        recorded=_reduced(data["image"][..., :3], reduced_by) if dataset.are_frames else None,
        rendered=rendered.cpu(),
        depth=z_depth.cpu() if has_depth else None,
        recorded_depth=depth,
        time=time,
        colour_filter=pipeline.model.sensor.colour_filter is not None,
    )


@torch.no_grad()
def held_out_views(
    pipeline: RenderingPipeline, numbers: Sequence[int] | None = None, reduced_by: int = 1, evidence: bool = True
) -> tuple[list[HeldOutView], dict[str, Score]]:
    """Renders held-out frames.

    Args:
        pipeline: Pipeline with a trained field.
        numbers: Numbers of the held-out frames, from 0. Default: all frames, with a progress bar.
        reduced_by: Side of the square of pixels that becomes one pixel, as in `held_out_view`.
        evidence: Compute the confidence in depth, and spread depth from confident pixels, which takes longer than
            rendering.

    Returns:
        The views, and numbers about all of them: the speed of rendering, the `held_out_numbers`, and
        `expected_brightness_scale` as `EXPECTED_SCALE` if the run learnt from events and the recording states their
        thresholds. For a recording without frames, there are the scores of its events instead.
    """
    pipeline.eval()
    manager = pipeline.datamanager
    dataset = manager.eval_dataset
    start = time.perf_counter()
    chosen = range(len(dataset)) if numbers is None else numbers
    shown = track(
        chosen,
        "Rendering held-out frames",
        console=CONSOLE,
        transient=True,
        disable=numbers is not None or not CONSOLE.is_terminal,
    )
    views = [held_out_view(pipeline, number, reduced_by) for number in shown]
    seconds = time.perf_counter() - start
    if evidence:
        views = [_with_evidence(pipeline, *both, reduced_by) for both in zip(views, chosen, strict=True)]
    summary: dict[str, Score] = {
        "num_rays_per_sec": sum(view.rendered[..., 0].numel() for view in views) / seconds,
        "fps": len(views) / seconds,
    }
    if not dataset.are_frames:
        summary |= pipeline.event_scores()
    else:
        depths = np.array([view.median_depth for view in views])
        summary |= held_out_numbers(manager, np.array(chosen), depths)
        thresholds = dataset.recording.contrast_thresholds
        if thresholds is not None and "events" in manager.config.supervision:
            summary[EXPECTED_SCALE] = expected_brightness_scale(thresholds, pipeline.model.sensor)
    summary |= {f"sensor_{name}": value for name, value in pipeline.model.sensor.learned().items()}
    pipeline.train()
    return views, summary


def scores_at_stated_poses(pipeline: RenderingPipeline) -> dict[str, float]:
    """psnr, ssim and event_correlation of a run at the stated poses of its recording, without the corrections.

    The difference shows the benefit of the corrections. Scores without a value are left out.
    """
    manager = pipeline.datamanager
    corrected = manager.corrections
    manager.correct(Corrections())
    try:
        views, _ = held_out_views(pipeline, evidence=False)
        scores: dict[str, Any] = dict(pipeline.event_scores())
    finally:
        manager.correct(corrected)
    if any(view.recorded is not None for view in views):
        scores |= mean_scores(views, False, DEFAULT_PROTOCOL, ())[0]
    names = ("psnr", "ssim", "event_correlation")
    return {name: float(scores[name]) for name in names if isinstance(scores.get(name), float)}


def expected_brightness_scale(contrast_thresholds: tuple[float, float], sensor: SensorModel) -> float:
    """The scale that the protocol log-affine-set fits to a field that explains all events.

    Events count changes of log brightness in contrast thresholds. A field that learns with thresholds that are too high
    has too much contrast, which the fitted scale reduces.

    Args:
        contrast_thresholds: C_on and C_off of the sensor that made the events.
        sensor: Model of the sensor with which the field learnt.
    """
    encoding = sensor.response.exponent if isinstance(sensor.response, Gamma) else 1.0
    return encoding * 0.5 * sum(contrast_thresholds) / torch.as_tensor(sensor.mean_threshold).item()


def _rays(pipeline: RenderingPipeline, number: int, reduced_by: int = 1) -> RayBundle:
    """Rays of a held-out frame, shape (height, width), for `held_out_view`."""
    camera = pipeline.datamanager.eval_dataset.cameras[number : number + 1].to(pipeline.device)
    if reduced_by > 1:
        size = camera.height // reduced_by, camera.width // reduced_by
        camera.rescale_output_resolution(1.0 / reduced_by)
        camera.height, camera.width = size
    return camera.generate_rays(camera_indices=0, keep_shape=True)


def _with_evidence(pipeline: RenderingPipeline, view: HeldOutView, number: int, reduced_by: int) -> HeldOutView:
    """The view with its confidence in depth, and with depth spread from confident pixels, if it has depth."""
    if view.depth is None:
        return view
    rays, scale = _rays(pipeline, number, reduced_by), pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    confidence, spread = depth_evidence(pipeline.model, rays, view.depth, view.rendered, scale)
    return replace(view, confidence=confidence, spread_depth=spread)


def _reduced(picture: Tensor, by: int) -> Tensor:
    """Means over squares of pixels of a picture (height, width, channels). Rows and columns left over are cut off."""
    return torch.nn.functional.avg_pool2d(picture.movedim(-1, 0), by).movedim(0, -1) if by > 1 else picture
