"""Steps that are not finite are left out, and a field that renders nothing is told."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler
from torch.nn import Module, Parameter

from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.method.nerfstudio_seams import leave_out_fused_step
from enerf_ns.method.pipeline import TrainStep
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.supervision.event_supervision import brightness_change

Seen = TypeVar("Seen")

MOST_SKIPPED = 5
"""Steps in a row that may be skipped because they are not finite, before training stops."""

LEARNING_CHECKED_EVERY, LEARNING_CHECKED_FROM = 100, 300
"""Steps between looks at whether anything is learnt, and steps before the first."""

NOTHING = 1e-3
"""Share of the measured change of log brightness, or of a ray, below which a field renders nothing."""


class GuardedOptimizers(Optimizers):
    """Nerfstudio's optimisers, which leave out a step that is not finite, and on a GPU do not wait to hear whether.

    Args:
        config: Optimisers and schedulers by the name of the group of parameters.
        param_groups: Parameters by the name of the group.
        is_finite: Whether the losses of this step, and the gradients that lie with the parameters, can be followed;
            a boolean on their device.
    """

    def __init__(
        self, config: dict[str, Any], param_groups: dict[str, list[Parameter]], is_finite: Callable[[], Tensor]
    ):
        super().__init__(config, param_groups)
        self.is_finite = is_finite
        self.finite: Tensor | None = None
        """Whether the last step was taken; a boolean on the device."""

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        self.finite = self.is_finite()
        taken = []
        for group in param_groups:
            optimizer = self.optimizers[group]
            gradients = [parameter.grad for parameter in self.parameters[group] if parameter.grad is not None]
            if grad_scaler.is_enabled():  # which leaves out what is not finite by itself, and must see it
                for gradient in sorted(gradients, key=Tensor.numel)[:1]:
                    gradient.masked_fill_(~self.finite, torch.nan)
            elif optimizer.defaults.get("fused"):
                leave_out_fused_step(optimizer, ~self.finite)
            elif not self.finite:
                continue
            taken.append(group)
        super().optimizer_scaler_step_some(grad_scaler, taken)


class Later(Generic[Seen]):
    """Something that was seen at a step, and a boolean that its device will know.

    Asked for a step later, it has come meanwhile, and the next step is on its way to the GPU, which does not idle.
    """

    def __init__(self, seen: Seen, value: Tensor):
        self.seen = seen
        self._come = None
        self._value = value
        if value.is_cuda:
            self._value = torch.empty((), dtype=value.dtype, pin_memory=True).copy_(value, non_blocking=True)
            self._come = torch.cuda.Event()
            self._come.record()

    def __bool__(self) -> bool:
        if self._come is not None:
            self._come.synchronize()
        return bool(self._value)


def what_is_not_finite(step: TrainStep, model: Module) -> str:
    """The first loss of a step that is not finite, else the first gradient, in words."""
    for name, loss in step.losses.items():
        if not loss.isfinite():
            return name
    for name, parameter in model.named_parameters():
        if parameter.grad is not None and not parameter.grad.norm().isfinite():
            return f"the gradient of {name}"
    return "a number of the step"


def keep_batch(step: TrainStep, number: int, file: Path) -> None:
    """Stores the batch and the losses of a step, whole or not at all, for `torch.load`.

    Raises:
        OSError: The disk is full, or the folder cannot be written to.
    """
    content = io.BytesIO()
    batch = {name: vars(part) for name, part in vars(step.batch).items() if part is not None}
    torch.save({"step": number, "losses": step.losses, **batch}, content)
    write_whole(file, content.getvalue())


@torch.no_grad()
def why_nothing_is_learnt(step: TrainStep, sensor: SensorModel) -> dict[str, str]:
    """What a step shows of a field that renders nothing, in words, by reason; empty of a sound one."""
    found = {}
    accumulation = float(step.accumulation.mean())
    if accumulation < NOTHING:
        found["empty"] = f"rays meet no surface anywhere: they are stopped by {accumulation:.1g} of one on average"
    events = step.batch.events
    if events is not None:
        start, end, _ = step.batch.split(step.rgb)
        fired = events.fired
        change = brightness_change(start, end, events, sensor)[fired]
        measured = sensor.measured_change(events)[fired]
        ratio = float(change.square().mean().sqrt() / measured.square().mean().sqrt())
        if ratio < NOTHING:
            found["constant"] = f"the rendered change of log brightness is {ratio:.1g} of the measured one"
    return found
