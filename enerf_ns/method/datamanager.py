"""The data manager: it draws the batch of a training step, and makes its rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
from jaxtyping import Float, Int64
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
from enerf_ns.dataparsers.scene.edge_depth import edge_depth
from enerf_ns.events.batch import EventBatch, FrameBatch, TrainBatch
from enerf_ns.events.missed_changes import MissedChanges
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
"""Name in the metadata of Nerfstudio's rays for the length along a ray of one unit along the optical axis."""


@dataclass
class EnerfDataManagerConfig(VanillaDataManagerConfig):
    """Pairs of events, silent pixels and pixels of frames of a recording. Fields that are None are filled in from the
    recording when training starts."""

    _target: Type = field(default_factory=lambda: EnerfDataManager)  # noqa: UP006
    dataparser: EventDataParserUnion = field(default_factory=EventDataParserConfig)  # type: ignore
    """Format of the recording."""
    supervision: Literal["events", "events+frames", "frames"] = "events"
    """Data from which the field learns."""
    event_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of events of a pixel that are drawn at each step. Default: 1024; with pairs of any two instants 683; with
    noisy events and frames 256; for enerf-paper, the number of the paper."""
    pair_mode: Optional[Literal["successor", "partner", "window", "accumulated"]] = None  # noqa: UP045
    """Second event of a pair: the next event of the pixel (successor), one of its next few (partner), or its last event
    within a window of time (window). Or a window of any length whose events are summed, as in EventNeRF (accumulated).
    Default: partner; successor where the sensor misses changes in a refractory period that events do not tell."""
    max_pair_distance: Optional[int] = None  # noqa: UP045
    """Largest number of events of the pixel from one event of a pair to the other, for pair-mode partner. Default: as
    many as the noise of the events makes useful, at most 10."""
    instant_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of any two instants of a pixel that are drawn at each step; they are compared with the sum of the pixel's
    events between them. Default: half of all pairs, instead of silent pairs, where the field learns from events alone
    and the sensor misses no changes; else 0."""
    instants_apart_ms: Optional[float] = None  # noqa: UP045
    """Longest time between the two instants of a pair of any instants, ms. Default: as long as the noise of the events
    makes useful."""
    completed_refractory_ns: Optional[int] = None  # noqa: UP045
    """Time (ns) for which pixels are blind after an event whose changes are added to the sums of events, as the rates
    of events tell them; 0: they are not added. Default: the refractory period where little noise is left, else 0."""
    window_ms: Optional[float] = None  # noqa: UP045
    """Length of the windows for pair-mode window, and of the longest window for pair-mode accumulated, ms. Default: 60;
    for accumulated, a twentieth of the recording."""
    uniform_over: Literal["pairs", "pixels"] = "pairs"
    """Draw every pair with the same probability (pairs), or every active pixel (pixels)."""
    silent_pairs: Optional[int] = None  # noqa: UP045
    """Pairs of instants of a pixel without an event between them that are drawn at each step. Default: a third of 1024;
    with frames 128; with pairs of any instants 0; for enerf-paper, the number of the paper."""
    silent_mode: Literal["pixels", "intervals"] = "pixels"
    """Place of silent pairs: at any pixel that is silent for silence-ms (pixels), or between two successive events of a
    pixel, as in the total variation of Deblur e-NeRF (intervals)."""
    silence_ms: Optional[float] = None  # noqa: UP045
    """Shortest silence of a pixel that counts, ms. Default: 20; with a preset, the value of the preset."""
    held_out_events: float = 0.02
    """Share of the recording's time that is held out from training, in 8 equal spans spread evenly over it. No pair
    starts or ends there, and the scores of events are measured there. With 0 they are measured over training pairs."""
    train_num_rays_per_batch: Optional[int] = None  # type: ignore[assignment]  # noqa: UP045
    """Rays of frames at each step, where the field learns from frames. Default: 1024; with events that are not noisy
    426; for enerf-paper, the number of the paper."""
    exposure_samples: Optional[int] = None  # noqa: UP045
    """Instants of its exposure over which a pixel of a frame is averaged; each takes one ray. With 1, the pixel is
    rendered in the middle of the exposure. Default: as many as the motion blur needs, where exposures are known."""
    pixel_sampler: Suppress[PixelSamplerConfig] = field(default_factory=PixelSamplerConfig)

    corrections: Fixed[Any] = None  # `Corrections`; tyro would make sub-commands of a union with a dataclass
    """Corrections of the poses in a run that was loaded, for data managers that are made of its config later, as by
    `ns-render dataset`."""

    # fixed, so that they are no flags: this data manager does not read them
    masks_on_gpu: Fixed[bool] = False
    images_on_gpu: Fixed[bool] = False
    train_num_images_to_sample_from: Fixed[int] = -1
    train_num_times_to_repeat_images: Fixed[int] = -1
    eval_num_rays_per_batch: Fixed[int] = 1024
    eval_num_images_to_sample_from: Fixed[int] = -1
    eval_num_times_to_repeat_images: Fixed[int] = -1
    eval_image_indices: Fixed[Optional[Tuple[int, ...]]] = (0,)  # noqa: UP006, UP045
    patch_size: Fixed[int] = 1
    camera_optimizer: Fixed[Any] = None


