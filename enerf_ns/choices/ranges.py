"""Ranges of the numbers in a config, checked before anything is read or written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

from enerf_ns.dataparsers.recording import ranges
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.ranges import COUNT, check_range, check_reading
from enerf_ns.dataparsers.recording.recording import LONGEST_REFRACTORY_PERIOD

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

MOST_STEPS = 10**9
MOST_DRAWS = 2**24
"""Largest number of pairs, rays or samples that are drawn at once; more would fill any memory."""

WEIGHT, LEARNING_RATE = (0.0, 1e6), (1e-12, 1.0)

RANGES: dict[str, tuple[float, float]] = {
    **ranges.RANGES,
    "max_num_iterations": (1, MOST_STEPS),
    "evaluation_share": (0.0, 1.0),
    "steps_per_save": (1, MOST_STEPS),
    "steps_per_eval_batch": (0, MOST_STEPS),  # 0: never
    "steps_per_eval_image": (0, MOST_STEPS),
    "steps_per_eval_all_images": (0, MOST_STEPS),
    "gradient_accumulation_steps": (1, 10**6),
    "load_step": (0, MOST_STEPS),
    "seed": (0, 2**32 - 1),  # all that NumPy takes
    "num_devices": (1, 1024),
    "num_machines": (1, 1024),
    "machine_rank": (0, 1023),
    "steps_per_log": (1, MOST_STEPS),
    "max_buffer_size": (1, 10**6),
    "max_log_size": (0, 10**6),  # 0: all
    "websocket_port": (0, 65535),
    "websocket_port_default": (0, 65535),
    "num_rays_per_chunk": (1, MOST_DRAWS),
    "max_num_display_images": (-1, 10**9),  # -1: all
    "jpeg_quality": (0, 100),
    "camera_frustum_scale": (1e-6, 1e6),
    "lr": LEARNING_RATE,
    "eps": (1e-30, 1.0),  # without any, a parameter that has no gradient is divided by zero
    "max_norm": (1e-9, 1e9),
    "weight_decay": (0.0, 1.0),
    "betas": (0.0, 1.0 - 1e-6),
    "lr_pre_warmup": (0.0, 1.0),
    "lr_final": LEARNING_RATE,
    "warmup_steps": (0, MOST_STEPS - 1),
    "max_steps": (1, MOST_STEPS),
    "event_pairs": (1, MOST_DRAWS),
    "max_pair_distance": (1, 10**6),
    "instant_pairs": (0, MOST_DRAWS),
    "instants_apart_ms": (0.0, 1e9),
    "completed_refractory_ns": (0, LONGEST_REFRACTORY_PERIOD),
    "window_ms": (1e-6, 1e9),  # from 1 ns
    "silent_pairs": (0, MOST_DRAWS),
    "silent_pairs_beside_frames": (0, MOST_DRAWS),
    "held_out_events": (0.0, 0.5),
    "silence_ms": (2e-6, 1e9),  # from 2 ns, which two instants need
    "train_num_rays_per_batch": (1, MOST_DRAWS),
    "rays_beside_events": (1, MOST_DRAWS),
    "noisy_pairs_beside_frames": (1, MOST_DRAWS),
    "exposure_samples": (1, 4096),
    "eval_num_rays_per_batch": (1, MOST_DRAWS),
    "train_num_images_to_sample_from": (-1, 10**9),  # -1: all
    "train_num_times_to_repeat_images": (-1, 10**9),
    "eval_num_images_to_sample_from": (-1, 10**9),
    "eval_num_times_to_repeat_images": (-1, 10**9),
    "eval_image_indices": COUNT,
    "camera_res_scale_factor": (1e-3, 1e3),
    "patch_size": (1, 4096),
    "num_rays_per_batch": (1, MOST_DRAWS),
    "fisheye_crop_radius": (0.0, 1e6),
    "eval_num_rays_per_chunk": (1, MOST_DRAWS),
    "collider_params": (0.0, 1e9),
    "num_levels": (1, 32),
    "base_res": (1, 2**16),
    "max_res": (1, 2**20),  # positions in [0, 1] are float32, of which 24 bits count
    "log2_table_size": (1, 24),  # the largest of Instant NGP
    "hidden_dim": (1, 4096),
    "hidden_dim_colour": (1, 4096),
    "num_features": (1, 4096),
    "num_proposal_samples": (1, 2**16),
    "num_samples": (1, 2**16),
    "event_loss_weight": WEIGHT,
    "no_event_loss_weight": WEIGHT,
    "no_event_margin": (0.0, 1.0),
    "frame_loss_weight": WEIGHT,
    "level_loss_weight": WEIGHT,
    "mean_brightness": (1e-3, 1e3),
    "opacity_loss_weight": WEIGHT,
    "distortion_loss_weight": WEIGHT,
    "interlevel_loss_weight": WEIGHT,
    "near_plane": (0.0, 1e3),
    "init_density": (1e-6, 1e6),
    "clock_ms": (-100.0, 100.0),  # a larger delay means poses of another recording
    "frame_delay_ms": (-100.0, 100.0),
    "focal_scale": (0.8, 1.2),
}
"""Lowest and highest value of each number, or of each of several numbers, by the name of its field in the config. The
parts of the sensor have the ranges of their own settings."""

WITHOUT_KEYS = ("collider_params", "gradient_accumulation_steps")
"""Dictionaries that are one flag each; of the others, each key is a flag."""

WITHOUT_FLAG = (
    *("pipeline.defaults", "pipeline.resolution", "pipeline.datamanager.pixel_sampler", "pipeline.model.sensor.width"),
    "pipeline.model.sensor.height",
    *("pipeline.datamanager.train_num_images", "pipeline.datamanager.train_num_times", "pipeline.datamanager.eval_"),
    *("pipeline.datamanager.patch_size", "pipeline.model.collider_params"),
)
"""Parts of the config that can only be set from Python."""


def check_ranges(config: TrainerConfig) -> None:
    """Refuses a config that holds a number that is not finite, or one outside its range.

    Raises:
        FlagError: Names the first such number by its flag of ns-train.
    """
    pipeline: Any = config.pipeline
    known = RANGES | pipeline.model.sensor._target.ranges()
    for path, setting, values in _numbers((), "", config):
        check_range(_flag(path), values, known.get(setting))
    _check_order(config)


def _check_order(config: TrainerConfig) -> None:
    """Refuses numbers that contradict each other.

    Raises:
        FlagError: Names the flags of such numbers.
    """
    pipeline: Any = config.pipeline
    parser, model = pipeline.datamanager.dataparser, pipeline.model
    check_reading(parser, "event-data ")
    if parser.contraction_depth is not None and model.contraction is False:
        raise FlagError(
            "event-data --contraction-depth contradicts --pipeline.model.contraction False; leave one of both out."
        )
    if model.max_res is not None and model.max_res < model.base_res:
        raise FlagError(
            f"--pipeline.model.max-res is {model.max_res}, but must be at least --pipeline.model.base-res, which is "
            f"{model.base_res}."
        )
    for group, parts in config.optimizers.items():
        scheduler = parts["scheduler"]
        warmup, steps = getattr(scheduler, "warmup_steps", 0), scheduler.max_steps or config.max_num_iterations
        if warmup >= steps:
            raise FlagError(
                f"--optimizers.{group}.scheduler.warmup-steps is {warmup}, but must be below the {steps} steps of its "
                "learning rate."
            )


def _numbers(path: tuple[str, ...], setting: str, value: Any) -> Iterator[tuple[tuple[str, ...], str, list[Any]]]:
    """Place, name of the field, and values of every number within a part of a config.

    Args:
        path: Place of the part within the config.
        setting: Name of the field that holds the part.
        value: The part.
    """
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _numbers((*path, field.name), field.name, getattr(value, field.name))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(path if setting in WITHOUT_KEYS else (*path, key), setting, item)
    elif isinstance(value, tuple | list):
        yield path, setting, [item for item in value if isinstance(item, Real)]
    elif isinstance(value, Real) and not isinstance(value, bool):
        yield path, setting, [value]


def _flag(path: tuple[str, ...]) -> str:
    """The flag of ns-train for a setting, or its place within the config if it has no flag."""
    if ".".join(path).startswith(WITHOUT_FLAG):
        return ".".join(path)
    if path[:3] == ("pipeline", "datamanager", "dataparser"):
        return "event-data --" + path[-1].replace("_", "-")
    if path[:3] == ("pipeline", "model", "sensor"):
        path = (*path[:2], *path[3:])
    if path[:2] == ("pipeline", "poses"):
        path = (path[0], *path[2:])
    return "--" + ".".join(path).replace("_", "-")
