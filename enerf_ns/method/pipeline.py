"""The pipeline: training steps, corrections of poses, and scores over all held-out frames and events."""

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
from enerf_ns.evaluation.display import Display, shown_numbers
from enerf_ns.evaluation.metrics import EVENT_SCORES, Score, event_scores
from enerf_ns.evaluation.protocols import EVENTS_PROTOCOL, described
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.evaluation.views import aligned_views, save_pictures
from enerf_ns.events.batch import EventBatch, TrainBatch
from enerf_ns.method.datamanager import EnerfDataManager, EnerfDataManagerConfig
from enerf_ns.method.held_out_views import held_out_view, held_out_views, scores_at_stated_poses
from enerf_ns.method.memory import SMALL_STEP, free_bytes, step_cost
from enerf_ns.method.model import EnerfModel, EnerfModelConfig, fog_growth
from enerf_ns.method.nerfstudio_seams import leave_out_of_parallel
from enerf_ns.method.stopwatch import Stopwatch
from enerf_ns.method.viewer.guard import guard_viser
from enerf_ns.poses.refiner import (
    BEGINS_UNTIL,
    FINEST_SLOPES,
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
from enerf_ns.rendering.edge_start import start_from_edges
from enerf_ns.rendering.seen_volume import SeenVolume
from enerf_ns.supervision.event_supervision import brightness_change
from enerf_ns.terminal import say, say_where

if TYPE_CHECKING:
    from enerf_ns.method.viewer.scene_view import SceneView

SLOPE_PAIRS = 64
"""Number of pairs of a step at which slopes of brightness are rendered: enough to learn one number, the lag."""

SLOPES_EVERY = 4
"""Steps between two steps in which slopes are rendered."""

LAG_TOLD_AFTER = 200
"""Step at which the learned lag is judged. By then the estimate of a lag of 1.6 ms is two thirds of that, and the
estimate for a sensor without lag is below 0.04 ms."""

PLACES_A_SIDE = 4
"""Columns and rows of points in a pixel over which the scores of events average brightness. Events fire while an edge
crosses their pixel: the true scene, rendered at the centre alone, has a correlation of 0.84 to 0.87 with them, and over
the area 0.998 (`benchmarks/instants.py`)."""

SLOPE_NS = 1_000_000
"""Time (ns) before and after an instant over which the slope of brightness is rendered."""

TAKEN_BACK = (
    "The last corrections of clock, poses and lens are taken back, and no further ones are made, because events fit "
    "them worse than those before; check --depth-range, and poses and calibration with enerf inspect."
)

NOT_REFINED = (
    "Clock, mount, lens and drift of the poses stay as they are before training, because several devices train the "
    "field; training on one device refines them."
)


@dataclass
class EnerfPipelineConfig(VanillaPipelineConfig):
    """The config of Nerfstudio's pipeline, with poses to correct and with what was chosen for the recording."""

    _target: Type = field(default_factory=lambda: EnerfPipeline)  # noqa: UP006
    datamanager: EnerfDataManagerConfig = field(default_factory=EnerfDataManagerConfig)
    model: EnerfModelConfig = field(default_factory=EnerfModelConfig)
    poses: Annotated[RefinerConfig, tyro.conf.arg(name="")] = field(default_factory=RefinerConfig)
    defaults: Fixed[Suppress[MethodDefaults]] = field(default_factory=MethodDefaults)
    """Defaults of the method, for settings that neither a flag nor a preset sets."""
    resolution: Fixed[Suppress[Resolution]] = field(default_factory=Resolution)
    """The choices for the recording, with their reasons; empty until the config is resolved."""

    def setup(self, **kwargs: Any) -> EnerfPipeline:
        """The pipeline, with the choices of the resolution in place of the fields that are None.

        A config that was not resolved by the trainer's config is resolved here.

        Raises:
            SystemExit: The recording, or a setting, cannot be used; with one sentence.
        """
        silence_known_warnings()
        guard_viser()
        make_ffmpeg_available()
        allow_numpy_scalars_in_checkpoints()
        with exit_with_a_sentence():
            resolution = self.resolution
            if not resolution.choices:
                resolution = resolve(self, self.datamanager.dataparser.setup().recording())
            filled = resolution.applied_to(self)
            if kwargs.get("test_mode") == "inference":  # ns-render dataset makes more data managers of this config
                self.datamanager = filled.datamanager
            return self._target(filled, **kwargs)


@dataclass(frozen=True)
class TrainStep:
    """Batch, render and losses of one training step, detached from its graph."""

    batch: TrainBatch
    rgb: Tensor
    """Rendered brightness, shape (rays, 3), in the order of `TrainBatch.split`."""
    accumulation: Tensor
    """Accumulation of each ray, shape (rays, 1)."""
    losses: dict[str, Tensor]
    """Weighted losses by name."""


class EnerfPipeline(VanillaPipeline):
    """Trains on a recording, and scores all held-out frames together.

    Events determine brightness only up to one scale and one offset of its logarithm, which are fitted over all frames.
    """

    datamanager: EnerfDataManager
    config: EnerfPipelineConfig
    last_step: TrainStep
    """The last training step; not set before the first."""
    _seen: tuple[int, SeenVolume] | None = None
    _display: Display | None = None

    def __init__(
        self, config: EnerfPipelineConfig, device: str, world_size: int = 1, local_rank: int = 0, **kwargs: Any
    ):
        super().__init__(config, device, **kwargs)
        self.stopwatch = Stopwatch(device)
        """Measures the parts of a step."""
        self.num_steps: float = math.inf
        """Number of steps of the training; poses are not corrected towards its end. Infinite while unknown."""
        self.seconds_a_step: float | None = None
        """Predicted seconds of a training step; None for small steps, which are not measured."""
        trains = kwargs.get("test_mode", "val") == "val"
        self._fit_memory(trains)
        if trains:
            self._start_threshold_map()
        self.poses = PoseRefiner(config.poses, self.datamanager.recording)
        self._correct_poses()
        if self.model.exposure is not None:
            self.model.exposure.times.copy_(torch.from_numpy(self.datamanager.train_dataset.frames.times))
        if world_size > 1 and local_rank == 0 and trains and self.poses.allowed:
            say(NOT_REFINED)
        self._viewer: SceneView | None = None
        self.model.seen_volume, self.model.display = self.seen_volume, self.shown
        self.world_size = world_size
        if world_size > 1:  # here, since Nerfstudio takes every device for a GPU
            leave_out_of_parallel(self.model, ("sensor", "exposure"))  # which losses use
            gpus = [local_rank] if torch.device(device).type == "cuda" else None
            parallel = DistributedDataParallel(self._model, device_ids=gpus, find_unused_parameters=True)
            self._model = cast("Model", parallel)
            barrier(device_ids=gpus)

    @property
    def model(self) -> EnerfModel:
        return super().model  # type: ignore

    @property
    def viewer(self) -> SceneView:
        """The control that adapts Nerfstudio's viewer to the recording. The viewer finds it among the attributes of the
        pipeline."""
        if self._viewer is None:
            from enerf_ns.method.viewer.scene_view import SceneView  # here, since most commands show no viewer

            self._viewer = SceneView(self.model, self.datamanager)
        return self._viewer

    def seen_volume(self) -> SeenVolume:
        """The volume that the camera of the events saw of the current field. It is computed once after a step."""
        steps = self.datamanager.train_count
        if self._seen is None or self._seen[0] != steps:
            manager = self.datamanager
            self._seen = steps, SeenVolume.of(self.model, manager.recording, manager.index, manager.event_camera)
        return self._seen[1]

    @torch.no_grad()
    def shown(self, rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
        """A picture of brightness as a screen should show it, as `enerf report` does.

        The display is made of some held-out frames when it is first needed, and a line says which it is.
        """
        if self._display is None:
            was_training = self.training
            self.eval()
            numbers = shown_numbers(len(self.datamanager.eval_dataset))
            self._display = Display.of_views([held_out_view(self, number) for number in numbers])
            self.train(was_training)
            height, width = rgb.shape[:2]
            say_where(
                "display",
                f"{self._display.gamma}, as in enerf report; {width} x {height} pixels, of which a smaller "
                "--downscale-factor makes more",
            )
        return self._display.shown(rgb)

    def _fit_memory(self, trains: bool) -> None:
        """Evaluates the field in parts if a training step, or a chunk of a picture, would not fit the memory.

        Raises:
            FlagError: A training step does not fit even in parts.
        """
        config = self.model.config
        trained = self.datamanager.get_train_rays_per_batch() if trains else 0
        rays = max(trained, config.eval_num_rays_per_chunk)
        if rays * config.num_samples <= SMALL_STEP:
            return
        cost, free = step_cost(self.model, rays, config.num_samples), free_bytes(self.device)
        at_once = cost.samples_at_once(free)
        need = (
            f"{rays} rays with {config.num_samples} samples each need {cost.bytes / 1e9:.1f} GB of memory, twice that "
            f"with gradients, but {free / 1e9:.1f} GB are free"
        )
        if at_once == 0 and trains:
            raise FlagError(
                f"{need}; give fewer with --pipeline.datamanager.event-pairs, --pipeline.datamanager.silent-pairs, "
                "--pipeline.datamanager.train-num-rays-per-batch or --pipeline.model.eval-num-rays-per-chunk."
            )
        if at_once is not None:
            at_once = max(at_once, config.num_samples)
            say(
                f"{need}. The field is evaluated at {at_once} samples at a time, and twice in training, which takes a "
                "third longer."
            )
        self.model.samples_at_once = at_once
        again = 1.0 if at_once is None else 4.0 / 3.0  # parts are rendered once more for the backward pass
        self.seconds_a_step = again * cost.seconds * trained / rays if trains else None

    @torch.no_grad()
    def _start_threshold_map(self) -> None:
        """Starts the map of thresholds from an estimate from the events, if the sensor has no refractory period."""
        sensor = self.model.sensor
        if sensor.threshold_map is None or sensor.refractory_period:
            return
        index = index_events(self.datamanager.recording)
        on, off = (torch.as_tensor(threshold).item() for threshold in sensor.contrast_thresholds)
        noise = noise_per_event(index, (on, off)).value
        sensor.threshold_map.start_from(*threshold_differences(index, (on, off), noise))

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of the next batch."""
        sensor = self.model.sensor
        if self.training and step == 0 and self.model.config.edge_start:
            self._start_from_edges()
        if self.training and step == LAG_TOLD_AFTER and (left_out := sensor.leave_out_small_lag()):
            say(left_out)
        self.model.fog_growth = fog_growth(step, self.num_steps)
        batch = self.datamanager.next_batch(sensor)
        self.stopwatch.lap("draw")
        rays = self.datamanager.rays(batch, sensor)
        self.stopwatch.lap("rays")
        outputs = self._model(rays)
        if self.training and batch.events is not None and sensor.learns_lag:
            slopes = self._slopes(batch.events, SLOPE_PAIRS if step % SLOPES_EVERY == 0 else 0)
            links = batch.events.links  # their rates alone would bias the delay, see `Lag.lag`
            links = links and replace(links, slopes=slopes.new_zeros(len(links), 2))
            batch = replace(batch, events=replace(batch.events, slopes=slopes, links=links))
        self.stopwatch.lap("render")
        metrics = self.model.get_metrics_dict(outputs, batch)
        losses = self.model.get_loss_dict(outputs, batch, metrics)
        detached = {name: loss.detach() for name, loss in losses.items()}
        if self.training and self.world_size == 1 and batch.events is not None:
            self._refine_poses(self.poses, batch.events, step)
        self.last_step = TrainStep(batch, outputs["rgb"].detach(), outputs["accumulation"].detach(), detached)
        self.stopwatch.lap("losses")
        return outputs, losses, metrics

    def _start_from_edges(self) -> None:
        """Starts the field and the proposal network from the depth of edges that events show."""
        model = self.model
        places, edges = self.datamanager.edges()
        if not len(edges) or model.config.panorama:
            say("Events show the depth of no edge, so that the field starts without.")
            return
        say(f"The field starts from {len(edges):,} points of edges.")
        if self._viewer is not None:
            self._viewer.draw_edges(edges)
        assert model.config.near_plane is not None
        densities = [density for density in (model.field.geometry, model.proposal) if density is not None]
        start_from_edges(densities, places, edges, model.config.near_plane)

    def _refine_poses(self, refiner: PoseRefiner, batch: EventBatch, step: int) -> None:
        """Observes the errors of the poses at some pairs of a training step, and corrects the poses now and then."""
        may_begin = step < BEGINS_UNTIL * self.num_steps
        every = LOOK_AGAIN_EVERY if refiner.corrected and may_begin else LOOK_EVERY
        if not refiner.allowed or step < FIRST_STEP or step >= FROZEN_FROM * self.num_steps or step % every:
            return
        if refiner.is_taken_back or not (refiner.corrected or may_begin):
            return  # nothing will be corrected any more
        manager, sensor, model = self.datamanager, self.model.sensor, self.model
        fired = batch.fired.stop
        chosen = torch.zeros(len(batch), dtype=torch.bool)
        generator = torch.Generator().manual_seed(step)
        chosen[torch.randperm(fired, generator=generator)[:PAIRS]] = True
        some = batch.subset(chosen.to(batch.pixels.device))
        rays = manager.event_rays(some, sensor)
        times = manager.event_times(some, sensor)
        camera = manager.event_camera
        unit = torch.as_tensor(sensor.mean_threshold).item()
        distance = 2.0  # of a panorama, in contracted space
        if not model.config.panorama:
            near, far = manager.depth_range
            far = min(far, manager.config.dataparser.contraction_depth or far)
            distance = camera.scale * math.sqrt(near * far)
        with (
            model.field.geometry.slopes_over(FINEST_SLOPES * distance),
            torch.random.fork_rng(devices=[] if self.device == "cpu" else None),  # training must draw as without this
        ):
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
            lags = torch.zeros(2, len(some), 2)  # delays of the sensor, which the clock must not explain
            if sensor.learns_lag:
                lags[..., 0] = 1.0 / sensor.cutoff_share(rgb, some.pixels.repeat(2)).view(2, -1).cpu()
            if sensor.refractory_period and some.starts_at_events:
                lags[0, some.of_events, 1] = 1.0
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
            if refiner.is_taken_back:
                say(TAKEN_BACK)

    def _correct_poses(self) -> None:
        """Applies the current corrections of the poses to the rays and to the held-out frames."""
        self.datamanager.correct(self.poses.corrections)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        super().load_pipeline(loaded_state, step)
        self._correct_poses()
        self.config.datamanager.corrections = self.poses.corrections

    @torch.no_grad()
    def _slopes(self, batch: EventBatch, number: int) -> Float[Tensor, "pairs 2"]:
        """Slopes of the rendered log brightness (1/s) at both instants of the first `number` pairs of events; 0 for the
        other pairs."""
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
        """Outputs, losses and metrics of the next batch, rendered as in evaluation."""
        self.eval()
        with torch.no_grad():
            results = self.get_train_loss_dict(step)
        self.train()
        return results

    @property
    def num_scored_pairs(self) -> int:
        """Number of different pairs of events that `event_scores` draws from, or of all events if none are held out."""
        manager = self.datamanager
        sampler = manager.held_out_pair_sampler if manager.config.held_out_events else manager.index
        return 0 if isinstance(sampler, str) else len(sampler)

    @torch.no_grad()
    def event_scores(self, num_pairs: int = 2048) -> dict[str, Score]:
        """The scores of the protocol "events" over random pairs of held-out events.

        The brightness of a pixel is averaged over its area. With `held_out_events` 0, training pairs are scored.

        Args:
            num_pairs: Number of pairs.

        Returns:
            The scores by name; a sentence in place of each score if there is no such pair.
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
        return event_scores(change, measured, torch.as_tensor(sensor.mean_threshold).item())

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """The `summary_scores` that have a value. Prints the protocol, and for each score without a value the reason.

        Args:
            step: Step of the training, if Nerfstudio logs the result: the name of the protocol is left out then.
            output_path: Folder for one picture of each frame, recorded beside rendered.
            get_std: Also return the standard deviation over the frames.

        Raises:
            SystemExit: The pictures cannot be written; with one sentence.
        """
        views, summary = held_out_views(self)
        if output_path is not None:
            with exit_with_a_sentence():
                save_pictures(aligned_views(views)[0], output_path)
        scores = summary_scores(views, summary, get_std)
        protocol = str(scores["protocol"] if step is None else scores.pop("protocol"))
        if step is None and self.poses.corrections.words:
            stated = scores_at_stated_poses(self)
            scores |= {f"{name}_at_stated_poses": value for name, value in stated.items()}
        CONSOLE.print(described(protocol), soft_wrap=True, highlight=False, markup=False)
        not_scored: Any = scores.pop("not_scored", {})
        for name, reasons in not_scored.items():
            if protocol == EVENTS_PROTOCOL and name not in EVENT_SCORES:
                continue  # the protocol, which is printed, needs no frames
            for reason, numbers in reasons.items():
                of = f" of {len(numbers)} of {len(views)} frames ({', '.join(map(str, numbers))})" if numbers else ""
                CONSOLE.print(f"No {name}{of}: {reason}.", soft_wrap=True, highlight=False, markup=False)
        return {name: value for name, value in scores.items() if value is not None}
