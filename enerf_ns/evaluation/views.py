"""Held-out views: a frame, and the render at its pose, as pictures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from enerf_ns.dataparsers.recording.errors import FlagError, OutputError
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.evaluation.metrics import is_known
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align

EXPECTED_SCALE = "brightness_scale_expected"
"""Name of the expected value of brightness_scale in the protocol log-affine-set."""


@dataclass
class HeldOutView:
    """One held-out frame and the render at its pose. Tensors (height, width, channels) are on the CPU."""

    recorded: Tensor | None
    """Frame in [0, 1], three channels; None if the recording has no frames."""
    rendered: Tensor
    """Linear brightness that the field renders, three channels. If exposures of frames are learned, it has the exposure
    interpolated between the neighbouring training frames."""
    depth: Tensor | None
    """Rendered depth in metres along the optical axis, one channel; None for a panorama, which has no depth."""
    recorded_depth: Tensor | None
    """Depth in metres along the optical axis, 0 where unknown; None if the recording or the field has no depth."""
    time: int
    """Instant of the view, ns."""
    colour_filter: bool = False
    """Whether the sensor has a colour filter. Events then do not determine the offsets between channels."""
    not_aligned: str | None = None
    """Reason why `aligned_views` could not correct the brightness of the render; None if it could."""
    confidence: Tensor | None = None
    """Confidence of the rendered depth, 0 to 1, one channel; None if not computed."""
    spread_depth: Tensor | None = None
    """Rendered depth in metres along the optical axis, spread from where it is known
    (`enerf_ns.rendering.spread_depth`), one channel; None if not computed."""

    def cropped(self, height: int, width: int) -> HeldOutView:
        """The central part of the view, of this height and width in pixels.

        Raises:
            FlagError: The part is larger than the view.
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
        """Median known recorded depth in metres. If there is none, the median finite rendered depth; otherwise 1."""
        for depth in (self.recorded_depth, self.depth):
            known = None if depth is None else depth[is_known(depth)]
            if known is not None and len(known):
                return float(known.median())
        return 1.0


def aligned_views(
    views: Sequence[HeldOutView], protocol: str = DEFAULT_PROTOCOL, encoded: bool = True
) -> tuple[list[HeldOutView], dict[str, float]]:
    """Views whose brightness a protocol has corrected. Views without frames stay unchanged.

    Args:
        views: As `held_out_views` gives them.
        protocol: Name of one of `PROTOCOLS`.
        encoded: Whether pictures become the values that the protocol compares; otherwise they hold linear brightness.

    Returns:
        The views, whose renders are not clipped, and the parameters of the one fit over all of them, by name.
    """
    framed = [view for view in views if view.recorded is not None]
    if not framed:
        return list(views), {}
    recorded = [view.recorded for view in framed if view.recorded is not None]
    pictures = align([view.rendered for view in framed], recorded, protocol, framed[0].colour_filter, encoded)
    columns = zip(framed, pictures.rendered, pictures.recorded, pictures.faults, strict=True)
    aligned = iter([replace(view, rendered=a, recorded=b, not_aligned=fault) for view, a, b, fault in columns])
    return [view if view.recorded is None else next(aligned) for view in views], pictures.parameters


def save_pictures(views: Sequence[HeldOutView], folder: Path) -> None:
    """Writes a picture of each view, eval_img_0000.png and so on: the frame, if there is one, beside the render.

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
    """A picture in [0, 1] as a PNG file. Values that are not finite become black or white."""
    content = io.BytesIO()
    pixels = (255.0 * picture.nan_to_num().clamp(0.0, 1.0).cpu().numpy()).round().astype(np.uint8)
    Image.fromarray(pixels).save(content, format="png")
    return content.getvalue()
