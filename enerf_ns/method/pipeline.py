"""Evaluation over the whole set of held-out frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Type, cast  # noqa: UP035 - tyro reads these annotations on Python 3.10

import torch
import tyro
from jaxtyping import Float
from nerfstudio.models.base_model import Model
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.distributed import barrier
from torch.nn.parallel import DistributedDataParallel
from tyro.conf import Fixed, Suppress

from enerf_ns.choices.resolution import MethodDefaults, Resolution
from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import FlagError, exit_with_a_sentence
from enerf_ns.dataparsers.recording.ffmpeg import make_ffmpeg_available
from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints
from enerf_ns.dataparsers.sensor_estimates.estimates import noise_per_event, threshold_differences
from enerf_ns.evaluation.metrics import EVENT_SCORES, Score, event_scores
from enerf_ns.evaluation.protocols import described
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.evaluation.views import aligned_views, save_pictures
from enerf_ns.events.batch import EventBatch, TrainBatch
from enerf_ns.method.datamanager import EnerfDataManager, EnerfDataManagerConfig
from enerf_ns.method.held_out_views import held_out_views, scores_at_stated_poses
from enerf_ns.method.memory import SMALL_STEP, free_bytes, step_cost
from enerf_ns.method.model import EnerfModel, EnerfModelConfig
from enerf_ns.method.stopwatch import Stopwatch
from enerf_ns.poses.refiner import (
    BEGINS_UNTIL,
    FIRST_STEP,
    FROZEN_FROM,
    LOOK_AGAIN_EVERY,
    LOOK_EVERY,
    LOOKS_A_SOLUTION,
    PAIRS,
    PoseRefiner,
    RefinerConfig,
    render_slopes,
)
from enerf_ns.quiet import silence_known_warnings
from enerf_ns.rendering.seen_volume import SeenVolume
from enerf_ns.supervision.event_supervision import brightness_change
from enerf_ns.terminal import say

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer_elements import ViewerControl

SLOPE_PAIRS = 64
"""Pairs of a step of which slopes of brightness are rendered: enough to learn one number from."""

SLOPES_EVERY = 4
"""Steps from one of which slopes are rendered to the next."""

LAG_TOLD_AFTER = 200
"""Steps after which a lag that is learned has shown itself: one of 1.6 ms comes to two thirds of that, on a sensor
without one it stays within 0.04 ms of 0."""

PLACES_A_SIDE = 4
"""Columns and rows of places in a pixel whose mean brightness is what the pixel sees. Events fire while an edge goes
through their pixel, so that the true scene, seen through the centre alone, explains 0.84 to 0.87 of them (correlation),
and over the area 0.998 (`benchmarks/instants.py`)."""

SLOPE_NS = 1_000_000
"""Time (ns) before and after an instant between which the slope of brightness is rendered."""


@dataclass
class EnerfPipelineConfig(VanillaPipelineConfig):
    """Nerfstudio's pipeline, with one brightness fit over all held-out frames."""

    _target: Type = field(default_factory=lambda: EnerfPipeline)  # noqa: UP006
    datamanager: EnerfDataManagerConfig = field(default_factory=EnerfDataManagerConfig)
    model: EnerfModelConfig = field(default_factory=EnerfModelConfig)
    poses: Annotated[RefinerConfig, tyro.conf.arg(name="")] = field(default_factory=RefinerConfig)
    defaults: Fixed[Suppress[MethodDefaults]] = field(default_factory=MethodDefaults)
    """What is used where neither flag nor preset says otherwise."""
    resolution: Fixed[Suppress[Resolution]] = field(default_factory=Resolution)
    """What was chosen for the recording, and why; empty before that."""

    def setup(self, **kwargs: Any) -> EnerfPipeline:
        """The pipeline, with what the resolution says in place of what is open here.

        Raises:
            SystemExit: The recording cannot be used, or not so; with one sentence.
        """
        silence_known_warnings()
        make_ffmpeg_available()
        allow_numpy_scalars_in_checkpoints()
        with exit_with_a_sentence():
            resolution = self.resolution
            if not resolution.choices:
                resolution = resolve(self, self.datamanager.dataparser.setup().recording())
            filled = resolution.applied_to(self)
            if kwargs.get("test_mode") == "inference":  # ns-render dataset makes data managers of this config, too
                self.datamanager = filled.datamanager
            return self._target(filled, **kwargs)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Reads config.yml of runs from before choices were stored apart from what was set, and before poses were
        refined, too."""
        as_read = RefinerConfig(refine_clock=False, refine_mount=False, refine_lens=False, refine_drift=False)
        self.__dict__.update({"defaults": MethodDefaults(), "resolution": Resolution(), "poses": as_read, **state})


@dataclass(frozen=True)
class TrainStep:
    """What one training step looked at, rendered and lost, without its graph."""

    batch: TrainBatch
    rgb: Tensor
    """Rendered, shape (rays, 3), in the order of `TrainBatch.split`."""
    accumulation: Tensor
    """Share of each ray that surfaces stop, shape (rays, 1)."""
    losses: dict[str, Tensor]
    """Each term with its weight."""


class EnerfPipeline(VanillaPipeline):
    """Scores held-out frames together, because events fix brightness only up to one scale and offset."""

    datamanager: EnerfDataManager
    config: EnerfPipelineConfig
    last_step: TrainStep
    """The last training step, once there was one."""
    _seen: tuple[int, SeenVolume] | None = None

    def __init__(
        self, config: EnerfPipelineConfig, device: str, world_size: int = 1, local_rank: int = 0, **kwargs: Any
    ):
        super().__init__(config, device, **kwargs)
        self.stopwatch = Stopwatch(device)
        """Is told where each part of a step ends."""
        self.num_steps: float = math.inf
        """Steps of the training that are known to come, towards whose end poses stay as they are."""
        self.seconds_a_step: float | None = None
        """What a training step will take; None where nobody needs to know, since it is small."""
        trains = kwargs.get("test_mode", "val") == "val"
        self._fit_memory(trains)
        if trains:
            self._start_threshold_map()
        if self.model.exposure is not None:
            self.model.exposure.times.copy_(torch.from_numpy(self.datamanager.train_dataset.frames.times))
        self.poses: PoseRefiner | None = None
        if "events" in config.datamanager.supervision and world_size == 1:
            self.poses = PoseRefiner(config.poses, self.datamanager.recording)
            self._correct_poses()
        self._viewer: ViewerControl | None = None
        self.model.seen_volume = self.seen_volume
        self.world_size = world_size
        if world_size > 1:  # here, since Nerfstudio takes every device for a GPU
            gpus = [local_rank] if torch.device(device).type == "cuda" else None
            parallel = DistributedDataParallel(self._model, device_ids=gpus, find_unused_parameters=True)
            self._model = cast("Model", parallel)
            barrier(device_ids=gpus)

    @property
    def model(self) -> EnerfModel:
        return super().model  # type: ignore

    @property
    def viewer(self) -> ViewerControl:
        """What makes Nerfstudio's viewer one on the recording; the viewer looks for it among the attributes of the
        pipeline, and nobody else asks."""
        if self._viewer is None:
            from enerf_ns.method.viewer.scene_view import SceneView  # here, since hardly any command shows a viewer

            self._viewer = SceneView(self.model, self.datamanager)
        return self._viewer

    def seen_volume(self) -> SeenVolume:
        """What the events' camera saw of the field as it is; made when it is first asked for after a training step."""
        steps = self.datamanager.train_count
        if self._seen is None or self._seen[0] != steps:
            manager = self.datamanager
            self._seen = steps, SeenVolume.of(self.model, manager.recording, manager.index, manager.event_camera)
        return self._seen[1]

    def _fit_memory(self, trains: bool) -> None:
        """Has the field be asked in parts where a training step, or a part of a picture, would not fit the memory.

        Raises:
            FlagError: A training step does not fit in any way.
        """
        config = self.model.config
        trained = self.datamanager.get_train_rays_per_batch() if trains else 0
        rays = max(trained, config.eval_num_rays_per_chunk)
        if rays * config.num_samples <= SMALL_STEP:
            return
        cost, free = step_cost(self.model, rays, config.num_samples), free_bytes(self.device)
        at_once = cost.samples_at_once(free)
        need = (
            f"{rays} rays with {config.num_samples} samples each keep {cost.bytes / 1e9:.1f} GB, with gradients twice "
            f"that, and {free / 1e9:.1f} GB are free"
        )
        if at_once == 0 and trains:
            raise FlagError(
                f"{need}; give fewer with --pipeline.datamanager.event-pairs, --pipeline.datamanager.silent-pairs, "
                "--pipeline.datamanager.train-num-rays-per-batch or --pipeline.model.eval-num-rays-per-chunk."
            )
        if at_once is not None:
            at_once = max(at_once, config.num_samples)
            say(
                f"{need}: the field is asked for {at_once} samples at a time, and when it learns twice, a third slower."
            )
        self.model.samples_at_once = at_once
        again = 1.0 if at_once is None else 4.0 / 3.0  # parts are rendered once more for the backward pass
        self.seconds_a_step = again * cost.seconds * trained / rays if trains else None

    @torch.no_grad()
    def _start_threshold_map(self) -> None:
        """Has the map of thresholds start from what events tell before training, where pixels are never blind."""
        sensor = self.model.sensor
        if sensor.threshold_map is None or sensor.refractory_period:
            return
        index = index_events(self.datamanager.recording)
        on, off = (float(threshold) for threshold in sensor.contrast_thresholds)
        noise = noise_per_event(index, (on, off)).value
        sensor.threshold_map.start_from(*threshold_differences(index, (on, off), noise))

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of the next batch."""
        sensor = self.model.sensor
        if self.training and step == LAG_TOLD_AFTER and (left_out := sensor.leave_out_small_lag()):
            say(left_out)
        batch = self.datamanager.next_batch(sensor)
        self.stopwatch.lap("draw")
        rays = self.datamanager.rays(batch, sensor)
        self.stopwatch.lap("rays")
        outputs = self._model(rays)
        if self.training and batch.events is not None and sensor.learns_lag:
            slopes = self._slopes(batch.events, SLOPE_PAIRS if step % SLOPES_EVERY == 0 else 0)
            batch = replace(batch, events=replace(batch.events, slopes=slopes))
        self.stopwatch.lap("render")
        metrics = self.model.get_metrics_dict(outputs, batch)
        losses = self.model.get_loss_dict(outputs, batch, metrics)
        detached = {name: loss.detach() for name, loss in losses.items()}
        if self.training and self.poses is not None and batch.events is not None:
            self._refine_poses(self.poses, batch.events, step)
        self.last_step = TrainStep(batch, outputs["rgb"].detach(), outputs["accumulation"].detach(), detached)
        self.stopwatch.lap("losses")
        return outputs, losses, metrics

    def _refine_poses(self, refiner: PoseRefiner, batch: EventBatch, step: int) -> None:
        """Has the poses corrected, now and then, by what pairs of a training step tell."""
        may_begin = step < BEGINS_UNTIL * self.num_steps
        every = LOOK_AGAIN_EVERY if refiner.corrected and may_begin else LOOK_EVERY
        if not (refiner.corrected or may_begin):
            return  # nothing is, or will be
        if not refiner.allowed or step < FIRST_STEP or step >= FROZEN_FROM * self.num_steps or step % every:
            return
        manager, sensor, model = self.datamanager, self.model.sensor, self.model
        fired = batch.fired.stop
        chosen = torch.zeros(len(batch), dtype=torch.bool)
        generator = torch.Generator().manual_seed(step)
        chosen[torch.randperm(fired, generator=generator)[:PAIRS]] = True
        some = batch.subset(chosen.to(batch.pixels.device))
        rays = manager.event_rays(some, sensor)
        times = manager.event_times(some, sensor)
        camera = manager.event_camera
        unit = float(sensor.mean_threshold)
        with torch.random.fork_rng(devices=[] if self.device == "cpu" else None):  # training draws as without looks
            rgb, slopes = render_slopes(
                model,
                rays,
                lambda rgb: sensor.log_brightness(rgb, some.pixels.repeat(2)) / unit,
                camera.axes(times),
                camera.scale,
            )
        with torch.no_grad():
            start, end = rgb.chunk(2)
            change = brightness_change(start, end, some, sensor) / unit
            residual = sensor.measured_change(some) / unit - change
            others = torch.stack([change, (some.on + some.off).float(), 1e-9 * (some.end - some.start).float()], dim=1)
            lags = torch.zeros(2, len(some), 2)  # the clock is told only as far as these do not explain the same
            if sensor.learns_lag:
                lags[..., 0] = 1.0 / sensor.cutoff_share(rgb, some.pixels.repeat(2)).view(2, -1).cpu()
            if sensor.refractory_period and some.starts_at_events:
                lags[0, :, 1] = 1.0
        refiner.look(
            residual.double().cpu().numpy(),
            slopes,
            times.view(2, -1).cpu().numpy(),
            some.pixels.cpu().numpy(),
            others.double().cpu().numpy(),
            lags.double().numpy(),
        )
        if int(refiner.looks) % LOOKS_A_SOLUTION == 0 and refiner.solve(step, may_begin):
            self._correct_poses()

    def _correct_poses(self) -> None:
        """Has rays, and held-out frames, follow the poses as they are corrected by now."""
        if self.poses is not None:
            self.datamanager.correct(self.poses.corrections)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        super().load_pipeline(loaded_state, step)
        self._correct_poses()
        if self.poses is not None:
            self.config.datamanager.corrections = self.poses.corrections

    @torch.no_grad()
    def _slopes(self, batch: EventBatch, number: int) -> Float[Tensor, "pairs 2"]:
        """By how much rendered log brightness changes a second around both instants of the first pairs of events, up to
        a number; 0 of the others."""
        manager, sensor = self.datamanager, self.model.sensor
        number = min(number, len(batch) - batch.num_silent)
        found = torch.zeros(len(batch), 2, device=batch.start.device)
        if number == 0:
            return found
        instants = torch.cat([batch.start[:number], batch.end[:number]])
        trajectory = manager.event_camera.trajectory
        before = (instants - SLOPE_NS).clamp(min=trajectory.start)
        after = (instants + SLOPE_NS).clamp(max=trajectory.end)
        none = torch.zeros_like(instants)
        around = EventBatch(batch.pixels[:number].repeat(2), before, after, none, none, starts_at_events=False)
        seen = self.model.get_outputs(manager.rays(TrainBatch(around, None), sensor))["rgb"]
        first, second = seen.chunk(2)
        slopes = brightness_change(first, second, around, sensor) / (1e-9 * (after - before)).float()
        found[:number] = slopes.view(2, number).t()
        return found

    def get_eval_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of the next batch, as of `get_train_loss_dict` but rendered as in evaluation."""
        self.eval()
        with torch.no_grad():
            results = self.get_train_loss_dict(step)
        self.train()
        return results

    @torch.no_grad()
    def event_scores(self, num_pairs: int = 2048) -> dict[str, Score]:
        """The scores of the protocol "events", over random pairs of the events that are held out in time
        (`held_out_events`); where none are, of the training's. What a pixel sees is rendered over its area.
        """
        manager, sensor = self.datamanager, self.model.sensor
        sampler = manager.held_out_pair_sampler if manager.config.held_out_events else manager.pair_sampler
        if isinstance(sampler, str):
            return dict.fromkeys(EVENT_SCORES, sampler)
        self.eval()
        blind = sensor.refractory_period if sensor.lags else None
        batch = sampler.sample(num_pairs, torch.Generator(self.device).manual_seed(0), blind)
        middles = (torch.arange(PLACES_A_SIDE, device=self.device) + 0.5) / PLACES_A_SIDE - 0.5
        places = torch.cartesian_prod(middles, middles)
        rays = manager.event_rays(batch, sensor, places).reshape((2 * num_pairs, len(places)))
        start, end = self.model.get_outputs_for_camera_ray_bundle(rays)["rgb"].mean(dim=1).view(2, num_pairs, -1)
        self.train()
        change = brightness_change(start, end, batch, sensor)
        measured = sensor.measured_change(batch)
        return event_scores(change, measured, float(sensor.mean_threshold))

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """The `summary_scores` that have a value; what has none is printed, with the reason, and so is the protocol.

        Args:
            step: Given while training, when Nerfstudio logs what is returned: the name of the protocol is left out.
            output_path: Folder for one picture a frame, recorded beside rendered.
            get_std: Give the standard deviation over the frames too.

        Raises:
            SystemExit: The pictures cannot be written; with one sentence.
        """
        views, summary = held_out_views(self)
        if output_path is not None:
            with exit_with_a_sentence():
                save_pictures(aligned_views(views)[0], output_path)
        scores = summary_scores(views, summary, get_std)
        protocol = str(scores["protocol"] if step is None else scores.pop("protocol"))
        if step is None and self.poses is not None and self.poses.corrected:
            stated = scores_at_stated_poses(self)
            scores |= {f"{name}_at_stated_poses": value for name, value in stated.items()}
        CONSOLE.print(described(protocol), soft_wrap=True, highlight=False, markup=False)
        not_scored: Any = scores.pop("not_scored", {})
        for name, reasons in not_scored.items():
            for reason, numbers in reasons.items():
                of = f" of {len(numbers)} of {len(views)} frames ({', '.join(map(str, numbers))})" if numbers else ""
                CONSOLE.print(f"No {name}{of}: {reason}.", soft_wrap=True, highlight=False, markup=False)
        return {name: value for name, value in scores.items() if value is not None}
