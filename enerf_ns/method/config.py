"""The methods that this package registers with Nerfstudio."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from operator import attrgetter
from typing import Any, Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from enerf_ns.choices.resolution import MethodDefaults
from enerf_ns.flags import speak_for_methods
from enerf_ns.method.datamanager import EnerfDataManagerConfig
from enerf_ns.method.model import EnerfModelConfig
from enerf_ns.method.pipeline import EnerfPipelineConfig
from enerf_ns.method.trainer import EnerfTrainerConfig
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.supervision.published_losses import PUBLISHED_LOSSES


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam with the settings of instant neural graphics primitives, all parameters in one kernel."""

    betas: Tuple[float, float] = (0.9, 0.99)  # noqa: UP006
    """Decay of Adam's running means."""
    fused: bool = True
    """Update all parameters in one kernel, which is several times faster than a loop on a hash grid."""


@dataclass
class DecayOverRunSchedulerConfig(ExponentialDecaySchedulerConfig):
    """Learning rate that falls exponentially from the first step to the last."""

    max_steps: Optional[int] = None  # type: ignore  # noqa: UP045
    """Step at which lr_final is reached. Default: the last step of the run."""


def method_config(
    name: str, iterations: int, learning_rate: float, pipeline: EnerfPipelineConfig
) -> EnerfTrainerConfig:
    """The config of a method, on the GPU if there is one. Its learning rates fall to a tenth over the run."""
    pipeline.defaults = replace(pipeline.defaults, settings=_settings(pipeline))
    return EnerfTrainerConfig(
        method_name=name,
        max_num_iterations=iterations,
        steps_per_save=1000,
        steps_per_eval_batch=0,  # never: ErrorAgainstTime evaluates runs
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        mixed_precision=False,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        pipeline=pipeline,
        optimizers={
            "fields": {
                "optimizer": FusedAdamOptimizerConfig(lr=learning_rate, eps=1e-15),
                "scheduler": DecayOverRunSchedulerConfig(lr_final=0.1 * learning_rate),
            },
            **{
                name: {
                    "optimizer": FusedAdamOptimizerConfig(lr=rate, eps=1e-15, betas=(0.9, 0.999)),
                    "scheduler": DecayOverRunSchedulerConfig(lr_final=0.1 * rate),
                }
                for name, rate in SensorModel.learning_rates().items()
            },
        },
        viewer=ViewerConfig(quit_on_train_completion=True),
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False), profiler="none"),
        vis="viewer",
    )


def _settings(pipeline: EnerfPipelineConfig) -> tuple[tuple[str, Any], ...]:
    """The settings of a pipeline that differ from the defaults of their classes, as `MethodDefaults.settings`."""
    found = []
    for section in ("datamanager", "model", "model.sensor"):
        part = attrgetter(section)(pipeline)
        default = type(part)()
        values = {field.name: getattr(part, field.name) for field in fields(part)}
        found += [
            (f"{section}.{name}", value)
            for name, value in values.items()
            if not is_dataclass(value) and value != getattr(default, name)
        ]
    return tuple(found)


RAYS_PER_CHUNK = 1 << (15 if torch.cuda.is_available() else 12)
"""Rays rendered at once: enough to keep a GPU busy, few enough for the cache of a CPU."""


def _enerf(name: str, settings: Mapping[str, Any], defaults: MethodDefaults) -> EnerfTrainerConfig:
    """The method enerf under another name, with changes of settings by the names of ns-train's flags."""
    model = EnerfModelConfig(eval_num_rays_per_chunk=RAYS_PER_CHUNK)
    pipeline = EnerfPipelineConfig(datamanager=EnerfDataManagerConfig(), model=model, defaults=defaults)
    for path, value in settings.items():
        section, _, setting = path.removeprefix("pipeline.").rpartition(".")
        setattr(attrgetter(section)(pipeline), setting, value)
    return method_config(name, iterations=4000, learning_rate=1e-2, pipeline=pipeline)


def _with_losses(name: str) -> MethodSpecification:
    losses, defaults = PUBLISHED_LOSSES[name], MethodDefaults(refines_poses=False)
    config = _enerf(name, losses.settings, defaults)
    return MethodSpecification(config, f"Losses of {losses.source} on the field of enerf.")


enerf = MethodSpecification(
    _enerf("enerf", {}, MethodDefaults()), "E-NeRF: radiance field from an event camera, tuned for error against time."
)
enerf_paper_loss = _with_losses("enerf-paper-loss")
enerf_eventnerf = _with_losses("enerf-eventnerf")
enerf_robust = _with_losses("enerf-robust")
enerf_deblur = _with_losses("enerf-deblur")

PAPER = MethodDefaults(
    event_pairs=30096,
    instants=False,
    silent_pairs=0,
    train_num_rays_per_batch=30096,
    silent_pairs_beside_frames=0,
    rays_beside_events=30096,
    event_loss="squared",
    no_event_loss_weight=5.0,  # 1 / C at the paper's C = 0.2: its weight of 1
    no_event_margin=1.0,
    level_loss_weight=0.0,
    refines_poses=False,
    learns_sensor=False,
    whole_preset=True,
)

enerf_paper = MethodSpecification(
    config=method_config(
        "enerf-paper",
        iterations=100_000,
        learning_rate=5e-3,
        pipeline=EnerfPipelineConfig(
            datamanager=EnerfDataManagerConfig(pair_mode="successor", uniform_over="pixels"),
            model=EnerfModelConfig(
                num_levels=16,
                base_res=16,
                max_res=4096,
                log2_table_size=19,
                hidden_dim=64,
                hidden_dim_colour=64,
                view_direction=True,
                brightness="sigmoid",
                contraction=False,
                sampling="uniform",
                num_samples=512,
                frame_loss_weight=25.0,  # 1 / C^2 at the paper's C = 0.2: its weight of 1, since event losses count C
                opacity_loss_weight=0.0,
                distortion_loss_weight=0.0,
                edge_start=False,
                eval_num_rays_per_chunk=RAYS_PER_CHUNK,
            ),
            defaults=PAPER,
        ),
    ),
    description="E-NeRF with the sampling and field of the paper (Klenk et al., RA-L 2023).",
)

METHODS = (enerf, enerf_paper, enerf_paper_loss, enerf_eventnerf, enerf_robust, enerf_deblur)

speak_for_methods(EnerfTrainerConfig, [method.config.method_name or "" for method in METHODS])  # ns-train calls no more