class EnerfDataManager(VanillaDataManager[EventDataset]):
    """Draws batches of a recording, and makes their rays. Samplers and cameras are made when they are first used."""

    config: EnerfDataManagerConfig
    corrections = Corrections()
    """Current corrections of clock, poses and lens."""
    train_dataset: EventDataset
    eval_dataset: EventDataset

    def __init__(self, config: EnerfDataManagerConfig, *args: Any, **kwargs: Any):
        config = replace(config, dataparser=replace(config.dataparser, picture_files=False))
        super().__init__(config, *args, **kwargs)
        if config.corrections is not None:
            self.correct(config.corrections)

    def get_datapath(self) -> Path:
        """The folder in which `ns-viewer` keeps camera paths: the working directory, since recordings are only read."""
        return Path.cwd()

    def setup_train(self) -> None:
        config = self.config
        assert config.train_num_rays_per_batch is not None
        self.generator = torch.Generator(self.device).manual_seed(torch.initial_seed() % 2**63)
        self.train_pixel_sampler = config.pixel_sampler.setup(num_rays_per_batch=config.train_num_rays_per_batch)
        if self.test_mode == "val" and "events" in config.supervision:
            _ = (
                self.pair_sampler,
                self.silent_sampler,
                self.instant_sampler,
                self.held_out_pair_sampler,
            )  # so that an error in making them comes before training

    def setup_eval(self) -> None:
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )
        self.eval_dataloader = RandIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )

    @property
    def recording(self) -> EventRecording:
        """The recording, with its current corrections."""
        return self.train_dataset.recording

    @property
    def depth_range(self) -> tuple[float, float]:
        """Nearest and farthest depth of the scene, metres."""
        return scene_depth_range(self.recording, self.config.dataparser.depth_range)

    @property
    def distance(self) -> float:
        """Typical depth of the scene in metres: the geometric mean of its nearest and farthest depth."""
        return math.sqrt(math.prod(self.depth_range))

    def edges(self) -> tuple[Float[Tensor, "edges 3"], Float[Tensor, "edges 3"]]:
        """Places that edges were seen from, and the edges, in scene units: all whose depth `edge_depth` finds."""
        views = edge_depth(self.recording, self.depth_range)
        edges = [np.zeros((0, 3)), *(view.points for view in views)]
        places = [np.zeros((0, 3)), *(np.broadcast_to(view.pose[:, 3], view.points.shape) for view in views)]
        found = (torch.from_numpy(np.concatenate(points)).to(self.device) for points in (places, edges))
        starts, ends = (self.event_camera.in_scene(points).float() for points in found)
        return starts, ends

    @property
    def held_out_spans(self) -> Int64[np.ndarray, "spans 2"]:
        """First and last instant (ns) of each span of time that is held out from training."""
        share = self.config.held_out_events
        return self.recording.spans(HELD_OUT_SPANS, share) if share else np.zeros((0, 2), np.int64)

    @cached_property
    def index(self) -> EventIndex:
        """The events of the recording, on the device."""
        return index_events(self.recording).to(self.device)

    @cached_property
    def pair_sampler(self) -> EventPairSampler | AccumulationSampler:
        """The sampler of pairs of events that the config names.

        Raises:
            FlagError: The recording has no such pair.
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
                missed=self._missed,
            )
        except ValueError as error:
            raise FlagError(f"{self.recording.path}: {error}") from error

    @cached_property
    def held_out_pair_sampler(self) -> HeldOutPairSampler | str:
        """The sampler of pairs whose two events are held out, as far apart as training pairs; or a sentence that says
        why there is no such pair."""
        spans = torch.from_numpy(overlaps(self.recording.stretches, self.held_out_spans)).to(self.device)
        try:
            successors = self.config.pair_mode == "successor"
            distance = 1 if successors else self.config.max_pair_distance or 1
            return HeldOutPairSampler(self.index, spans, distance, self._missed)
        except ValueError as error:
            return str(error)

    @cached_property
    def silent_sampler(self) -> SilentPixelSampler | SilentIntervalSampler | None:
        """The sampler of silent pixels that the config names; None for silent_pairs 0."""
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
        """The sampler of pairs of any two instants; None for instant_pairs 0."""
        if not self.config.instant_pairs:
            return None
        assert self.config.instants_apart_ms is not None
        longest = max(1, round(self.config.instants_apart_ms * 1e6))
        return InstantPairSampler(self.index, *self._span, longest, self._stretches, self._missed)

    @cached_property
    def _missed(self) -> MissedChanges | None:
        """Changes that are added to the sums of events; None if they are not."""
        period = self.config.completed_refractory_ns
        return MissedChanges(self.index, period) if period else None

    @cached_property
    def event_camera(self) -> PosedCamera:
        """The camera of the events, posed in the scene."""
        return self._posed(self.recording.camera, self.recording.trajectory)

    @cached_property
    def event_camera_without_distortion(self) -> PosedCamera:
        """The camera of undistorted pictures of the events, posed in the scene."""
        return self._posed(self.recording.camera.undistorted(), self.recording.trajectory)

    @cached_property
    def frame_camera(self) -> PosedCamera:
        """The camera of the training frames, posed in the scene."""
        frames = self._frames
        return self._posed(frames.picture_camera, frames.trajectory)

    @cached_property
    def frame_colours(self) -> Tensor:
        """All training frames, shape (frames, height, width, 3): uint8, or float32 in [0, 1] where a frame has more
        than 8 bits."""
        pictures = [self.train_dataset.get_numpy_image(i) for i in range(len(self.train_dataset))]
        if any(picture.dtype != np.uint8 for picture in pictures):
            pictures = [brightness(picture) for picture in pictures]
        return torch.from_numpy(np.stack(pictures)).to(self.device)

    @cached_property
    def _frames_are_grey(self) -> bool:
        return bool((self.frame_colours == self.frame_colours[..., :1]).all())

    def next_batch(self, sensor: SensorModel) -> TrainBatch:
        """Draws the batch of one training step.

        Args:
            sensor: Model of the sensor that made the events.
        """
        self.train_count += 1
        config, events, frames = self.config, None, None
        if "events" in config.supervision:
            assert config.event_pairs is not None
            blind = sensor.refractory_period if sensor.lags else None
            pairs, instants = self.pair_sampler, self.instant_sampler
            draw = pairs.sample
            if instants is not None and isinstance(pairs, EventPairSampler) and not pairs.window:
                # what pixels miss while they are blind lies between a pair's end and the next one's beginning
                is_known = not sensor.refractory_period or pairs.missed is not None
                draw = pairs.sample_chains if is_known else pairs.sample
            events = draw(config.event_pairs, self.generator, blind)
            if instants is not None:
                assert config.instant_pairs is not None
                events = events.followed_by(instants.sample_chains(config.instant_pairs, self.generator, blind))
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
        """The rays of a batch, in the order of `TrainBatch.split`."""
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
            chains=() if batch.events is None else batch.events.chains,
        )

    def event_rays(
        self, batch: EventBatch, sensor: SensorModel, places: Float[Tensor, "places 2"] | None = None
    ) -> RayBundle:
        """Rays of the first instants of all pairs, then of all second instants.

        A first instant that is an event is delayed to the end of the refractory period of the pixel.

        Args:
            batch: Pairs of instants.
            sensor: Model of the sensor that made the events.
            places: Points in the pixel, x and y from its centre in pixels. Each instant has one ray through each of
                them, one after the other. Default: the centre alone.
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
        """Time (ns) of each ray of `event_rays`, with its delay."""
        delays, times = self._delays(batch, sensor), torch.cat([batch.start, batch.end])
        return times if delays is None else times + delays.round().long()

    def _delays(self, batch: EventBatch, sensor: SensorModel) -> Tensor | None:
        """Delay (ns) of each ray against its instant, of first and then of second instants: a pixel is blind for the
        refractory period after an event. None for a sensor without such a period."""
        delays = sensor.blind_after(batch.start, batch.end) if batch.starts_at_events else None
        if delays is None:
            return None
        delays[batch.num_of_events :] = 0.0  # pairs of any instants, and silent ones, begin at no event
        return torch.cat([delays, torch.zeros_like(delays)])

    def correct(self, corrections: Corrections) -> None:
        """Applies corrections of clock, poses and lens to the rays, and to the cameras of frames.

        They replace earlier corrections.
        """
        made = ["event_camera", "event_camera_without_distortion", "frame_camera"]
        if corrections.distortion != self.corrections.distortion:
            made.append("frame_colours")  # since frames are undistorted by the lens
        self.corrections = corrections
        for dataset in (self.train_dataset, self.eval_dataset):
            dataset.correct(corrections)
        for name in ("fixed_indices_eval_dataloader", "eval_dataloader"):  # missing in test mode "inference"
            if loader := getattr(self, name, None):
                loader.cameras = self.eval_dataset.cameras.to(self.device)
        for name in made:
            self.__dict__.pop(name, None)

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """Rays of random pixels of the train cameras, for ns-export. Training itself calls `next_batch`."""
        assert self.train_pixel_sampler is not None
        indices = self._frame_pixels(self.train_pixel_sampler.num_rays_per_batch)
        return self._frame_rays(indices, self._frame_times[indices[:, :1]]), {"indices": indices}

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        return self.next_train(step)

    def get_train_rays_per_batch(self) -> int:
        """Number of rays of one training step, of events and frames together."""
        config = self.config
        numbers = (config.event_pairs, config.instant_pairs, config.silent_pairs)
        pairs = sum(number or 0 for number in numbers) if "events" in config.supervision else 0
        instants = self.config.exposure_samples or 1
        return 2 * pairs + (self._num_frame_pixels * instants if "frames" in config.supervision else 0)

    def _parts(self, stretches: Int64[np.ndarray, "stretches 2"]) -> Tensor | None:
        """Stretches (first and last instant, ns) as the samplers take them; None where they are the whole recording."""
        return None if stretches.tolist() == [[*self.recording.span]] else torch.from_numpy(stretches).to(self.device)

    @property
    def _span(self) -> tuple[int, int]:
        """Times (ns) of the first and of the last event that is used."""
        return index_events(self.recording).span

    @property
    def _stretches(self) -> Tensor | None:
        """First and last instant (ns) of each stretch of time for training; None where that is the whole recording."""
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
        """Frame, row and column of random pixels, shape (number, 3)."""
        camera = self.frame_camera.camera
        sizes = len(self._frames.times), camera.height, camera.width
        draws = [torch.randint(size, (number,), generator=self.generator, device=self.device) for size in sizes]
        return torch.stack(draws, dim=-1)

    @property
    def _num_frame_pixels(self) -> int:
        """Number of pixels of frames in one training step. Each has one ray for each instant of its exposure."""
        assert self.config.train_num_rays_per_batch is not None
        return max(1, self.config.train_num_rays_per_batch // (self.config.exposure_samples or 1))

    @cached_property
    def _frame_times(self) -> Tensor:
        return torch.from_numpy(self._frames.times).to(self.device)

    @cached_property
    def _frame_exposures(self) -> Tensor:
        return torch.from_numpy(self._frames.exposed).to(self.device)

    def _frame_instants(self, frames: Tensor) -> Tensor:
        """Instants (ns) at which pixels of frames are rendered, shape (pixels, instants): the middle of the exposure,
        or one random instant in each of several equal parts of it."""
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
