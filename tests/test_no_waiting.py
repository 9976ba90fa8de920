"""A training step asks a GPU for nothing that it would have to wait for; where there is none, as tensors see it that
claim to lie there and have no values."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import set_up, small_config
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from enerf_ns.method.guarded_steps import Later

READING = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "unique_consecutive", "_unique2"}
"""Operations that wait for values, or for the shape that depends on them."""

SETTINGS: dict[str, dict[str, Any]] = {
    "events": {"data__silent_pairs": 32},
    "successors of a sensor that is blind after events": {
        "data__silent_pairs": 32,
        "data__pair_mode": "successor",
        "sensor__refractory_period_ns": 1000,
    },
    "a sensor of which all is learned": {
        "data__silent_pairs": 32,
        "model__level_loss_weight": 0.1,
        "sensor__learn_threshold_ratio": True,
        "sensor__learn_threshold_map": True,
        "sensor__learn_leak_rate": True,
        "sensor__learn_cutoff_frequency": True,
        "sensor__refractory_period_ns": 1000,
        "sensor__learn_refractory_period": True,
    },
    "accumulated events": {
        "data__pair_mode": "accumulated",
        "data__silent_pairs": 32,
        "data__silent_mode": "intervals",
        "sensor__cutoff_frequency": 100.0,
    },
    "events and frames over their exposure": {"data__supervision": "events+frames", "data__exposure_samples": 3},
    "frames, with view direction": {"data__supervision": "frames", "model__view_direction": True},
    "beyond the box, even samples": {"model__contraction": True, "model__sampling": "uniform"},
}


class NothingIsRead(TorchDispatchMode):
    """Refuses to tell the values of tensors."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        by_mask = name in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1]
        )
        assert name not in READING and not by_mask, f"{func} waits for values"
        return func(*args, **(kwargs or {}))


def moved(thing: Any, to_gpu: Any, known: dict[int, Any]) -> Any:
    """The thing, in whose parts every tensor and every device is replaced."""
    if isinstance(thing, Tensor):
        return to_gpu(thing)
    if isinstance(thing, torch.device) or (isinstance(thing, str) and thing == "cpu"):
        return torch.device("cuda", 0)
    if isinstance(thing, tuple) and not hasattr(thing, "_fields"):
        return tuple(moved(part, to_gpu, known) for part in thing)
    if id(thing) in known:
        return thing
    known[id(thing)] = thing
    if isinstance(thing, dict):
        for key, part in thing.items():
            thing[key] = moved(part, to_gpu, known)
    elif isinstance(thing, list):
        thing[:] = [moved(part, to_gpu, known) for part in thing]
    elif type(thing).__module__.startswith(("enerf_ns.", "nerfstudio.", "torch.nn.")) and hasattr(thing, "__dict__"):
        parts = vars(thing)
        if dataclasses.is_dataclass(thing):
            parts = {name: part for name, part in parts.items() if not isinstance(part, Path)}
        for name, part in list(parts.items()):
            object.__setattr__(thing, name, moved(part, to_gpu, known))
    return thing


@pytest.mark.parametrize("name", SETTINGS)
def test_a_step_reads_nothing_from_the_gpu(recording: Path, tmp_path: Path, name: str) -> None:
    """Drawing, rays, rendering, losses and metrics, with all tensors where they belong."""
    own = shutil.copytree(recording, tmp_path / "copied")  # which later tests do not read from a cache
    pipeline = set_up(small_config(own, tmp_path / "outputs", model__hash_grid="torch", **SETTINGS[name])).pipeline
    pipeline.get_train_loss_dict(0)  # what is made when first asked for
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:

        def to_gpu(tensor: Tensor) -> Tensor:
            on_gpu = fake.from_tensor(tensor.detach()).to("cuda")
            return torch.nn.Parameter(on_gpu) if isinstance(tensor, torch.nn.Parameter) else on_gpu

        moved(pipeline.datamanager, to_gpu, {})
        moved(pipeline.model, to_gpu, {})
        _, losses, metrics = pipeline.get_train_loss_dict(1)
    assert losses and {value.device.type for value in [*losses.values(), *metrics.values()]} == {"cuda"}


def test_the_backward_pass_and_the_optimiser_read_nothing(recording: Path, tmp_path: Path) -> None:
    changes = {"data__silent_pairs": 32, "data__supervision": "events+frames", "sensor__learn_leak_rate": True}
    trainer = set_up(small_config(recording, tmp_path, **changes))
    trainer.train_iteration(0)
    trainer.optimizers.zero_grad_all()
    _, losses, _ = trainer.pipeline.get_train_loss_dict(1)
    with NothingIsRead():
        torch.stack([*losses.values()]).sum().backward()
        trainer.optimizers.optimizer_scaler_step_some(trainer.grad_scaler, ["fields", "leak_rate"])
    assert trainer.optimizers.finite


def test_what_refuses_to_be_read_notices() -> None:
    """Else the tests above could not fail."""
    numbers = torch.arange(3.0)
    for read in (lambda: numbers[numbers > 1], lambda: float(numbers[0]), lambda: bool((numbers > 0).all())):
        with pytest.raises(AssertionError, match="waits for values"), NothingIsRead():
            read()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_step_on_a_gpu_waits_for_nothing(recording: Path, tmp_path: Path) -> None:
    changes = {"data__silent_pairs": 32, "data__supervision": "events+frames", "sensor__learn_leak_rate": True}
    config = small_config(recording, tmp_path, **changes)
    config.machine.device_type = "cuda"
    trainer = set_up(config)
    trainer.train_iteration(0)
    torch.cuda.set_sync_debug_mode("error")
    try:
        trainer.train_iteration(1)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("value", [True, False])
def test_a_boolean_comes_later(value: bool) -> None:
    later = Later("step", torch.tensor(value, device="cuda" if torch.cuda.is_available() else "cpu"))
    assert bool(later) is value and later.seen == "step"
