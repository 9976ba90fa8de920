"""E-NeRF as a Nerfstudio model: from rays to brightness, from brightness to losses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Dict, Literal, Optional, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.losses import interlevel_loss, ray_samples_to_sdist
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer
from nerfstudio.model_components.scene_colliders import AABBBoxCollider, NearFarCollider
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter
from tyro.conf import Fixed

from enerf_ns.choices.brightness import MEAN_BRIGHTNESS
from enerf_ns.choices.frames import FRAME_LOSS_WEIGHT
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import FAINTEST
from enerf_ns.evaluation.metrics import psnr, ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align
from enerf_ns.events.batch import FrameBatch, TrainBatch
from enerf_ns.kernels.hash_grid import backend_of
from enerf_ns.method.memory import in_parts
from enerf_ns.rendering.density_voxels import DensityVoxels
from enerf_ns.rendering.field import EnerfField, HashDensity
from enerf_ns.rendering.front_to_back import front_to_back
from enerf_ns.rendering.ray_samplers import (
    PairedPiecewiseSampler,
    PairedProposalSampler,
    PairedUniformSampler,
    paired_rand,
)
from enerf_ns.rendering.seen_volume import SeenVolume, is_rim
from enerf_ns.sensor.sensor_model import SensorModelConfig
from enerf_ns.supervision.balance import ErrorBalance
from enerf_ns.supervision.event_supervision import EventSupervision, brightness_change
from enerf_ns.supervision.frame_exposure import FrameExposure
from enerf_ns.supervision.losses import distortion_loss, frame_loss

FAINT = 5e-4
"""Part of the accumulation of a ray that a picture may lack: so much behind the last sample that is rendered, and as
much in samples of low weight."""

AROUND_DEPTH = 0.05
"""Largest distance between a sample and the ray's depth at which the sample's weight counts as confidence, as a share
of the depth. Of shares of 2, 5 and 10 %, this one separates depths that are right within 5 % best from others."""

FAR_SHARE = 0.75
"""Part of the accumulation of a ray that lies nearer than its far depth."""

FOG_CONTRACTS = (0.2, 0.5, 0.6, 0.8)
"""Shares of the training at which the weight of the distortion loss begins to grow, is largest, begins to fall, and is
as before. Earlier, the depth of fog is not yet right, and surfaces would stay where it is wrong. Later, too few steps
are left to learn brightness at the surfaces."""

FEWEST_STEPS = 2000
"""Fewest steps of a training in which that weight grows. In shorter ones, brightness is not learned anew at the
surfaces where the sensor has faults."""

FOG_GROWTH = 30.0
"""Factor by which the weight of the distortion loss grows. Runs without events keep the weight, since their losses have
another scale."""

FARTHEST = 1000.0
"""Far end of the rays where space is contracted, in scene units (halves of the longest side of the box)."""

PANORAMA = (10.0, 10.02)
"""Ends of the rays of a panorama, in scene units: outside the box, where the motion of a camera that only turns moves
no point, and one after the other within about a cell of the finest level."""

PANORAMA_SAMPLES = 2
"""Samples along a ray of a panorama."""

PANORAMA_DENSITY = 1e3
"""Density of a panorama before training, in 1 / scene unit: it is opaque."""


@dataclass
class EnerfModelConfig(ModelConfig):
    """E-NeRF. Fields that are None are filled in from the recording when training starts, and stored in config.yml."""

    _target: Type = field(default_factory=lambda: EnerfModel)  # noqa: UP006
    num_levels: Optional[int] = None  # noqa: UP045
    """Levels of the hash grid. Default: the largest number up to 10 at which each level is at least 1.4 times as fine
    as the level before it."""
    base_res: int = 16
    """Cells along the box at the coarsest level of the hash grid."""
    max_res: Optional[int] = None  # noqa: UP045
    """Cells along the box at the finest level of the hash grid. Default: cells as large as a pixel of the sensor on the
    scene."""
    log2_table_size: Optional[int] = None  # noqa: UP045
    """Base-2 logarithm of the entries of each level of the hash grid. Default: about 2000 times the square
    root of the number of the sensor's pixels, from 17 to 20."""
    hash_grid: str = "auto"
    """Backend that computes the hash grid: triton (GPU), numba (CPU), torch (any device, slow), or auto, the fastest
    that fits the device. Results differ by rounding alone, and checkpoints fit all backends."""
    hidden_dim: int = 32
    """Width of the density network."""
    hidden_dim_colour: int = 32
    """Width of the colour network."""
    num_features: int = 15
    """Number of features that the density network passes to the colour network."""
    view_direction: Optional[bool] = None  # noqa: UP045
    """Let brightness depend on the viewing direction, for shiny scenes that are seen from many sides. Default: True
    where the camera moves around the scene and a short training shows that it helps."""
    brightness: Optional[Literal["log-sigmoid", "sigmoid", "exponential"]] = None  # noqa: UP045
    """Function from the output of the colour network to brightness: log brightness between two limits (log-sigmoid),
    brightness from 0 to 1 as in the paper (sigmoid), or log brightness without an upper limit, for scenes of high
    dynamic range (exponential). Default: log-sigmoid where the events fit between the limits, else exponential."""
    num_channels: Optional[Literal[1, 3]] = None  # noqa: UP045
    """Colour channels of the field. Default: 3 where the field learns from colour events or colour frames, else 1."""
    sampling: Optional[Literal["proposal", "uniform"]] = None  # noqa: UP045
    """Places of the samples along a ray: where a small network expects surfaces (proposal), or at even distances
    (uniform). Default: proposal."""
    num_proposal_samples: int = 48
    """Samples along a ray at which the proposal network is evaluated."""
    num_samples: int = 24
    """Samples along a ray at which the field is evaluated."""
    sensor: Annotated[SensorModelConfig, tyro.conf.arg(name="")] = field(default_factory=SensorModelConfig)
    event_loss: Optional[str] = None  # noqa: UP045
    """Loss on the rendered change of log brightness of a pair of events, in units of the contrast threshold: robust
    (huber), squared as in the paper (squared), or independent of scale (normalised). Default: huber; squared for
    enerf-paper; with a preset, the loss of the preset."""
    event_loss_weight: float = 1.0
    """Weight of the event loss."""
    no_event_loss_weight: Optional[float] = None  # noqa: UP045
    """Weight of the loss on silent pixels (see datamanager.silent-pairs). Default: 0.1; for enerf-paper, the weight of
    the paper."""
    no_event_margin: Optional[float] = None  # noqa: UP045
    """Change of a silent pixel that costs nothing, as a share of the contrast threshold: 1 as in the paper, 0 for total
    variation. Default: 0; for enerf-paper, 1."""
    frame_loss_weight: Optional[float] = None  # noqa: UP045
    """Weight of the loss on frames. Default: 10 with frames alone; with events and frames, the weight that balances
    their errors."""
    learn_exposure: Optional[bool] = None  # noqa: UP045
    """Learn a gain and an offset of each frame. Default: True with events and frames, where pixels without an event
    between two frames changed, which shows that the exposure changed."""
    level_loss_weight: Optional[float] = None  # noqa: UP045
    """Weight of the squared difference between the mean log brightness of a batch and the logarithm of mean-brightness.
    Default: 0.1 where the field learns from events alone, which do not determine the level of brightness, else 0."""
    mean_brightness: Optional[float] = None  # noqa: UP045
    """Geometric mean of the brightness of the scene, where white is 1. A field that learns from events alone is held
    near it. Default: the mean of the frames of the same camera, or 0.3 where there are no frames."""
    opacity_loss_weight: Optional[float] = None  # noqa: UP045
    """Weight of the light that passes through the scene, 1 minus accumulation; 0 for an object before an empty
    background. Default: 0 where the border of the sensor is silent, else 1."""
    distortion_loss_weight: float = 0.01
    """Weight of the distortion loss of mip-NeRF 360, which contracts fog to surfaces. With events, it grows to 30 times
    this value between a fifth and half of a training of at least 2000 steps, and falls again until four fifths."""
    interlevel_loss_weight: float = 1.0
    """Weight of the interlevel loss of mip-NeRF 360, from which the proposal network learns."""
    edge_start: Optional[bool] = None  # noqa: UP045
    """Start from the depth of edges that events show before training. Default: True with events alone, where more than
    5 % of the pixels have such an edge and sums of events are complete; for enerf-paper, False."""
    init_density: float = 1.0
    """Density before training, in 1 / scene unit. A field that starts transparent first learns a negative of the scene:
    holes in fog before a bright background."""
    panorama: Optional[bool] = None  # noqa: UP045
    """Learn a scene at infinity, whose brightness depends on the direction alone: a thin shell far outside the box.
    Default: True where the camera only turns, unless a depth range is set."""
    contraction: Optional[bool] = None  # noqa: UP045
    """Contract space from the data parser's depth of contraction on, out to infinity, as mip-NeRF 360 does. Without
    contraction the space beyond the box is empty. Default: True where a share of the events comes from beyond the box,
    or where the farthest depth is more than four times the nearest."""
    near_plane: Optional[float] = None  # noqa: UP045
    """Nearest distance of a sample from the camera, in scene units. Default: the near end of the recording's depths."""

    # fixed, so that they are no flags: this model does not read them
    enable_collider: Fixed[bool] = True
    collider_params: Fixed[Optional[Dict[str, float]]] = field(  # noqa: UP006, UP045
        default_factory=lambda: {"near_plane": 2.0, "far_plane": 6.0}
    )
    loss_coefficients: Fixed[Dict[str, float]] = field(default_factory=dict)  # noqa: UP006
    prompt: Fixed[Optional[str]] = None  # noqa: UP045


