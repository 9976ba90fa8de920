"""What one training step draws, and the rays of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
from jaxtyping import Float, Int64
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from torch import Tensor
from tyro.conf import Fixed, OmitSubcommandPrefixes, Suppress
from tyro.extras import subcommand_type_from_defaults

from enerf_ns.choices.events import HELD_OUT_SPANS
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, event_data
from enerf_ns.dataparsers.formats.registry import formats
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.picture_depth import brightness
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, overlaps
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range
from enerf_ns.events.batch import EventBatch, FrameBatch, TrainBatch
from enerf_ns.events.samplers import (
    AccumulationSampler,
    EventPairSampler,
    HeldOutPairSampler,
    InstantPairSampler,
    SilentIntervalSampler,
    SilentPixelSampler,
)
from enerf_ns.method.event_dataset import EventDataset
from enerf_ns.poses.corrections import Corrections
from enerf_ns.poses.posed_camera import PosedCamera
from enerf_ns.rendering.ray_samplers import PairedRayBundle
from enerf_ns.sensor.sensor_model import SensorModel

DATAPARSERS = {name: config for name, config in all_dataparsers.items() if isinstance(config, EventDataParserConfig)}
EventDataParserUnion = OmitSubcommandPrefixes[
    subcommand_type_from_defaults(
        DATAPARSERS,
        {format.command: format.description for format in formats() if format.command in DATAPARSERS}
        | {"event-data": event_data.description or ""},
        prefix_names=False,
    )
]

DIRECTIONS_NORM = "directions_norm"
"""Name that Nerfstudio has among the metadata of rays for the length along each of one unit along the optical axis."""


@dataclass
class EnerfDataManagerConfig(VanillaDataManagerConfig):
    """Event pairs, silent pixels and frame pixels of a recording. What is None is chosen when training starts."""

    _target: Type = field(default_factory=lambda: EnerfDataManager)  # noqa: UP006
    dataparser: EventDataParserUnion = field(default_factory=EventDataParserConfig)  # type: ignore
    """Format of the recording."""
    supervision: Literal["events", "events+frames", "frames"] = "events"
    """What the field learns from."""
    event_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of instants with events between them, drawn at each step. None: 1024, beside pairs of any instants 683,
    of noisy events beside frames 256, or as the paper for enerf-paper."""
    pair_mode: Optional[Literal["successor", "partner", "window", "accumulated"]] = None  # noqa: UP045
    """The other event of a pair: the pixel's next; one of its next few; its last in a window of time. Or no two events,
    but a window of any length whose events are summed, as in EventNeRF (accumulated). None: one of the next few, but
    the next where the sensor has a refractory period, in which changes go unseen."""
    max_pair_distance: Optional[int] = None  # noqa: UP045
    """Events of the pixel that a partner may lie ahead, for pair-mode partner. None: as many as the noise of the events
    leaves worth adding up, at most 10."""
    instant_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of any two instants of a pixel, drawn at each step beside those of events: what its events between them add
    up to, if any. None: half of all pairs, in place of silent ones, where the field learns from events alone and pixels
    are not blind after an event. 0: none."""
    instants_apart_ms: Optional[float] = None  # noqa: UP045
    """Longest time between the two instants of such a pair. None: as long as the noise of the events leaves worth
    adding up."""
    window_ms: Optional[float] = None  # noqa: UP045
    """Length of the windows for pair-mode window, and of the longest for accumulated. None: 60; for accumulated a
    twentieth of the recording."""
    uniform_over: Literal["pairs", "pixels"] = "pairs"
    """Draw every pair alike, or every active pixel alike."""
    silent_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of instants at a pixel that saw no event between them, drawn at each step. None: a third of 1024, beside
    frames 128, beside pairs of any instants none, or as the paper for enerf-paper. 0: none are searched."""
    silent_mode: Literal["pixels", "intervals"] = "pixels"
    """Where silent pairs lie: at any pixel while it is silent for silence-ms, or between any two successive events of a
    pixel, as in the total variation of Deblur e-NeRF."""
    silence_ms: Optional[float] = None  # noqa: UP045
    """Shortest silence of a pixel that counts. None: 20, or as the preset."""
    held_out_events: float = 0.02
    """Share of the recording's time, in 8 equal spans spread evenly over it, at which no pair starts or ends: the
    correlation of events is measured there. 0: none, and it is measured over training pairs."""
    train_num_rays_per_batch: Optional[int] = None  # type: ignore[assignment]  # noqa: UP045
    """Rays of frames at each step, where the field learns from frames. None: 1024, beside events that are not noisy
    426, or as the paper for enerf-paper."""
    exposure_samples: Optional[int] = None  # noqa: UP045
    """Instants of its exposure over which a pixel of a frame is averaged, of which each takes a ray; 1: it is taken as
    seen in the middle. None: as many as the motion needs, where the exposures are known."""
    pixel_sampler: Suppress[PixelSamplerConfig] = field(default_factory=PixelSamplerConfig)

    corrections: Fixed[Optional[Corrections]] = None  # noqa: UP045
    """What a loaded run corrects of the poses: for data managers that are made of its configuration later, as by
    `ns-render dataset`."""

    # What Nerfstudio's own data manager has, and this one has no use for, is no flag.
    masks_on_gpu: Fixed[bool] = False
    images_on_gpu: Fixed[bool] = False
    train_num_images_to_sample_from: Fixed[int] = -1
    train_num_times_to_repeat_images: Fixed[int] = -1
    eval_num_rays_per_batch: Fixed[int] = 1024
    eval_num_images_to_sample_from: Fixed[int] = -1
    eval_num_times_to_repeat_images: Fixed[int] = -1
    eval_image_indices: Fixed[Optional[Tuple[int, ...]]] = (0,)  # noqa: UP006, UP045
    patch_size: Fixed[int] = 1
    camera_optimizer: Fixed[Optional[CameraOptimizerConfig]] = None  # noqa: UP045

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Reads config.yml of runs from before events were held out, and before pairs of any instants, too."""
        self.__dict__.update({"held_out_events": 0.0, "instant_pairs": 0, "instants_apart_ms": 0.0, **state})


class EnerfDataManager(VanillaDataManager[EventDataset]):
    """Draws what the sensor saw, and makes rays of it. What it needs for either is made when first asked for."""

    config: EnerfDataManagerConfig
    corrections = Corrections()
    """What is corrected of the recording by now."""
    train_dataset: EventDataset
    eval_dataset: EventDataset

    def __init__(self, config: EnerfDataManagerConfig, *args: Any, **kwargs: Any):
        config = replace(config, dataparser=replace(config.dataparser, picture_files=False))
        super().__init__(config, *args, **kwargs)
        if config.corrections is not None:
            self.correct(config.corrections)

    def get_datapath(self) -> Path:
        """Where `ns-viewer` keeps camera paths: not with the recording, which is only read."""
        return Path.cwd()

    def setup_train(self) -> None:
        config = self.config
        assert config.train_num_rays_per_batch is not None
        self.generator = torch.Generator(self.device).manual_seed(torch.initial_seed() % 2**63)
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, config.train_num_rays_per_batch)
        if self.test_mode == "val" and "events" in config.supervision:
            _ = (
                self.pair_sampler,
                self.silent_sampler,
                self.instant_sampler,
                self.held_out_pair_sampler,
            )  # so that what cannot be drawn is found before training

    def setup_eval(self) -> None:
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )
        self.eval_dataloader = RandIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )

    @property
    def recording(self) -> EventRecording:
        """The recording that is learnt from."""
        return self.train_dataset.recording

    @property
    def distance(self) -> float:
        """Usual depth of the scene, metres."""
        near, far = scene_depth_range(self.recording, self.config.dataparser.depth_range)
        return math.sqrt(near * far)

    @property
    def held_out_spans(self) -> Int64[np.ndarray, "spans 2"]:
        """First and last instant (ns) of each span of time whose events are kept from training."""
        share = self.config.held_out_events
        return self.recording.spans(HELD_OUT_SPANS, share) if share else np.zeros((0, 2), np.int64)

    @cached_property
    def index(self) -> EventIndex:
        """The events of the recording, on the device."""
        return index_events(self.recording).to(self.device)

    @cached_property
    def pair_sampler(self) -> EventPairSampler | AccumulationSampler:
        """Draws event pairs as the config says.

        Raises:
            FlagError: There is none to draw.
        """
        config = self.config
        assert config.pair_mode is not None and config.window_ms is not None
        window_ns = round(config.window_ms * 1e6)
        try:
            if config.pair_mode == "accumulated":
                return AccumulationSampler(self.index, *self._span, window_ns, self._stretches)
            return EventPairSampler(
                self.index,
                config.pair_mode,
                max_distance=config.max_pair_distance or 1,
                window_ns=window_ns,
                uniform_over=config.uniform_over,
                stretches=self._stretches,
            )
        except ValueError as error:
            raise FlagError(f"{self.recording.path}: {error}") from error

    @cached_property
    def held_out_pair_sampler(self) -> HeldOutPairSampler | str:
        """Draws pairs of events that both are held out, as far apart as those of the training; or why there is none."""
        spans = torch.from_numpy(overlaps(self.recording.stretches, self.held_out_spans)).to(self.device)
        try:
            successors = self.config.pair_mode == "successor"
            return HeldOutPairSampler(self.index, spans, 1 if successors else self.config.max_pair_distance or 1)
        except ValueError as error:
            return str(error)

    @cached_property
    def silent_sampler(self) -> SilentPixelSampler | SilentIntervalSampler | None:
        """Draws silent pixels as the config says; None where it wants none."""
        if not self.config.silent_pairs:
            return None
        if self.config.silent_mode == "intervals":
            return SilentIntervalSampler(self.index, self._stretches)
        assert self.config.silence_ms is not None
        silence = round(self.config.silence_ms * 1e6)
        held_out = torch.from_numpy(self.held_out_spans).to(self.device) if len(self.held_out_spans) else None
        stretches = self._parts(self.recording.stretches)
        return SilentPixelSampler(self.index, *self._span, silence, silence, stretches, held_out)

    @cached_property
    def instant_sampler(self) -> InstantPairSampler | None:
        """Draws pairs of any two instants as the config says; None where it wants none."""
        if not self.config.instant_pairs:
            return None
        assert self.config.instants_apart_ms is not None
        return InstantPairSampler(
            self.index, *self._span, max(1, round(self.config.instants_apart_ms * 1e6)), self._stretches
        )

    @cached_property
    def event_camera(self) -> PosedCamera:
        """The camera of the events, in the scene."""
        return self._posed(self.recording.camera, self.recording.trajectory)

    @cached_property
    def event_camera_without_distortion(self) -> PosedCamera:
        """The camera of undistorted pictures of the events, in the scene."""
        return self._posed(self.recording.camera.undistorted(), self.recording.trajectory)

    @cached_property
    def frame_camera(self) -> PosedCamera:
        """The camera of the pictures that are learnt from, in the scene."""
        frames = self._frames
        return self._posed(frames.picture_camera, frames.trajectory)

    @cached_property
    def frame_colours(self) -> Tensor:
        """All frames that are learnt from, shape (frames, height, width, 3): uint8, or float32 in [0, 1] where one of
        them has more than 8 bits."""
        pictures = [self.train_dataset.get_numpy_image(i) for i in range(len(self.train_dataset))]
        if any(picture.dtype != np.uint8 for picture in pictures):
            pictures = [brightness(picture) for picture in pictures]
        return torch.from_numpy(np.stack(pictures)).to(self.device)

    @cached_property
    def _frames_are_grey(self) -> bool:
        return bool((self.frame_colours == self.frame_colours[..., :1]).all())

    def next_batch(self, sensor: SensorModel) -> TrainBatch:
        """Draws what one training step looks at.

        Args:
            sensor: That made the events.
        """
        self.train_count += 1
        config, events, frames = self.config, None, None
        if "events" in config.supervision:
            assert config.event_pairs is not None
            blind = sensor.refractory_period if sensor.lags else None
            events = self.pair_sampler.sample(config.event_pairs, self.generator, blind)
            if self.instant_sampler is not None:
                assert config.instant_pairs is not None
                events = events.followed_by(self.instant_sampler.sample(config.instant_pairs, self.generator))
            if self.silent_sampler is not None:
                assert config.silent_pairs is not None
                silent = self.silent_sampler.sample(config.silent_pairs, self.generator, sensor.refractory_period)
                events = events.followed_by(silent)
        if "frames" in config.supervision:
            indices = self._frame_pixels(self._num_frame_pixels)
            instants = self._frame_instants(indices[:, 0])
            colours = self.frame_colours[tuple(indices.T)]
            colours = colours.float() / 255.0 if colours.dtype == torch.uint8 else colours
            frames = FrameBatch(indices, instants, colours, self._frames_are_grey)
        return TrainBatch(events, frames)

    def rays(self, batch: TrainBatch, sensor: SensorModel) -> PairedRayBundle:
        """The rays of a batch, in the order that `TrainBatch.split` takes apart."""
        bundles: list[RayBundle] = []
        if batch.events is not None:
            bundles.append(self.event_rays(batch.events, sensor))
        if batch.frames is not None:
            bundles.append(self._frame_rays(batch.frames.indices, batch.frames.times))

        def join(name: str) -> Tensor:
            columns = [
                bundle.metadata[name] if name == DIRECTIONS_NORM else getattr(bundle, name) for bundle in bundles
            ]
            return torch.cat(columns) if len(columns) > 1 else columns[0]

        return PairedRayBundle(
            origins=join("origins"),
            directions=join("directions"),
            pixel_area=join("pixel_area"),
            metadata={DIRECTIONS_NORM: join(DIRECTIONS_NORM)},
            num_pairs=batch.num_pairs,
        )

    def event_rays(
        self, batch: EventBatch, sensor: SensorModel, places: Float[Tensor, "places 2"] | None = None
    ) -> RayBundle:
        """Rays of all first instants, from when the pixels can see, then of all second ones.

        Args:
            batch: Of pairs.
            sensor: That made the events.
            places: Where in its pixel rays go through, x and y from the centre in pixels: of each instant as many rays,
                one after the other. None: the centre.
        """
        delays = self._delays(batch, sensor)
        pixels, times = batch.pixels.repeat(2), torch.cat([batch.start, batch.end])
        if places is None:
            return self.event_camera.rays(pixels, times, delays)
        number = len(places)
        delays = None if delays is None else delays.repeat_interleave(number)
        pixels, times = (column.repeat_interleave(number) for column in (pixels, times))
        return self.event_camera.rays(pixels, times, delays, places=places.repeat(2 * len(batch), 1))

    def event_times(self, batch: EventBatch, sensor: SensorModel) -> Int64[Tensor, " rays"]:
        """When the pixels of a batch look along the rays of `event_rays`, ns."""
        delays, times = self._delays(batch, sensor), torch.cat([batch.start, batch.end])
        return times if delays is None else times + delays.round().long()

    def _delays(self, batch: EventBatch, sensor: SensorModel) -> Tensor | None:
        """How much later (ns) than at their instants pixels see again, of all first instants and then of all second
        ones; None where they always do."""
        delays = sensor.blind_after(batch.start, batch.end) if batch.starts_at_events else None
        if delays is None:
            return None
        delays[batch.silent] = 0.0
        return torch.cat([delays, torch.zeros_like(delays)])

    def correct(self, corrections: Corrections) -> None:
        """Has rays follow corrected poses, and through a corrected lens, and the cameras of frames too."""
        made = ["event_camera", "event_camera_without_distortion", "frame_camera"]
        if corrections.distortion != self.corrections.distortion:
            made.append("frame_colours")  # which are undistorted
        self.corrections = corrections
        for dataset in (self.train_dataset, self.eval_dataset):
            dataset.correct(corrections)
        for name in ("fixed_indices_eval_dataloader", "eval_dataloader"):  # which are not there to render alone
            if loader := getattr(self, name, None):
                loader.cameras = self.eval_dataset.cameras.to(self.device)
        for name in made:
            self.__dict__.pop(name, None)

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """Rays of pixels drawn evenly from the train cameras, as ns-export looks at a scene with; training itself takes
        `next_batch`."""
        assert self.train_pixel_sampler is not None
        indices = self._frame_pixels(self.train_pixel_sampler.num_rays_per_batch)
        return self._frame_rays(indices, self._frame_times[indices[:, :1]]), {"indices": indices}

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        return self.next_train(step)

    def get_train_rays_per_batch(self) -> int:
        """Rays of one training step, of events and frames together."""
        config = self.config
        numbers = (config.event_pairs, config.instant_pairs, config.silent_pairs)
        pairs = sum(number or 0 for number in numbers) if "events" in config.supervision else 0
        instants = self.config.exposure_samples or 1
        return 2 * pairs + (self._num_frame_pixels * instants if "frames" in config.supervision else 0)

    def _parts(self, stretches: Int64[np.ndarray, "stretches 2"]) -> Tensor | None:
        """First and last instant (ns) of parts of the recording, for samplers; None where they are its span."""
        return None if stretches.tolist() == [[*self.recording.span]] else torch.from_numpy(stretches).to(self.device)

    @property
    def _span(self) -> tuple[int, int]:
        """Times of the first and of the last event that is used, ns."""
        return index_events(self.recording).span

    @property
    def _stretches(self) -> Tensor | None:
        """First and last instant (ns) of each part of time that is learnt from; None where that is the whole span."""
        first, last = self.recording.span
        around = np.concatenate([[first], (self.held_out_spans + np.array([-1, 1])).flatten(), [last]]).reshape(-1, 2)
        return self._parts(overlaps(self.recording.stretches, around))

    @property
    def _frames(self) -> Frames:
        return self.train_dataset.frames

    def _posed(self, camera, trajectory) -> PosedCamera:
        outputs = self.train_dataparser_outputs
        return PosedCamera(camera, trajectory, outputs.metadata["transform"], outputs.dataparser_scale, self.device)

    def _frame_pixels(self, number: int) -> Tensor:
        """Frame, row and column of pixels drawn evenly, shape (number, 3)."""
        camera = self.frame_camera.camera
        sizes = len(self._frames.times), camera.height, camera.width
        draws = [torch.randint(size, (number,), generator=self.generator, device=self.device) for size in sizes]
        return torch.stack(draws, dim=-1)

    @property
    def _num_frame_pixels(self) -> int:
        """Pixels of frames of one training step, of which each has as many rays as instants."""
        assert self.config.train_num_rays_per_batch is not None
        return max(1, self.config.train_num_rays_per_batch // (self.config.exposure_samples or 1))

    @cached_property
    def _frame_times(self) -> Tensor:
        return torch.from_numpy(self._frames.times).to(self.device)

    @cached_property
    def _frame_exposures(self) -> Tensor:
        return torch.from_numpy(self._frames.exposed).to(self.device)

    def _frame_instants(self, frames: Tensor) -> Tensor:
        """Instants (ns) at which pixels of these frames are rendered, shape (pixels, instants): one in the middle of
        the exposure, or one drawn evenly from each of as many equal parts of it."""
        number = self.config.exposure_samples or 1
        if number == 1:
            return self._frame_times[frames, None]
        opens, closes = self._frame_exposures[frames, :, None].unbind(1)
        draws = torch.rand(len(frames), number, generator=self.generator, device=self.device, dtype=torch.float64)
        parts = (torch.arange(number, device=self.device) + draws) / number
        return opens + (parts * (closes - opens)).long()

    def _frame_rays(self, indices: Tensor, times: Tensor) -> RayBundle:
        _, row, column = indices.T
        pixels = row * self.frame_camera.camera.width + column
        return self.frame_camera.rays(pixels.repeat_interleave(times.shape[1]), times.flatten())
