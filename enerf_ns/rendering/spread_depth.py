"""Depth spread from where it is known into plain regions, up to the edges of brightness and of depth."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from enerf_ns.rendering.field import DARKEST

EDGE_OF_BRIGHTNESS = 0.1
"""Difference of log brightness between neighbours that depth is spread over less by a factor of e."""

EDGE_OF_DEPTH = 0.02
"""Difference of log depth between neighbours that depth is spread over less by a factor of e."""

SMOOTHNESS = 100.0
"""How much smoothness weighs against depth that is known for sure."""

PASSES, ATTENUATION = 3, 0.25
"""Passes along rows and columns, and the share of the smoothness of one that the next takes."""

LEAST_WEIGHT = 1e-4
"""Weight of depth without any confidence."""

LEVELS_AN_EDGE = 4.0
"""Levels of the 8 bits of the guide for an edge that lessens spreading by e."""


class KnowsDepth(Protocol):
    """A model that tells how far the depth that it renders is known."""

    def depth_evidence(self, rays: RayBundle, depth: Tensor) -> tuple[Tensor, Tensor]: ...


def depth_evidence(
    model: KnowsDepth,
    rays: RayBundle,
    depth: Float[Tensor, "height width 1"],
    brightness: Float[Tensor, "height width channels"],
    scale: float,
) -> tuple[Float[Tensor, "height width 1"], Float[Tensor, "height width 1"]]:
    """How far the depth of a picture is known, from 0 to 1, and that depth spread from where it is.

    Args:
        model: That rendered the picture, in evaluation.
        rays: Of the picture.
        depth: Rendered, metres along the optical axis.
        brightness: Rendered, linear, 0 or more.
        scale: Scene units per metre.

    Returns:
        Confidence, as of `EnerfModel.depth_evidence`, and `spread_depth` of metres along the optical axis.
    """
    along = scale * rays.metadata["directions_norm"].to(depth.device)
    confidence, far = model.depth_evidence(rays, depth * along)
    return confidence, spread_depth(depth, far / along, confidence, brightness)


def spread_depth(
    depth: Float[Tensor, "height width 1"],
    far_depth: Float[Tensor, "height width 1"],
    confidence: Float[Tensor, "height width 1"],
    brightness: Float[Tensor, "height width channels"],
) -> Float[Tensor, "height width 1"]:
    """Depth where it is known, and elsewhere what the known depths around it make of it.

    Weighted least squares on inverse depth, in which planes are even: D. Min et al., "Fast Global Image Smoothing Based
    on Weighted Least Squares", TIP 2014, by OpenCV. The data are weighted by the square of their confidence. Where a
    ray's light comes from many places, they lean to the far ones: fog stands before surfaces, not behind.

    Args:
        depth: Of pixels, above 0, of any unit, along the optical axis or along rays.
        far_depth: Of `EnerfModel.depth_evidence`, of the same kind.
        confidence: From 0 to 1.
        brightness: Linear, 0 or more.

    Returns:
        Of the kind of the depth; all of it as it was where not all depth is finite and above 0.
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
            guide, picture, SMOOTHNESS, LEVELS_AN_EDGE, lambda_attenuation=ATTENUATION, num_iter=PASSES
        )

    spread = smooth(weight) / smooth(weight * inverse)
    return torch.from_numpy(spread)[..., None].to(depth)
