"""What a scene does not need costs nothing: no kernel, no parameter, no memory, no import."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.field_components.field_heads import FieldHeadNames
from small_runs import set_up, small_config
from torch.utils._python_dispatch import TorchDispatchMode

from enerf_ns.events.batch import TrainBatch
from enerf_ns.method.pipeline import LAG_TOLD_AFTER
from enerf_ns.rendering.ray_samplers import paired_rand
from enerf_ns.supervision.event_supervision import brightness_change
from enerf_ns.supervision.losses import huber_event_loss

NOTHING: dict[str, Any] = {
    "data__silent_pairs": 0,
    "model__opacity_loss_weight": 0.0,
    "model__distortion_loss_weight": 0.0,
    "model__view_direction": False,
    "model__sampling": "uniform",
    "model__num_channels": 1,
    "model__brightness": "log-sigmoid",
    "model__contraction": False,
    "sensor__refractory_period_ns": 0,
    "sensor__contrast_thresholds": (0.25, 0.25),
}
"""Everything left out, of a run that learns from events."""

PARTS: dict[str, dict[str, Any]] = {
    "silent pixels": {"data__silent_pairs": 32},
    "opacity loss": {"model__opacity_loss_weight": 1.0},
    "distortion loss": {"model__distortion_loss_weight": 0.01},
    "view direction": {"model__view_direction": True},
    "proposal network": {"model__sampling": "proposal"},
    "colour": {"model__num_channels": 3},
    "refractory period": {"sensor__refractory_period_ns": 1000},
    "frame loss": {"data__supervision": "events+frames"},
    "contraction": {"model__contraction": True},
}


VIEWS = ("slice", "expand", "view", "split", "select", "unsqueeze", "detach", "transpose", "permute", "t", "alias")
"""Operations that compute nothing."""


class Kernels(TorchDispatchMode):
    """Counts what PyTorch computes, and the bytes that it allocates for it."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.allocated = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        if not any(str(function).startswith(f"aten.{view}.") for view in VIEWS):
            self.counts[str(function)] += 1
        for tensor in result if isinstance(result, tuple | list) else (result,):
            if isinstance(tensor, torch.Tensor):
                self.allocated += tensor.nbytes
        return result


def cost(pipeline: Any, step) -> tuple[int, int]:
    """Kernels and allocated bytes of a step forward and back, after one that makes what is made once."""
    for _ in range(2):
        pipeline.datamanager.generator.manual_seed(0)
        torch.manual_seed(0)
        pipeline.zero_grad()
        with Kernels() as kernels:
            total = torch.stack([*step(pipeline).values()]).sum()
            total.backward()
    return kernels.counts.total(), kernels.allocated


def losses(pipeline: Any) -> dict[str, torch.Tensor]:
    batch = pipeline.datamanager.next_batch(pipeline.model.sensor)
    rays = pipeline.datamanager.rays(batch, pipeline.model.sensor)
    return pipeline.model.get_loss_dict(pipeline.model(rays), batch)


def bare_losses(pipeline: Any) -> dict[str, torch.Tensor]:
    """The event loss and what it needs, without a place for anything else."""
    manager, model = pipeline.datamanager, pipeline.model
    events = manager.pair_sampler.sample(manager.config.event_pairs, manager.generator)
    instants = torch.cat([events.start, events.end])
    bundle = manager.event_camera.rays(events.pixels.repeat(2), instants)
    bundle.num_pairs = len(events)
    rays = model.collider(bundle)
    samples = model.sampler(rays)
    outputs = model.field(samples)
    weights = samples.get_weights(outputs[FieldHeadNames.DENSITY])
    left = 1.0 - weights.sum(dim=-2)
    colour = torch.sum(weights * outputs[FieldHeadNames.RGB], dim=-2) + left * paired_rand(rays, 1)
    start, end, _ = TrainBatch(events, None).split(colour)
    change = brightness_change(start, end, events, model.sensor)
    on, off = events.on, events.off
    return {"event_loss": 1.0 * huber_event_loss(change, 0.25 * on - 0.25 * off, 0.25)}


def pipeline_of(recording: Path, tmp_path: Path, **changes: Any) -> Any:
    return set_up(small_config(recording, tmp_path, **{**NOTHING, **changes})).pipeline


