"""Spreads depth from pixels where it is known over untextured regions, up to edges of brightness and of depth."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from enerf_ns.rendering.field import DARKEST
from enerf_ns.rendering.seen_volume import is_rim

EDGE_OF_BRIGHTNESS = 0.1
"""Difference of log brightness between neighbours that weakens spreading by a factor of e."""

EDGE_OF_DEPTH = 0.02
"""Difference of log depth between neighbours that weakens spreading by a factor of e."""

SMOOTHNESS = 100.0
"""Weight of smoothness at which the depth of one picture is nearest to the true depth."""

PASSES, ATTENUATION = 3, 0.25
"""Number of passes along rows and columns, and the factor of smoothness from one pass to the next."""

LEAST_WEIGHT = 1e-4
"""Weight of depth of confidence 0."""

LEVELS_AN_EDGE = 4.0
"""Levels, of the 256 in the guide picture, for an edge that weakens spreading by a factor of e."""


class KnowsDepth(Protocol):
    """A model that returns the confidence in the depth that it renders, and the far depth."""

    def depth_evidence(self, rays: RayBundle, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Returns what `EnerfModel.depth_evidence` returns."""
        ...


def depth_evidence(
    model: KnowsDepth,
    rays: RayBundle,
    depth: Float[Tensor, "height width 1"],
    brightness: Float[Tensor, "height width channels"],
    scale: float,
    smoothness: float = SMOOTHNESS,
) -> tuple[Float[Tensor, "height width 1"], Float[Tensor, "height width 1"]]:
    """Returns the confidence in the depth of a picture, and the depth spread from pixels of high confidence.

    Args:
        model: The model that rendered the picture, in evaluation mode.
        rays: Rays of the picture.
        depth: Rendered depth along the optical axis, in metres.
        brightness: Rendered linear brightness, 0 or more.
        scale: Scene units per metre.
        smoothness: As in `spread_depth`.

    Returns:
        Confidence from 0 to 1 (`EnerfModel.depth_evidence`), which is 0 at rims (`is_rim`), and `spread_depth` along
        the optical axis, in metres, to which rims contribute.
    """
    along = scale * rays.metadata["directions_norm"].to(depth.device)
    confidence, far = model.depth_evidence(rays, depth * along)
    return confidence * ~is_rim(depth), spread_depth(depth, far / along, confidence, brightness, smoothness)


def spread_depth(
    depth: Float[Tensor, "height width 1"],
    far_depth: Float[Tensor, "height width 1"],
    confidence: Float[Tensor, "height width 1"],
    brightness: Float[Tensor, "height width channels"],
    smoothness: float = SMOOTHNESS,
) -> Float[Tensor, "height width 1"]:
    """Returns the depth where it is known, and depth spread from known pixels elsewhere.

    This is weighted least squares on inverse depth, in which a plane is linear: D. Min et al., "Fast Global Image
    Smoothing Based on Weighted Least Squares", TIP 2014, as OpenCV implements it. The weight of a pixel is the square
    of its confidence. At low confidence the pixel's value is near the far depth, since fog stands before surfaces and
    not behind them.

    Args:
        depth: Depth of pixels, above 0, in any unit, along the optical axis or along rays.
        far_depth: The far depth of `EnerfModel.depth_evidence`, in the same unit and direction.
        confidence: Confidence in depth, from 0 to 1.
        brightness: Linear brightness, 0 or more.
        smoothness: Weight of smoothness relative to depth of confidence 1.

    Returns:
        Depth in the unit and direction of `depth`. It is `depth` itself if any depth is not finite or not above 0.
    """
    if not ((depth > 0.0) & depth.isfinite() & (far_depth > 0.0) & far_depth.isfinite()).all():
        return depth
    sure = confidence.nan_to_num()
    inverse = (1.0 / (sure * depth + (1.0 - sure) * far_depth))[..., 0].float().cpu().numpy()
    logarithm = np.log(brightness.nan_to_num().clamp(min=DARKEST).mean(dim=-1).float().cpu().numpy())
    bright, near = (
        LEVELS_AN_EDGE * (values - values.min()) / edge
        for values, edge in ((logarithm, EDGE_OF_BRIGHTNESS), (np.log(inverse), EDGE_OF_DEPTH))
    )
    guide = np.stack([bright, near, near - 255.0], axis=-1).clip(0, 255).astype(np.uint8)
    weight = (sure[..., 0].float().cpu().numpy() ** 2 + LEAST_WEIGHT).astype(np.float32)

    def smooth(picture: np.ndarray) -> np.ndarray:
        return cv2.ximgproc.fastGlobalSmootherFilter(
            guide, picture, smoothness, LEVELS_AN_EDGE, lambda_attenuation=ATTENUATION, num_iter=PASSES
        )

    spread = smooth(weight) / smooth(weight * inverse)
    return torch.from_numpy(spread)[..., None].to(depth)
