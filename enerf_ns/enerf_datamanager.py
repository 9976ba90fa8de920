"""What one training step draws: event pairs, silent pixels, pixels of frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Optional, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from torch import Tensor
from tyro.conf import OmitSubcommandPrefixes, Suppress
from tyro.extras import subcommand_type_from_defaults

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, event_data
from enerf_ns.dataparsers.formats.registry import formats
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.event_dataset import EventDataset
from enerf_ns.events.samplers import EventPairSampler, SilentPixelSampler
from enerf_ns.ray_samplers import PairedRayBundle
from enerf_ns.sensor.response import colour_channels

DATAPARSERS = {name: config for name, config in all_dataparsers.items() if isinstance(config, EventDataParserConfig)}
EventDataParserUnion = OmitSubcommandPrefixes[
    subcommand_type_from_defaults(
        DATAPARSERS,
        {format.command: format.description for format in formats() if format.command in DATAPARSERS}
        | {"event-data": event_data.description or ""},
        prefix_names=False,
    )
]


@dataclass
class EnerfDataManagerConfig(VanillaDataManagerConfig):
    """Event pairs, silent pixels and frame pixels of a recording."""

    _target: Type = field(default_factory=lambda: EnerfDataManager)  # noqa: UP006
    dataparser: EventDataParserUnion = field(default_factory=EventDataParserConfig)  # type: ignore
    """Format of the recording."""
    supervision: Literal["events", "events+frames", "frames"] = "events"
    """What the field learns from."""
    event_pairs: int = 1024
    """Pairs of instants with events between them, drawn at each step."""
    pair_mode: Optional[Literal["successor", "partner", "window"]] = None  # noqa: UP045
    """The other event of a pair: the pixel's next; one of its next few; its last in a window of time. None: one of the
    next few, but the next where the sensor has a refractory period, in which changes go unseen."""
    max_pair_distance: int = 10
    """Events of the pixel that a partner may lie ahead, for pair-mode partner."""
    window_ms: float = 60.0
    """Length of the windows for pair-mode window."""
    uniform_over: Literal["pairs", "pixels"] = "pairs"
    """Draw every pair alike, or every active pixel alike."""
    silent_pairs: int = 341
    """Pairs of instants at a pixel that saw no event between them, drawn at each step."""
    silence_ms: float = 20.0
    """Shortest silence of a pixel that counts."""
    train_num_rays_per_batch: int = 1024
    """Pixels of frames drawn at each step, where the field learns from frames."""
    pixel_sampler: Suppress[PixelSamplerConfig] = field(default_factory=PixelSamplerConfig)


class EnerfDataManager(VanillaDataManager[EventDataset]):
    """Draws rays and what the sensor saw along them. All rays of a step come in one `PairedRayBundle`."""

    config: EnerfDataManagerConfig
    train_dataset: EventDataset
    eval_dataset: EventDataset

    def setup_train(self) -> None:
        self.generator = torch.Generator(self.device).manual_seed(torch.initial_seed() % 2**63)
        self.frame_colors: Tensor | None = None
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, self.config.train_num_rays_per_batch)
        if self.test_mode != "val":
            return
        recording = self.train_dataset.recording
        if "frames" in self.config.supervision:
            pictures = [self.train_dataset.get_numpy_image(i) for i in range(len(self.train_dataset))]
            self.frame_colors = torch.from_numpy(np.stack(pictures)).to(self.device)
        if "events" in self.config.supervision:
            self.setup_events(recording)

    def setup_events(self, recording: EventRecording) -> None:
        """Index the events on the device, and what turns pixels and times into rays."""
        config, camera = self.config, recording.camera
        assert config.pair_mode is not None, "enerf_ns.choices fills it in"
        index = index_events(recording).to(self.device)
        self.silent_sampler = None
        try:
            self.pair_sampler = EventPairSampler(
                index,
                config.pair_mode,
                max_distance=config.max_pair_distance,
                window_ns=round(config.window_ms * 1e6),
                uniform_over=config.uniform_over,
                refractory_ns=recording.refractory_period,
            )
            if config.silent_pairs:
                first, last = index_events(recording).span
                silence = round(config.silence_ms * 1e6)
                self.silent_sampler = SilentPixelSampler(
                    index, first, last, silence, silence, recording.refractory_period
                )
        except ValueError as error:
            raise SystemExit(f"enerf: {recording.path}: {error}") from error
        directions = camera.pixel_directions().reshape(-1, 3)
        norm = np.linalg.norm(directions, axis=-1, keepdims=True)
        self.pixel_directions = torch.from_numpy(directions / norm).float().to(self.device)
        self.pixel_directions_norm = torch.from_numpy(norm).float().to(self.device)
        self.pixel_area = 1.0 / (camera.fx * camera.fy)
        self.pixel_channels = None
        if recording.bayer_pattern is not None:
            channels = colour_channels(recording.bayer_pattern, camera.width, camera.height)
            self.pixel_channels = channels.to(self.device)
        self.trajectory = recording.trajectory

    def setup_eval(self) -> None:
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )
        self.eval_dataloader = RandIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device, num_workers=0
        )

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """Rays of one step, and what was seen along them.

        Returns:
            Rays in the order of `PairedRayBundle`, event pairs before silent ones, and a batch of: `num_pairs`, event
            pairs and silent ones; `on` and `off` (event pairs,), the numbers of events of each polarity between the
            two instants; `channel` (pairs,), the colour channel that the pixel sees, where the sensor has a colour
            filter; `image` (frame rays, 3) in [0, 1] where the field learns from frames. A loaded run, which is not
            training, draws pixels evenly from its cameras.
        """
        self.train_count += 1
        if self.test_mode != "val":
            assert self.train_pixel_sampler is not None
            return self.frame_rays(self.train_pixel_sampler.num_rays_per_batch)
        bundles: list[RayBundle] = []
        batch: dict = {}
        num_pairs = 0
        if "events" in self.config.supervision:
            pairs = self.pair_sampler.sample(self.config.event_pairs, self.generator)
            batch |= {"on": pairs.on, "off": pairs.off}
            pixels, start, end = pairs.pixels, pairs.start, pairs.end
            if self.silent_sampler is not None:
                silent = self.silent_sampler.sample(self.config.silent_pairs, self.generator)
                pixels = torch.cat([pixels, silent.pixels])
                start, end = torch.cat([start, silent.start]), torch.cat([end, silent.end])
            num_pairs = len(pixels)
            if self.pixel_channels is not None:
                batch["channel"] = self.pixel_channels[pixels]
            bundles.append(self.event_rays(pixels.repeat(2), torch.cat([start, end])))
        if self.frame_colors is not None:
            rays, frame_batch = self.frame_rays(self.config.train_num_rays_per_batch)
            bundles.append(rays)
            batch |= frame_batch
        batch["num_pairs"] = num_pairs
        return concatenate_rays(bundles, num_pairs), batch

    def event_rays(self, pixels: Tensor, times: Tensor) -> RayBundle:
        """Rays (n,) of pixels of the event camera (n,), as y * width + x, at times (n,) in ns."""
        outputs = self.train_dataparser_outputs
        poses = self.trajectory.poses(times)
        transform = outputs.dataparser_transform.to(poses)
        rotation = transform[:, :3] @ poses[..., :3]
        origins = outputs.dataparser_scale * (poses[..., 3] @ transform[:, :3].T + transform[:, 3])
        directions = torch.einsum("nij,nj->ni", rotation.float(), self.pixel_directions[pixels])
        return RayBundle(
            origins=origins.float(),
            directions=directions,
            pixel_area=torch.full_like(origins[:, :1], self.pixel_area, dtype=torch.float32),
            camera_indices=torch.zeros_like(pixels)[:, None],
            metadata={"directions_norm": self.pixel_directions_norm[pixels]},
        )

    def frame_rays(self, num_rays: int) -> tuple[RayBundle, dict]:
        """Rays of pixels drawn evenly from the train cameras, and their colours where frames are loaded."""
        cameras = self.train_dataset.cameras.to(self.device)
        height, width = int(cameras.height[0]), int(cameras.width[0])
        frame, row, column = (
            torch.randint(high, (num_rays,), generator=self.generator, device=self.device)
            for high in (len(cameras), height, width)
        )
        coordinates = torch.stack([row, column], dim=-1) + 0.5
        rays = cameras.generate_rays(camera_indices=frame[:, None], coords=coordinates)
        batch = {"indices": torch.stack([frame, row, column], dim=-1)}
        if self.frame_colors is not None:
            batch["image"] = self.frame_colors[frame, row, column].float() / 255.0
        return rays, batch

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        return self.next_train(step)

    def get_train_rays_per_batch(self) -> int:
        """Rays of one training step, of events and frames together."""
        config = self.config
        pairs = config.event_pairs + config.silent_pairs if "events" in config.supervision else 0
        return 2 * pairs + (config.train_num_rays_per_batch if "frames" in config.supervision else 0)


def concatenate_rays(bundles: list[RayBundle], num_pairs: int) -> PairedRayBundle:
    """One bundle of several, the first of which holds the pairs."""

    def join(name: str) -> Tensor:
        return torch.cat([getattr(bundle, name) for bundle in bundles])

    return PairedRayBundle(
        origins=join("origins"),
        directions=join("directions"),
        pixel_area=join("pixel_area"),
        camera_indices=join("camera_indices"),
        metadata={"directions_norm": torch.cat([bundle.metadata["directions_norm"] for bundle in bundles])},
        num_pairs=num_pairs,
    )
