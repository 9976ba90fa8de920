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
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
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
from enerf_ns.sensor.response import Gamma
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.spread_depth import depth_evidence

EXPECTED_SCALE = "brightness_scale_expected"
"""Name of what the brightness_scale of log-affine-set should be."""


class RenderingPipeline(Protocol):
    """What is asked of a pipeline: those of this package have it all."""

    datamanager: EnerfDataManager

    @property
    def model(self) -> EnerfModel: ...

    @property
    def device(self) -> Any: ...

    def event_scores(self) -> dict[str, Score]: ...

    def eval(self) -> Any: ...

    def train(self) -> Any: ...


@dataclass
class HeldOutView:
    """One held-out frame and what the field shows there. Tensors of shape (height, width, channels) on the CPU."""

    recorded: Tensor | None
    """Frame in [0, 1], three channels; None where the recording has no frames."""
    rendered: Tensor
    """Render as the field has it: linear brightness, three channels; where the exposure of each frame is learned, with
    that between the frames next to it in time."""
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
    confidence: Tensor | None = None
    """How far the rendered depth is known, from 0 to 1, one channel; None where that was not asked for."""
    spread_depth: Tensor | None = None
    """Rendered depth in metres along the optical axis, spread from where it is known (`enerf_ns.spread_depth`), one
    channel; None where the confidence is."""

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

        names = ("recorded", "rendered", "depth", "recorded_depth", "confidence", "spread_depth")
        return replace(self, **{name: cut(getattr(self, name)) for name in names})

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
    data, rays, time = dataset[number], _rays(pipeline, number, reduced_by), int(dataset.frames.times[number])
    outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
    z_depth = metres * outputs["depth"] / rays.metadata["directions_norm"]
    rendered, exposure = outputs["rgb"], pipeline.model.exposure
    if exposure is not None:
        gain, offset = exposure.at(time)
        rendered = (gain * rendered + offset).clamp(min=0.0)
    depth = data.get("depth")
    if depth is not None and reduced_by > 1:
        depth = _reduced(depth, reduced_by) * (_reduced(is_known(depth).float(), reduced_by) == 1.0)
    return HeldOutView(
        recorded=_reduced(data["image"][..., :3], reduced_by) if dataset.are_frames else None,
        rendered=rendered.cpu(),
        depth=z_depth.cpu(),
        recorded_depth=depth,
        time=time,
        colour_filter=pipeline.model.sensor.colour_filter is not None,
    )


def _rays(pipeline: RenderingPipeline, number: int, reduced_by: int = 1) -> RayBundle:
    """Rays of a held-out frame, shape (height, width), as of `held_out_view`."""
    camera = pipeline.datamanager.eval_dataset.cameras[number : number + 1].to(pipeline.device)
    if reduced_by > 1:
        size = camera.height // reduced_by, camera.width // reduced_by
        camera.rescale_output_resolution(1.0 / reduced_by)
        camera.height, camera.width = size
    return camera.generate_rays(camera_indices=0, keep_shape=True)


def _with_evidence(pipeline: RenderingPipeline, view: HeldOutView, number: int, reduced_by: int) -> HeldOutView:
    """The view with how far its depth is known, and with its depth spread from there."""
    rays, scale = _rays(pipeline, number, reduced_by), pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    confidence, spread = depth_evidence(pipeline.model, rays, view.depth, view.rendered, scale)
    return replace(view, confidence=confidence, spread_depth=spread)


def _reduced(picture: Tensor, by: int) -> Tensor:
    """Means over squares of pixels of a picture (height, width, channels); rows and columns left over are cut off."""
    return torch.nn.functional.avg_pool2d(picture.movedim(-1, 0), by).movedim(0, -1) if by > 1 else picture


@torch.no_grad()
def held_out_views(
    pipeline: RenderingPipeline, numbers: Sequence[int] | None = None, reduced_by: int = 1, evidence: bool = True
) -> tuple[list[HeldOutView], dict[str, Score]]:
    """Render held-out frames.

    Args:
        pipeline: With a trained field.
        numbers: Of the held-out frames, from 0. None: all, with a bar that shows how far it is.
        reduced_by: As of `held_out_view`.
        evidence: Find out how far depth is known, and spread it from there, which takes longer than rendering.

    Returns:
        The views, and numbers about the whole set: rendering speed, and the `held_out_numbers`, and where a run learnt
        from events whose thresholds the recording states, `EXPECTED_SCALE`, the `expected_brightness_scale`;
        for a recording without frames, the correlation of its events, or why there is none.
    """
    pipeline.eval()
    manager = pipeline.datamanager
    dataset = manager.eval_dataset
    start = time.perf_counter()
    chosen = range(len(dataset)) if numbers is None else numbers
    shown = track(chosen, "Rendering held-out frames", console=CONSOLE, transient=True, disable=numbers is not None)
    views = [held_out_view(pipeline, number, reduced_by) for number in shown]
    seconds = time.perf_counter() - start
    if evidence:
        views = [_with_evidence(pipeline, *both, reduced_by) for both in zip(views, chosen, strict=True)]
    summary: dict[str, Score] = {
        "num_rays_per_sec": sum(view.depth.numel() for view in views) / seconds,
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


def expected_brightness_scale(contrast_thresholds: tuple[float, float], sensor: SensorModel) -> float:
    """What the scale of the fit of log-affine-set is for a field that explains all events.

    Events count changes of log brightness in thresholds, so that the field has its contrast in those that it learnt
    with: with too high ones it shows too much, which the fit takes back.

    Args:
        contrast_thresholds: C_on and C_off of the sensor that made the events.
        sensor: The one that the field learnt with.
    """
    encoding = sensor.response.exponent if isinstance(sensor.response, Gamma) else 1.0
    return encoding * 0.5 * sum(contrast_thresholds) / float(sensor.mean_threshold)


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
