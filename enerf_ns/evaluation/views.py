"""Held-out frames, and what a field shows there."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track
from torch import Tensor

from enerf_ns.dataparsers.errors import FlagError, OutputError
from enerf_ns.dataparsers.files import write_whole
from enerf_ns.enerf_datamanager import EnerfDataManager
from enerf_ns.enerf_model import EnerfModel
from enerf_ns.evaluation.held_out_poses import held_out_numbers
from enerf_ns.evaluation.metrics import Score, is_known
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align


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
    """Render as the field has it: linear brightness, 0 or more, three channels."""
    depth: Tensor
    """Rendered depth in metres along the optical axis, one channel."""
    recorded_depth: Tensor | None
    """Depth in metres along the optical axis, 0 where unknown; None where the recording has none."""
    time: int
    """Instant of the view, ns."""
    colour_filter: bool = False
    """Whether the sensor has a colour filter, so that events leave the brightness of each channel open by itself."""
    not_aligned: str | None = None
    """Of `aligned_views`, why the brightness of the render, which should be aligned, is not; None where it is."""

    def cropped(self, height: int, width: int) -> HeldOutView:
        """The middle of the view.

        Raises:
            FlagError: It is larger than the view.
        """
        whole = self.rendered.shape[:2]
        if not (0 < height <= whole[0] and 0 < width <= whole[1]):
            raise FlagError(
                f"A crop of {height} x {width} pixels (height, width) does not lie in held-out frames of {whole[0]} x "
                f"{whole[1]}; give a smaller one."
            )
        top, left = (whole[0] - height) // 2, (whole[1] - width) // 2

        def cut(picture: Tensor | None) -> Any:
            return picture if picture is None else picture[top : top + height, left : left + width]

        pictures = {name: cut(getattr(self, name)) for name in ("recorded", "rendered", "depth", "recorded_depth")}
        return replace(self, **pictures)

    @property
    def median_depth(self) -> float:
        """Median depth in metres, of what is known of the recorded one, else of what is finite of the rendered one;
        1 where there is neither."""
        for depth in (self.recorded_depth, self.depth):
            known = None if depth is None else depth[is_known(depth)]
            if known is not None and len(known):
                return float(known.median())
        return 1.0


@torch.no_grad()
def held_out_views(
    pipeline: RenderingPipeline, numbers: Sequence[int] | None = None
) -> tuple[list[HeldOutView], dict[str, Score]]:
    """Render held-out frames.

    Args:
        pipeline: With a trained field.
        numbers: Of the held-out frames, from 0. None: all.

    Returns:
        The views, and numbers about the whole set: rendering speed, and the `held_out_numbers`; for a recording without
        frames, the correlation of its events, or why there is none.
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
                depth=z_depth.cpu(),
                recorded_depth=data.get("depth"),
                time=int(dataset.frames.times[index]),
                colour_filter=pipeline.model.sensor.colour_filter is not None,
            )
        )
    seconds = time.perf_counter() - start
    summary: dict[str, Score] = {
        "num_rays_per_sec": sum(view.depth.numel() for view in views) / seconds,
        "fps": len(views) / seconds,
    }
    if not dataset.are_frames:
        summary["event_correlation"] = pipeline.event_correlation()
    else:
        depths = np.array([view.median_depth for view in views])
        summary |= held_out_numbers(manager, np.array(chosen), depths)
    pipeline.train()
    return views, summary


def aligned_views(
    views: Sequence[HeldOutView], protocol: str = DEFAULT_PROTOCOL
) -> tuple[list[HeldOutView], dict[str, float]]:
    """The views as a protocol compares them, to be shown; those without frames as they are.

    Args:
        views: As `held_out_views` gives them.
        protocol: Name of one of `PROTOCOLS`.

    Returns:
        The views, whose renders are not clipped, and the parameters of the one fit over all of them, by name.
    """
    framed = [view for view in views if view.recorded is not None]
    if not framed:
        return list(views), {}
    recorded = [view.recorded for view in framed if view.recorded is not None]
    pictures = align([view.rendered for view in framed], recorded, protocol, framed[0].colour_filter)
    columns = zip(framed, pictures.rendered, pictures.recorded, pictures.faults, strict=True)
    aligned = iter([replace(view, rendered=a, recorded=b, not_aligned=fault) for view, a, b, fault in columns])
    return [view if view.recorded is None else next(aligned) for view in views], pictures.parameters


def save_pictures(views: Sequence[HeldOutView], folder: Path) -> None:
    """Write one picture a view, eval_img_0000.png and so on: the frame, where there is one, beside the render.

    Args:
        views: In the order of their numbers, as `aligned_views` gives them.
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
