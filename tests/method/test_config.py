"""The registered methods, and what Nerfstudio does with them."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

import enerf_ns
from enerf_ns.choices.extent import MOST_LEVELS
from enerf_ns.dataparsers import event_dataparser
from enerf_ns.dataparsers.event_dataparser import EventDataParser, EventDataParserConfig
from enerf_ns.method.config import DecayOverRunSchedulerConfig, FusedAdamOptimizerConfig, enerf, enerf_paper
from enerf_ns.method.datamanager import EnerfDataManager
from enerf_ns.method.model import EnerfModel


@pytest.mark.parametrize("method", [enerf, enerf_paper])
def test_what_a_preset_may_fill_in_is_open(method: Any):
    manager, model = method.config.pipeline.datamanager, method.config.pipeline.model
    open_settings = (
        manager.event_pairs, manager.silent_pairs, manager.silence_ms, manager.train_num_rays_per_batch,
        manager.dataparser.held_out_every, manager.dataparser.time_range, manager.dataparser.box,
        manager.dataparser.depth_range, model.event_loss, model.no_event_loss_weight, model.no_event_margin,
        model.sensor.contrast_thresholds,
    )  # fmt: skip
    assert set(open_settings) == {None}
    assert not method.config.pipeline.resolution.choices


def test_the_paper_is_larger_in_every_way():
    tuned: Any = enerf.config
    paper: Any = enerf_paper.config
    assert paper.pipeline.defaults.event_pairs > tuned.pipeline.defaults.event_pairs
    assert paper.pipeline.model.num_samples > tuned.pipeline.model.num_samples
    assert paper.pipeline.model.num_levels > MOST_LEVELS and paper.pipeline.model.log2_table_size == 19
    assert paper.max_num_iterations > tuned.max_num_iterations


def test_the_optimizer_takes_the_steps_of_plain_adam():
    torch.manual_seed(0)
    one, other = (torch.nn.Parameter(torch.linspace(-1, 1, 50)) for _ in range(2))
    fused = FusedAdamOptimizerConfig(lr=0.01, eps=1e-15).setup([one])
    plain = torch.optim.Adam([other], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(5):
        for parameter, optimizer in ((one, fused), (other, plain)):
            optimizer.zero_grad()
            (parameter**4).sum().backward()
            optimizer.step()
    torch.testing.assert_close(one, other)


def test_the_learning_rate_falls_exponentially_over_the_run():
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=0.1)
    scheduler = DecayOverRunSchedulerConfig(lr_final=0.001, max_steps=4).setup().get_scheduler(optimizer, 0.1)
    rates = []
    for _ in range(5):
        rates.append(float(optimizer.param_groups[0]["lr"]))
        optimizer.step()
        scheduler.step()
    assert rates == pytest.approx([0.1 * 0.01 ** (i / 4) for i in range(5)])


def shown_flags(method: str, parser: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    """The flags of a method and of a format of its, as `--help` shows them."""
    found: set[str] = set()
    for arguments in ([method, "--help"], [method, parser, "--help"]):
        with pytest.raises(SystemExit):
            tyro.cli(AnnotatedBaseConfigUnion, args=arguments, console_outputs=True)
        found |= set(re.findall(r"--([a-z][\w.-]*)", capsys.readouterr().out))
    return {flag.replace("-", "_") for flag in found}


def names_read(target: type) -> set[str]:
    """The attributes that are read by the methods of a class that are not overridden, or are called by those that
    override them."""
    found: set[str] = set()
    for name in {name for parent in target.__mro__ for name in vars(parent)}:
        for parent in target.__mro__:
            if name not in vars(parent):
                continue
            function = vars(parent)[name]
            function = getattr(function, "fget", None) or getattr(function, "func", function)
            function = inspect.unwrap(function) if callable(function) else function
            if not inspect.isfunction(function) or function.__code__.co_filename.startswith("<"):
                break
            source = textwrap.dedent(inspect.getsource(function))
            found |= {node.attr for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Attribute)}
            if f"super().{name}(" not in source:
                break
    return found


def test_each_flag_of_the_pipeline_is_read(capsys: pytest.CaptureFixture[str]):
    """By the class that it configures, or by what stands beside it in this package; Nerfstudio's data manager has some
    that only what is overridden reads."""
    read = names_read(EnerfDataManager) | names_read(EnerfModel) | names_read(EventDataParser)
    for folder in (Path(enerf_ns.__file__).parent, Path(event_dataparser.__file__).parent):
        for file in folder.rglob("*.py"):
            read |= {node.attr for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Attribute)}
    shown = shown_flags("enerf", "event-data", capsys)
    settings = {flag.removeprefix("pipeline.").rpartition(".")[2] for flag in shown if flag.startswith("pipeline.")}
    settings |= {flag for flag in shown if hasattr(EventDataParserConfig(), flag)}
    assert {"supervision", "event_pairs", "num_levels", "held_out_every", "depth_range"} <= settings
    assert settings - read == set()
    idle = {"masks_on_gpu", "images_on_gpu", "patch_size", "eval_image_indices", "prompt", "loss_coefficients"}
    assert not {flag for flag in shown if idle & set(flag.split("."))}


def test_a_flag_that_only_an_overridden_method_reads_would_be_found():
    class Parent:
        def shown(self, config: Any) -> Any:
            return config.idle

        def kept(self, config: Any) -> Any:
            return config.used

    class Child(Parent):
        def shown(self, config: Any) -> Any:
            return config.own

    class Calling(Parent):
        def shown(self, config: Any) -> Any:
            return super().shown(config)

    assert {"used", "own"} <= names_read(Child) and "idle" not in names_read(Child)
    assert {"used", "idle"} <= names_read(Calling)
