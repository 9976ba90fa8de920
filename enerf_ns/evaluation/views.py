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
from jaxtyping import Float
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track
from torch import Tensor

from enerf_ns.dataparsers.errors import OutputError
from enerf_ns.dataparsers.files import write_whole
from enerf_ns.enerf_datamanager import EnerfDataManager
from enerf_ns.enerf_model import EnerfModel
from enerf_ns.evaluation.metrics import Score, align_brightness, align_channels, fit_fault, is_known


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
def held_out_view(pipeline: RenderingPipeline, number: int, reduced_by: int = 1) -> HeldOutView:
    """Render one held-out frame, its brightness as it is.

    Args:
        pipeline: With a trained field, as in evaluation.
        number: Of the held-out frame, from 0.
        reduced_by: Pixels along the squares that one pixel of the view stands for: the frame is their mean, its depth
            is unknown where that of any of them is, and rays go through their middles.
    """
    manager = pipeline.datamanager
    dataset, metres = manager.eval_dataset, 1.0 / manager.train_dataparser_outputs.dataparser_scale
    data = dataset[number]
    camera = dataset.cameras[number : number + 1].to(pipeline.device)
    if reduced_by > 1:
        size = camera.height // reduced_by, camera.width // reduced_by
        camera.rescale_output_resolution(1.0 / reduced_by)
        camera.height, camera.width = size
    rays = camera.generate_rays(camera_indices=0, keep_shape=True)
    outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
    z_depth = metres * outputs["depth"] / rays.metadata["directions_norm"]
    depth = data.get("depth")
    if depth is not None and reduced_by > 1:
        depth = _reduced(depth, reduced_by) * (_reduced(is_known(depth).float(), reduced_by) == 1.0)
    return HeldOutView(
        recorded=_reduced(data["image"][..., :3], reduced_by) if dataset.are_frames else None,
        rendered=outputs["rgb"].cpu(),
        unaligned=outputs["rgb"].cpu(),
        depth=z_depth.cpu(),
        recorded_depth=depth,
        time=int(dataset.frames.times[number]),
    )


def _reduced(picture: Tensor, by: int) -> Tensor:
    """Means over squares of pixels of a picture (height, width, channels); rows and columns left over are cut off."""
    return torch.nn.functional.avg_pool2d(picture.movedim(-1, 0), by).movedim(0, -1) if by > 1 else picture


@torch.no_grad()
def held_out_views(
    pipeline: RenderingPipeline, numbers: Sequence[int] | None = None, reduced_by: int = 1
) -> tuple[list[HeldOutView], dict[str, Score]]:
    """Render held-out frames; align brightness over all of them where the field learnt from events alone.

    Args:
        pipeline: With a trained field.
        numbers: Of the held-out frames, from 0. None: all, with a bar that shows how far it is.
        reduced_by: As of `held_out_view`.

    Returns:
        The views, and numbers about the whole set: rendering speed; scale and offset of the brightness fit, of
        each channel where the sensor has a colour filter; for a recording without frames, the correlation of its
        events, or why there is none.
    """
    pipeline.eval()
    manager = pipeline.datamanager
    dataset = manager.eval_dataset
    start = time.perf_counter()
    chosen = range(len(dataset)) if numbers is None else numbers
    shown = track(chosen, "Rendering held-out frames", console=CONSOLE, transient=True, disable=numbers is not None)
    views = [held_out_view(pipeline, number, reduced_by) for number in shown]
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
        try:
            write_whole(folder / f"eval_img_{index:04d}.png", png(torch.cat(shown, dim=1)))
        except OSError as error:
            raise OutputError(
                f"The folder of pictures {folder} could not be written to ({error.strerror}); give another one."
            ) from error


def png(picture: Float[Tensor, "height width 3"]) -> bytes:
    """A picture in [0, 1] as a PNG file; what is not finite is black or white."""
    content = io.BytesIO()
    pixels = (255.0 * picture.nan_to_num().clamp(0.0, 1.0).cpu().numpy()).round().astype(np.uint8)
    Image.fromarray(pixels).save(content, format="png")
    return content.getvalue()
