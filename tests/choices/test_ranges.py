"""Every number of a config has a range, and is refused outside of it before anything is read or written."""

from __future__ import annotations

import contextlib
import copy
import io
import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from small_runs import set_up, small_config

from enerf_ns.choices import ranges
from enerf_ns.choices.ranges import check_ranges
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.method.config import enerf
from enerf_ns.method.trainer import EnerfTrainerConfig
from enerf_ns.rendering import seen_volume
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.supervision.published_losses import PUBLISHED_LOSSES

RANGES = ranges.RANGES | SensorModel.ranges()

METHODS = {name: all_methods[name] for name in ("enerf", "enerf-paper", *PUBLISHED_LOSSES)}

SOUND: dict[str, Any] = {
    "depth_range": (1.0, 2.0),
    "time_range": (0.0, 1.0),
    "box": (0.0, 0.0, 0.0, 1.0),
    "contrast_thresholds": (0.2, 0.3),
    "betas": (0.9, 0.99),
}
"""Settings of several numbers as they may be."""


@dataclass
class Setting:
    """A field of a config, or an item of a dictionary in one, that holds a number or several."""

    path: tuple[str, ...]
    name: str
    integer: bool
    several: int | None
    """How many; None: a single one. 1 stands for any number of them."""
    fixed: bool = False
    """Whether no flag sets it, though it is no less a part of the config."""

    def __str__(self) -> str:
        return ".".join(self.path)

    def set_to(self, config: Any, value: float, place: int = 0) -> Any:
        """A copy of a config with this number in place of one."""
        config = copy.deepcopy(config)
        *parents, last = self.path
        owner = config
        for parent in parents:
            owner = owner[parent] if isinstance(owner, dict) else getattr(owner, parent)
        new: Any = value
        if self.several is not None:
            new = list(SOUND.get(self.name, [value] * self.several))
            new[place] = value
            new = tuple(new)
        if isinstance(owner, dict):
            owner[last] = new
        else:
            object.__setattr__(owner, last, new)
        return config

    @property
    def flag(self) -> str:
        """How a message is to name it."""
        dotted = str(self)
        if self.name in ("collider_params", "gradient_accumulation_steps"):
            dotted = dotted.rpartition(".")[0]
        if self.fixed or dotted.startswith(
            (
                "pipeline.defaults.",
                "pipeline.datamanager.pixel_sampler.",
                "pipeline.model.sensor.width",
                "pipeline.model.sensor.height",
            )
        ):
            return dotted  # which no flag sets
        if dotted.startswith("pipeline.datamanager.dataparser."):
            return "event-data --" + self.path[-1].replace("_", "-")
        dotted = dotted.replace("model.sensor.", "model.").replace("pipeline.poses.", "pipeline.")
        return "--" + dotted.replace("_", "-")


def numbers(kind: Any) -> tuple[type, int | None] | None:
    """Whether a type holds numbers: of which type, and how many if several."""
    if kind in (int, float):
        return kind, None
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Annotated, typing.Union, types.UnionType):
        found = [numbers(part) for part in (arguments[:1] if origin is typing.Annotated else arguments)]
        return next((one for one in found if one), None)
    if origin in (tuple, list) and arguments and numbers(arguments[0]):
        return arguments[0], 1 if arguments[-1] is Ellipsis or origin is list else len(arguments)
    return None


def settings(config: Any, path: tuple[str, ...] = (), name: str = "", fixed: bool = False) -> Iterator[Setting]:
    """All that may hold numbers, by the annotations of the fields."""
    if isinstance(config, dict):
        for key, value in config.items():
            if isinstance(value, int | float):
                yield Setting((*path, key), name, isinstance(value, int), None, fixed)
            else:
                yield from settings(value, (*path, key), name, fixed)
    elif is_dataclass(config) and not isinstance(config, type):
        hints = typing.get_type_hints(type(config), include_extras=True)
        for field in fields(config):
            is_fixed = fixed or tyro.conf.Fixed in typing.get_args(hints[field.name])
            if found := numbers(hints[field.name]):
                yield Setting((*path, field.name), field.name, found[0] is int, found[1], is_fixed)
            else:
                yield from settings(getattr(config, field.name), (*path, field.name), field.name, is_fixed)


def all_settings() -> list[Setting]:
    config = copy.deepcopy(enerf.config)
    config.gradient_accumulation_steps = {"fields": 1}
    return list(settings(config))


ALL = all_settings()


def roomy(setting: Setting) -> EnerfTrainerConfig:
    """A config whose other settings leave this one its whole range."""
    config = copy.deepcopy(METHODS["enerf"])
    assert isinstance(config, EnerfTrainerConfig)
    config.gradient_accumulation_steps = {"fields": 1}
    if setting.name == "warmup_steps":
        for parts in config.optimizers.values():
            parts["scheduler"].max_steps = 10**9
    if setting.name == "max_res":
        config.pipeline.model.base_res = 1
    return config


def test_every_number_of_a_config_has_a_range():
    assert len(ALL) > 80 and {"num_samples", "lr", "event_pairs", "depth_range", "betas"} <= {s.name for s in ALL}
    assert not {setting.name for setting in ALL} - set(RANGES)
    assert not set(RANGES) - {setting.name for setting in ALL}
    assert all(math.isfinite(lowest) and lowest < highest < math.inf for lowest, highest in RANGES.values())