def size(pipeline: Any) -> int:
    return sum(parameter.numel() for parameter in pipeline.model.parameters())


def test_a_step_with_everything_left_out_is_as_cheap_as_one_written_without_the_parts(recording: Path, tmp_path: Path):
    """But for the one that takes the changes of events, here all, out of the others on the way back."""
    pipeline = pipeline_of(recording, tmp_path)
    (kernels, allocated), (bare, bare_allocated) = cost(pipeline, losses), cost(pipeline, bare_losses)
    assert kernels <= bare + 1
    assert allocated < 1.01 * bare_allocated


@pytest.mark.parametrize("part", PARTS)
def test_a_part_costs_kernels_memory_or_parameters_only_where_it_is_kept(recording: Path, tmp_path: Path, part: str):
    without, kept = (
        pipeline_of(recording, tmp_path / "without"),
        pipeline_of(recording, tmp_path / "kept", **PARTS[part]),
    )
    kernels, allocated = cost(without, losses)
    kept_kernels, kept_allocated = cost(kept, losses)
    assert (kernels < kept_kernels or part == "contraction") and allocated < kept_allocated
    assert size(without) <= size(kept)
    made = vars(without.datamanager)
    assert not {"frame_colours", "frame_camera"} & made.keys() and without.datamanager.silent_sampler is None
    assert without.model.proposal is None and without.model.field.direction_encoding is None


def test_what_is_decided_to_be_left_out_costs_as_little_as_what_a_flag_leaves_out(recording: Path, tmp_path: Path):
    """The recording is grey, its sensor is never blind, and it is seen from one side."""
    decided = dict.fromkeys(
        (
            *("model__view_direction", "model__num_channels", "model__brightness", "model__contraction"),
            "sensor__refractory_period_ns",
        )
    )
    by_flag = pipeline_of(recording, tmp_path / "flag")
    by_choice = pipeline_of(recording, tmp_path / "choice", **decided)
    assert cost(by_flag, losses) == cost(by_choice, losses) and size(by_flag) == size(by_choice)


def test_training_imports_nothing_that_it_does_not_use(recording: Path, tmp_path: Path):
    """Neither readers of other formats nor pictures of reports, in a process of its own."""
    script = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from small_runs import set_up, small_config
set_up(small_config(Path({str(recording)!r}), Path({str(tmp_path)!r}))).train_iteration(0)
print(*[name for name in {UNUSED!r} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1].split() == []


UNUSED = (
    "hdf5plugin", "rosbags", "trimesh", "enerf_ns.simulator.engine", "enerf_ns.report",
    "enerf_ns.dataparsers.inspection.page", "enerf_ns.bench.numerics", "torchmetrics.image.lpip",
)  # fmt: skip


def test_a_lag_that_was_learned_to_be_small_costs_nothing_from_then_on(recording: Path, tmp_path: Path, capsys):
    """What is learned of it was far from settled here, so that a lag of up to 1 ms is called small."""
    lag = {"sensor__learn_cutoff_frequency": True, "sensor__least_delay": 1.0}
    without = pipeline_of(recording, tmp_path / "without")
    trainer = set_up(small_config(recording, tmp_path / "lag", **{**NOTHING, **lag}))
    delay = trainer.pipeline.model.sensor.delay
    trainer.train_iteration(0)
    assert delay.any() and cost(trainer.pipeline, losses) > cost(without, losses)
    for step in range(LAG_TOLD_AFTER, LAG_TOLD_AFTER + 3):
        trainer.train_iteration(step)
        batch = trainer.pipeline.last_step.batch.events
        assert not delay.any() and batch.rates is None and batch.slopes is None
    assert capsys.readouterr().out.count("left out from here on") == 1
    assert cost(trainer.pipeline, losses) == cost(without, losses)
    trainer.save_checkpoint(LAG_TOLD_AFTER + 2)
    config = small_config(recording, tmp_path / "again", **{**NOTHING, **lag})
    config.load_dir, config.max_num_iterations = trainer.checkpoint_dir, 2 * LAG_TOLD_AFTER
    assert not set_up(config).pipeline.model.sensor.lags