class BoxCollider(AABBBoxCollider):
    """Sets the near and far ends of rays to the scene box, and never nearer than the near plane.

    Nerfstudio's own collider ignores the near plane in evaluation, and so shows space that training never saw. Rays
    that have ends already, as the rays of a crop, keep the part of them that is in the box. A ray that misses or grazes
    the box gets a length of 1e-4 scene units.
    """

    def forward(self, ray_bundle: RayBundle) -> RayBundle:
        given = ray_bundle.nears, ray_bundle.fars
        ray_bundle = self.set_nears_and_fars(ray_bundle)
        assert ray_bundle.nears is not None and ray_bundle.fars is not None
        nears, fars = ray_bundle.nears.nan_to_num(0.0, posinf=0.0), ray_bundle.fars.nan_to_num(0.0, 0.0)
        if given[0] is not None and given[1] is not None:
            nears, fars = torch.minimum(torch.maximum(nears, given[0]), fars), torch.minimum(fars, given[1])
        else:
            nears = nears.clamp(min=self.near_plane)
        ray_bundle.nears, ray_bundle.fars = nears, torch.maximum(fars, nears + 1e-4)
        return ray_bundle


def fog_growth(step: int, num_steps: float) -> float:
    """Factor of the weight of the distortion loss at a step of a training of `num_steps` steps: between 1 and
    `FOG_GROWTH`, even in its logarithm between the shares of `FOG_CONTRACTS`."""
    if not FEWEST_STEPS <= num_steps < math.inf:
        return 1.0
    return FOG_GROWTH ** float(np.interp(step / num_steps, FOG_CONTRACTS, (0.0, 1.0, 1.0, 0.0)))