@pytest.mark.sweep(40)
@pytest.mark.parametrize("setting", ALL, ids=str)
def test_a_number_is_refused_outside_its_range_and_nothing_is_written(setting: Setting, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lowest, highest = RANGES[setting.name]
    outside = [lowest - 1, highest + 1] if setting.integer else [
        math.nextafter(lowest, -math.inf), math.nextafter(highest, math.inf)
    ]  # fmt: skip
    for value in (math.nan, math.inf, -math.inf, *outside):
        for place in range(setting.several or 1):
            config = setting.set_to(roomy(setting), value, place)
            config.output_dir, config.data = tmp_path / "outputs", tmp_path / "nothing"
            with pytest.raises(SystemExit) as refused:
                config.save_config()
            message = str(refused.value)
            assert message.startswith(f"enerf: {setting.flag} is ") and message.endswith(".") and "\n" not in message
            assert f"must be from {lowest:.10g} to {highest:.10g}" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.sweep(40)
@pytest.mark.parametrize("setting", ALL, ids=str)
def test_both_ends_of_a_range_are_accepted(setting: Setting):
    lowest, highest = RANGES[setting.name]
    several = setting.several or 1
    ordered = setting.name in ("depth_range", "time_range")
    for place in range(several):
        half_side = setting.name == "box" and place == 3
        if not half_side and not (ordered and place == 1):
            check_ranges(setting.set_to(roomy(setting), lowest, place))
        if not (ordered and place == 0):
            check_ranges(setting.set_to(roomy(setting), highest, place))


@pytest.mark.parametrize("method", METHODS)
def test_the_methods_are_within_all_ranges(method: str):
    check_ranges(typing.cast(EnerfTrainerConfig, METHODS[method]))


def help_of(*arguments: str) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=["enerf", *arguments, "--help"])
    return text.getvalue()


def test_flags_of_messages_are_those_of_ns_train():
    trainer, parser = help_of(), help_of("event-data")
    for setting in ALL:
        command, _, flag = setting.flag.rpartition("--")
        if setting.flag.startswith("pipeline."):
            assert "--" + setting.flag.replace("_", "-") + " " not in trainer
        else:
            assert f"--{flag} " in (parser if command else trainer), setting.flag


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        (
            "parser",
            {"depth_range": (2.0, 2.0)},
            r"^event-data --depth-range is 2 2, but the second .* above the first\.$",
        ),
        (
            "parser",
            {"time_range": (3.0, 1.0)},
            r"^event-data --time-range is 3 1, but the second .* above the first\.$",
        ),
        ("parser", {"box": (0.0, 0.0, 0.0, 0.0)}, r"^event-data --box is 0 0 0 0, but half its side must be at least"),
        (
            "parser",
            {"box": (0.0, 0.0, 0.0, 1.0), "contraction_depth": 2.0},
            r"^event-data --contraction-depth contradicts event-data --box; leave one of both out\.$",
        ),
        (
            "model",
            {"base_res": 65, "max_res": 64},
            r"^--pipeline\.model\.max-res is 64, but .*base-res, which is 65\.$",
        ),
        (
            "scheduler",
            {"warmup_steps": 4000},
            r"^--optimizers\.fields\.scheduler\.warmup-steps is 4000, .* 4000 steps of",
        ),
        ("scheduler", {"warmup_steps": 9, "max_steps": 9}, r"warmup-steps is 9, but must be below the 9 steps"),
        (
            "resolution",
            {"values": {"model.near_plane": math.nan}},
            r"^pipeline\.resolution\.values\.model\.near_plane is",
        ),
    ],
)
def test_numbers_that_do_not_fit_one_another_are_refused(part: str, changes: dict[str, Any], message: str):
    config = typing.cast(EnerfTrainerConfig, copy.deepcopy(METHODS["enerf"]))
    parts = {
        "parser": config.pipeline.datamanager.dataparser,
        "model": config.pipeline.model,
        "scheduler": config.optimizers["fields"]["scheduler"],
        "resolution": config.pipeline.resolution,
    }
    for name, value in changes.items():
        object.__setattr__(parts[part], name, value)
    with pytest.raises(FlagError, match=message):
        check_ranges(config)


def test_a_depth_of_contraction_without_contraction_is_refused():
    config = typing.cast(EnerfTrainerConfig, copy.deepcopy(METHODS["enerf"]))
    config.pipeline.datamanager.dataparser.contraction_depth = 2.0
    check_ranges(config)
    config.pipeline.model.contraction = False
    with pytest.raises(FlagError, match=r"^event-data --contraction-depth contradicts --pipeline\.model\.contraction"):
        check_ranges(config)


def test_a_field_trains_at_the_lowest_of_what_makes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its pictures are small, and few rays find what was seen, since each ray is rendered by itself."""
    monkeypatch.setattr(seen_volume, "NUM_RAYS", 100)
    recording = tmp_path / "recording"
    simulate(SimulationSettings("shapes", width=8, height=6, duration=0.1, num_frames=11), recording)
    config = small_config(recording, tmp_path / "runs", data__silent_pairs=1, model__max_res=1)
    model, manager = config.pipeline.model, config.pipeline.datamanager
    for part in (model, manager):
        for name in ("num_levels", "base_res", "log2_table_size", "hidden_dim", "hidden_dim_colour", "num_features",
                     "num_proposal_samples", "num_samples", "eval_num_rays_per_chunk", "near_plane",
                     "event_pairs", "max_pair_distance", "silence_ms"):  # fmt: skip
            if hasattr(part, name):
                setattr(part, name, RANGES[name][0])
    assert model.num_samples == manager.event_pairs == 1
    trainer = set_up(config)
    assert trainer.train_iteration(0)[0].isfinite()
    assert trainer.pipeline.get_average_eval_image_metrics()["fps"] > 0
