"""Held-out frames, and what a field shows there."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track
from torch import Tensor

from enerf_ns.dataparsers.errors import OutputError
from enerf_ns.dataparsers.files import write_whole
from enerf_ns.enerf_datamanager import EnerfDataManager
from enerf_ns.enerf_model import EnerfModel
from enerf_ns.evaluation.metrics import Score, align_brightness, align_channels, fit_fault


class RenderingPipeline(Protocol):
    """What is asked of a pipeline: those of this package have it all."""

    datamanager: EnerfDataManager

    @property
    def model(self) -> EnerfModel: ...

    @property
    def device(self) -> Any: ...

    def event_correlation(self) -> Score: ...

    def eval(self) -> Any: ...

    def train(self) -> Any: ...


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
    """Instant of the view, ns."""
    not_aligned: str | None = None
    """Why the brightness of the render, which should be aligned, is not; None where it is, or need not be."""


@torch.no_grad()
def held_out_views(
    pipeline: RenderingPipeline, numbers: Sequence[int] | None = None
) -> tuple[list[HeldOutView], dict[str, Score]]:
    """Render held-out frames; align brightness over all of them where the field learnt from events alone.

    Args:
        pipeline: With a trained field.
        numbers: Of the held-out frames, from 0. None: all.

    Returns:
        The views, and numbers about the whole set: rendering speed; scale and offset of the brightness fit, of
        each channel where the sensor has a colour filter; for a recording without frames, the correlation of its
        events, or why there is none.
    """
    pipeline.eval()
    manager = pipeline.datamanager
    dataset, metres = manager.eval_dataset, 1.0 / manager.train_dataparser_outputs.dataparser_scale
    views: list[HeldOutView] = []
    start = time.perf_counter()
    chosen = range(len(dataset)) if numbers is None else numbers
    for index in track(chosen, "Rendering held-out frames", console=CONSOLE, transient=True):
        data = dataset[index]
        camera = dataset.cameras[index : index + 1].to(pipeline.device)
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
        z_depth = metres * outputs["depth"] / rays.metadata["directions_norm"]
        views.append(
            HeldOutView(
                recorded=data["image"][..., :3] if dataset.are_frames else None,
                rendered=outputs["rgb"].cpu(),
                unaligned=outputs["rgb"].cpu(),
                depth=z_depth.cpu(),
                recorded_depth=data.get("depth"),
                time=int(dataset.frames.times[index]),
            )
        )
    seconds = time.perf_counter() - start
    summary: dict[str, Score] = {
        "num_rays_per_sec": sum(view.depth.numel() for view in views) / seconds,
        "fps": len(views) / seconds,
    }
    if not dataset.are_frames:
        summary["event_correlation"] = pipeline.event_correlation()
    elif manager.config.supervision == "events":
        summary |= _align(views, each_channel=pipeline.model.sensor.colour_filter is not None)
    pipeline.train()
    return views, summary


def _align(views: Sequence[HeldOutView], each_channel: bool) -> dict[str, float]:
    """Fits the brightness of all finite renders at once, in place, and returns scale and offset."""
    finite = [view for view in views if view.rendered.isfinite().all()]
    if not finite:
        return {}
    recorded = [view.recorded for view in finite if view.recorded is not None]
    rendered = [view.rendered for view in finite]
    if each_channel:
        aligned, channel_fits = align_channels(rendered, recorded)
        fits = dict(zip(("_red", "_green", "_blue"), channel_fits, strict=True))
    else:
        aligned, fit = align_brightness(rendered, recorded)
        fits = {"": fit}
    fault = fit_fault(list(fits.values()))
    for view, image in zip(finite, aligned, strict=True):
        view.not_aligned = fault
        if fault is None:
            view.rendered = image
    summary = {}
    for name, (scale, offset) in fits.items():
        summary |= {f"brightness_scale{name}": scale, f"brightness_offset{name}": offset}
    return summary


def save_pictures(views: Sequence[HeldOutView], folder: Path) -> None:
    """Write one picture a view, eval_img_0000.png and so on: the frame, where there is one, beside the render.

    Args:
        views: In the order of their numbers.
        folder: Made if it does not exist.

    Raises:
        OutputError: The folder cannot be written to, or the disk is full.
    """
    for index, view in enumerate(views):
        shown = [view.rendered] if view.recorded is None else [view.recorded, view.rendered]
        picture = torch.cat(shown, dim=1).nan_to_num().clamp(0.0, 1.0)
        content = io.BytesIO()
        Image.fromarray((255.0 * picture.numpy()).round().astype(np.uint8)).save(content, format="png")
        try:
            write_whole(folder / f"eval_img_{index:04d}.png", content.getvalue())
        except OSError as error:
            raise OutputError(
                f"The folder of pictures {folder} could not be written to ({error.strerror}); give another one."
            ) from error