class Outputs(dict[str, Any]):
    """Outputs of a render by name. A value that is a function is computed when it is first read by its name."""

    def __getitem__(self, name: str) -> Tensor:
        value: Any = super().__getitem__(name)
        if callable(value):
            self[name] = value = value()
        return value


class EnerfModel(Model):
    """Hash-grid radiance field whose changes of log brightness explain the events of a camera."""

    config: EnerfModelConfig
    samples_at_once: int | None = None
    """Largest number of samples at which the field is evaluated at once; None for all (`enerf_ns.method.memory`)."""
    fog_growth: float = 1.0
    """Present factor of the weight of the distortion loss in runs with events."""
    seen_volume: Callable[[], SeenVolume] | None = None
    """Returns the volume that the camera of the events saw; None for a model without a recording."""
    display: Callable[[Tensor], Tensor] | None = None
    """Returns brightness as a screen should show it; None for a model without a recording."""

    def populate_modules(self) -> None:
        super().populate_modules()
        config = self.config
        assert config.max_res and config.num_levels and config.log2_table_size
        assert config.num_channels and config.near_plane is not None
        assert config.contraction is not None
        assert (
            config.sampling
            and config.brightness
            and config.view_direction is not None
            and config.opacity_loss_weight is not None
        )
        assert config.level_loss_weight is not None and config.mean_brightness is not None
        assert config.event_loss and config.no_event_loss_weight is not None and config.no_event_margin is not None
        self.sensor = config.sensor.setup()
        self.frame_balance = ErrorBalance() if config.frame_loss_weight is None else None
        self.instant_balance = ErrorBalance()
        self.exposure = FrameExposure(self.num_train_data) if config.learn_exposure else None
        self.supervision = EventSupervision(
            config.event_loss, config.event_loss_weight, config.no_event_loss_weight, config.no_event_margin
        )
        aabb = self.scene_box.aabb
        contraction, init_density = self.is_unbounded, config.init_density
        if config.panorama:
            self.collider, init_density = NearFarCollider(*PANORAMA, reset_near_plane=False), PANORAMA_DENSITY
        elif contraction:
            self.collider = NearFarCollider(config.near_plane, FARTHEST, reset_near_plane=False)
        else:
            self.collider = BoxCollider(self.scene_box, config.near_plane)
        self.field = EnerfField(
            aabb,
            num_channels=config.num_channels,
            view_direction=config.view_direction,
            hidden_dim_colour=config.hidden_dim_colour,
            brightness=config.brightness,
            num_features=config.num_features,
            num_levels=config.num_levels,
            min_res=config.base_res,
            max_res=config.max_res,
            log2_table_size=config.log2_table_size,
            hidden_dim=config.hidden_dim,
            contraction=contraction,
            init_density=init_density,
            backend=config.hash_grid,
        )
        # a field starts near a level of its own: without this gain, slider_depth was 1.3 dB worse at another level
        self.gain: float = config.mean_brightness / MEAN_BRIGHTNESS if config.level_loss_weight else 1.0
        # unbounded brightness leaks through any residual transmittance, so that no light may be dropped
        self._faint = 0.0 if config.brightness == "exponential" else FAINT
        first_sampler = PairedPiecewiseSampler if contraction else PairedUniformSampler
        self.proposal = self.expected = None
        if config.sampling == "proposal" and not config.panorama:
            # may run in half precision, since it only places samples: that moves changes of log brightness by a fifth
            # (bfloat16) or a thirtieth (float16) of what the jitter of the samples does
            self.proposal = HashDensity(
                aabb,
                num_levels=5,
                min_res=16,
                max_res=max(16, config.max_res // 2),
                log2_table_size=15,
                hidden_dim=16,
                contraction=contraction,
                init_density=init_density,
                backend=config.hash_grid,
            )
            self.sampler = PairedProposalSampler(
                config.num_proposal_samples, config.num_samples, first_sampler(single_jitter=True)
            )
            self.expected = DensityVoxels(self.proposal)
        else:
            self.sampler = first_sampler(num_samples=PANORAMA_SAMPLES if config.panorama else config.num_samples)
        self.renderer_accumulation = AccumulationRenderer()
        self.renderer_depth = DepthRenderer(method="median")

    @property
    def is_unbounded(self) -> bool:
        """Whether space beyond the box is rendered, too."""
        return bool(self.config.contraction or self.config.panorama)

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = {"fields": [*self.field.parameters(), *(self.proposal.parameters() if self.proposal else ())]}
        if self.exposure is not None:
            groups["fields"] += self.exposure.parameters()
        return groups | self.sensor.get_param_groups()

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        if not isinstance(self.sampler, PairedProposalSampler):
            return []
        return [
            TrainingCallback(
                where_to_run=[TrainingCallbackLocation.AFTER_TRAIN_ITERATION],
                update_every_num_iters=1,
                func=self.sampler.step_cb,
            )
        ]

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Renders rays.

        Args:
            ray_bundle: Any rays; in training usually a `PairedRayBundle`.

        Returns:
            rgb, shape (rays, 3), at most `gain` unless brightness is exponential, and accumulation, shape (rays, 1).

            In training rgb has the channels of the field, and weights_list and ray_samples_list are there for the
            losses. In evaluation there are depth, shape (rays, 1), in scene units along the ray; normals, shape
            (rays, 3), mapped from [-1, 1] to [0, 1]; and confidence, shape (rays, 1), of `depth_evidence`. Normals and
            confidence are computed when they are read.
        """
        if ray_bundle.nears is None:
            ray_bundle = self.collider(ray_bundle)
        if not self.training:
            return self._picture(ray_bundle)
        samples, weights_list, samples_list = self._samples(ray_bundle)
        field_outputs = in_parts(self.field, samples, self.samples_at_once)
        weights = samples.get_weights(field_outputs[FieldHeadNames.DENSITY])
        accumulation = self.renderer_accumulation(weights=weights)
        background = (1.0 - accumulation) * paired_rand(ray_bundle, 1)
        rgb = torch.sum(weights * field_outputs[FieldHeadNames.RGB], dim=-2) + background
        return {
            "rgb": rgb if self.gain == 1.0 else self.gain * rgb,
            "accumulation": accumulation,
            "weights_list": [*weights_list, weights],
            "ray_samples_list": [*samples_list, samples],
        }

    def _samples(self, rays: RayBundle) -> tuple[RaySamples, list[Tensor], list[RaySamples]]:
        """Samples along rays, and the weights and samples of the proposal network; in evaluation, of its voxels."""
        if self.proposal is None:
            return self.sampler(rays), [], []
        return self.sampler(rays, density_fns=[self.proposal.density_fn if self.training else self.expected])

    def _picture(self, rays: RayBundle) -> Outputs:
        """Outputs of rays in evaluation.

        Samples are rendered from the camera on, until the transmittance is below `FAINT`. Colour is computed only for
        samples whose weight counts.
        """
        grid = self.field.geometry.grid
        if backend_of(grid.backend, rays.origins, grid.table) == "numba" and not torch.is_grad_enabled():
            from enerf_ns.rendering.front_to_back_numba import render  # here, since Numba may be missing

            rgb, accumulation, depth = render(rays, self.field, self.sampler, self.expected, self._faint)
        else:
            samples, _, _ = self._samples(rays)
            rgb = rays.origins.new_zeros(len(rays), self.field.num_channels)

            def see(ray: Tensor, weight: Tensor, features: Tensor) -> None:
                rgb.index_add_(0, ray, weight * self.field.colour(features, rays.directions[ray]))

            weights = front_to_back(samples, self.field.geometry, self._faint, see, self.samples_at_once)
            accumulation = self.renderer_accumulation(weights=weights)
            depth = self.renderer_depth(weights=weights, ray_samples=samples)
        return Outputs(
            rgb=self.gain * rgb.expand(-1, 3),
            accumulation=accumulation,
            depth=depth,
            normals=lambda: self.normals(rays.origins + rays.directions * depth),
            confidence=lambda: self.depth_evidence(rays, depth)[0],
        )

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> Outputs:
        """Outputs of the rays of a picture, each of shape (height, width, channels). Normals and confidence are
        computed when they are read. Confidence is 0 at rims (`is_rim`)."""
        outputs = Outputs(super().get_outputs_for_camera_ray_bundle(camera_ray_bundle))
        depth = outputs["depth"].clone()  # ns-render scales raw-depth in place

        def normals() -> Tensor:
            points = camera_ray_bundle.origins + camera_ray_bundle.directions * depth
            chunks = points.reshape(-1, 3).split(self.config.eval_num_rays_per_chunk)
            found = [self.normals(chunk.to(self.device)).to(points.device) for chunk in chunks]
            return torch.cat(found).view(points.shape)

        outputs["normals"] = normals
        outputs["confidence"] = lambda: self.depth_evidence(camera_ray_bundle, depth)[0] * ~is_rim(depth)
        return outputs

    @torch.no_grad()
    def depth_evidence(self, rays: RayBundle, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Confidence in the depth of rays, and their far depth.

        Args:
            rays: Rays of any shape.
            depth: Depth of the rays, shape (*batch, 1), in scene units along the ray.

        Returns:
            Two tensors of the shape and on the device of `depth`. The confidence, from 0 to 1, is the weight of the
            samples within `AROUND_DEPTH` of the depth, times the evidence of the events from there
            (`SeenVolume.evidence`, 0 beyond the scene box). The far depth, in scene units along the ray, is the depth
            before which `FAR_SHARE` of the accumulation lies.
        """
        volume = self.seen_volume() if self.seen_volume else None
        size, confidence, far = self.config.eval_num_rays_per_chunk, [], []
        for start in range(0, len(rays), size):
            chunk = rays.flatten()[start : start + size].to(self.device)
            middle = depth.reshape(-1, 1)[start : start + size].to(self.device)
            samples, _, _ = self._samples(self.collider(chunk))
            weights = front_to_back(samples, self.field.geometry, self._faint, samples_at_once=self.samples_at_once)
            places = (samples.frustums.starts + samples.frustums.ends) / 2.0
            share = (weights * ((places - middle[:, None]).abs() <= AROUND_DEPTH * middle[:, None])).sum(dim=1)
            if volume is not None:
                share = share * volume.evidence(chunk.origins + chunk.directions * middle)[:, None]
            stopped = weights.cumsum(dim=1)
            reached = (stopped >= FAR_SHARE * stopped[:, -1:]).int().argmax(dim=1, keepdim=True)
            confidence.append(share.clamp(max=1.0))
            far.append(places.gather(1, reached)[:, 0])
        return tuple(torch.cat(parts).view(depth.shape).to(depth.device) for parts in (confidence, far))  # type: ignore

    @torch.no_grad()
    def normals(self, points: Tensor) -> Tensor:
        """Surface normals at points, shape (rays, 3), mapped to [0, 1]: the directions in which density falls fastest.

        They are differences of log density between the corners of a tetrahedron that is as wide as two cells of the
        finest level.
        """
        assert self.config.max_res is not None
        corners = points.new_tensor([[1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]])
        size = 4.0 / self.config.max_res
        density = self.field.geometry.density_fn(points[:, None] + size * corners)
        gradient = torch.sum(torch.log(density + 1e-6) * corners, dim=1)
        return 0.5 - 0.5 * torch.nn.functional.normalize(gradient, dim=-1)

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: TrainBatch, metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """All losses, with their weights, of the outputs that `get_outputs` made of the rays of a batch."""
        config = self.config
        start, end, frames = batch.split(outputs["rgb"])
        losses: dict[str, Tensor] = {}
        share: Tensor | float = 1.0  # weight of the pairs of events; pairs of any instants have the rest
        if batch.events is not None:
            losses |= self.supervision.losses(start, end, batch.events, self.sensor)
            if "event_loss" in losses and "instant_loss" in losses:
                of_events, of_any = losses["event_loss"], losses["instant_loss"]
                numbers = batch.events.num_changes_of_events, batch.events.num_changes_of_any
                share = 1.0 / (1.0 + self.instant_balance(of_events, numbers[0], of_any, numbers[1]))
                losses |= {"event_loss": share * of_events, "instant_loss": (1.0 - share) * of_any}
            if self.training and self.sensor.threshold_map is not None:
                self.sensor.observe(brightness_change(start, end, batch.events, self.sensor).detach(), batch.events)
            if self.training and config.level_loss_weight:
                seen = self.sensor.brightness(torch.cat([start, end]), batch.events.pixels.repeat(2))
                is_seen = seen > FAINTEST
                logs = (seen.clamp(min=FAINTEST) / (MEAN_BRIGHTNESS * self.gain)).log()
                level = (is_seen * logs).sum() / is_seen.count_nonzero().clamp(min=1)
                losses["level_loss"] = config.level_loss_weight * level.square()
        if batch.frames is not None:
            error = self._frame_loss(frames, batch.frames)
            weight = config.frame_loss_weight
            if self.frame_balance and batch.events is not None and "event_loss" in losses:
                of_events = losses["event_loss"].detach() / share / config.event_loss_weight
                number = batch.events.num_changes_of_events
                weight = share * self.frame_balance(of_events, number, error, len(frames))
            losses["frame_loss"] = (FRAME_LOSS_WEIGHT if weight is None else weight) * error
        if self.training:
            weights, samples = outputs["weights_list"], outputs["ray_samples_list"]
            if config.opacity_loss_weight:
                losses["opacity_loss"] = config.opacity_loss_weight * (1.0 - outputs["accumulation"]).mean()
            if config.distortion_loss_weight:
                spread = distortion_loss(weights[-1][..., 0], ray_samples_to_sdist(samples[-1]))
                growth = 1.0 if batch.events is None else self.fog_growth
                losses["distortion_loss"] = growth * config.distortion_loss_weight * spread
            if self.proposal is not None:
                losses["interlevel_loss"] = config.interlevel_loss_weight * interlevel_loss(weights, samples)
        return losses

    @torch.no_grad()
    def get_metrics_dict(self, outputs: dict[str, Any], batch: TrainBatch) -> dict[str, Tensor]:
        """event_correlation where the batch has events, and frame_psnr (dB) where it has frames."""
        start, end, frames = batch.split(outputs["rgb"])
        metrics: dict[str, Tensor] = {}
        if batch.events is not None:
            metrics |= self.supervision.metrics(start, end, batch.events, self.sensor)
        if batch.frames is not None:
            metrics["frame_psnr"] = -10.0 * torch.log10(self._frame_loss(frames, batch.frames))
        return metrics

    def _frame_loss(self, rendered: Tensor, frames: FrameBatch) -> Tensor:
        if self.exposure is not None:
            rendered = self.exposure(rendered, frames.indices[:, 0])
        return frame_loss(rendered, frames.colours, grey=self.config.num_channels == 1 or frames.are_grey)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """psnr and ssim of one picture, and pictures of it: frame and render, and depth, which a panorama has not.

        The brightness of this picture alone is aligned; `ns-eval` aligns all held-out frames together. There are no
        scores for a picture of events, nor for a picture that cannot be aligned.
        """
        recorded, rendered = batch["image"].to(outputs["rgb"].device)[..., :3], outputs["rgb"]
        scores: dict[str, float] = {}
        if batch["is_frame"] and rendered.isfinite().all():
            aligned = align([rendered], [recorded], DEFAULT_PROTOCOL, self.sensor.colour_filter is not None)
            if aligned.faults == [None]:
                rendered = aligned.rendered[0].clamp(0.0, 1.0)
                found = {"psnr": psnr(rendered, recorded), "ssim": ssim(rendered, recorded)}
                scores = {name: score for name, score in found.items() if not isinstance(score, str)}
        images = {"img": torch.cat([recorded, rendered.nan_to_num()], dim=1)}
        if not self.config.panorama:
            depth = outputs["depth"].nan_to_num(0.0, 0.0, 0.0)
            images["depth"] = depth / depth.max().clamp(min=1e-12)
        return scores, images

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Outputs of a camera for ns-render.

        rgb is linear brightness, clipped to 1, since their conversion to 8 bits would wrap round. display is brightness
        as in the pictures of `enerf report`, and is computed when it is read. A panorama has no depth, and so no
        normals and no confidence.
        """
        outputs = super().get_outputs_for_camera(camera, obb_box)
        if self.config.panorama:
            for name in ("depth", "normals", "confidence"):
                del outputs[name]
        rgb, display = outputs["rgb"], self.display
        if display is not None:
            outputs["display"] = lambda: display(rgb)  # type: ignore[assignment]
        outputs["rgb"] = rgb.clamp(max=1.0)
        return outputs

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        return torch.cat([outputs[output_name], outputs["accumulation"]], dim=-1)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False):
        """Loads parameters, always strictly: Nerfstudio's pipeline tries once more without, and a field would be random
        in silence.

        Raises:
            RuntimeError: The parameters are of another field.
        """
        return super().load_state_dict(state_dict, strict=True, assign=assign)
