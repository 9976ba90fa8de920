"""Guards of training steps: steps that are not finite are left out, and a field that renders nothing is found."""

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
from enerf_ns.method.nerfstudio_seams import average_left_out, leave_out_fused_step
from enerf_ns.method.pipeline import TrainStep
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.supervision.event_supervision import brightness_change

Seen = TypeVar("Seen")

MOST_SKIPPED = 5
"""Number of steps in a row that are not finite at which training stops."""

LEARNING_CHECKED_EVERY, LEARNING_CHECKED_FROM = 100, 300
"""Steps between two checks that the field learns, and the step of the first check."""

NOTHING = 1e-3
"""Mean accumulation, or ratio of the rendered to the measured change of log brightness, below which a field renders
nothing."""


class GuardedOptimizers(Optimizers):
    """Nerfstudio's optimisers, which leave out a step that is not finite. On a GPU they do not wait for that result.

    Gradients that DistributedDataParallel leaves out are averaged over all processes before.

    Args:
        config: Optimisers and schedulers by the name of the group of parameters.
        param_groups: Parameters by the name of the group.
        is_finite: Returns whether the losses and gradients of this step are finite, as a boolean on their device.
    """

    def __init__(
        self, config: dict[str, Any], param_groups: dict[str, list[Parameter]], is_finite: Callable[[], Tensor]
    ):
        super().__init__(config, param_groups)
        self.is_finite = is_finite
        self.finite: Tensor | None = None
        """Whether the last step was finite, a boolean on the device; None before the first step."""

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        for group in param_groups:
            average_left_out(self.parameters[group])
        self.finite = self.is_finite()
        taken = []
        for group in param_groups:
            optimizer = self.optimizers[group]
            gradients = [parameter.grad for parameter in self.parameters[group] if parameter.grad is not None]
            if grad_scaler.is_enabled():  # GradScaler leaves out a step by itself if it finds a NaN
                for gradient in sorted(gradients, key=Tensor.numel)[:1]:
                    gradient.masked_fill_(~self.finite, torch.nan)
            elif all(settings.get("fused") for settings in optimizer.param_groups):  # as a checkpoint may state
                leave_out_fused_step(optimizer, ~self.finite)
            elif not self.finite:
                continue
            taken.append(group)
        super().optimizer_scaler_step_some(grad_scaler, taken)


class Later(Generic[Seen]):
    """Data of a step, and a boolean that its device is still computing.

    Read one step later, the boolean has arrived. The GPU has the next step to work on by then, and does not idle.

    Args:
        seen: Data of the step.
        value: Boolean on its device.
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
    """The name of the first loss of a step that is not finite; else of the first gradient."""
    for name, loss in step.losses.items():
        if not loss.isfinite():
            return name
    for name, parameter in model.named_parameters():
        if parameter.grad is not None and not parameter.grad.norm().isfinite():
            return f"the gradient of {name}"
    return "a number of the step"


def keep_batch(step: TrainStep, number: int, file: Path) -> None:
    """Stores the batch and the losses of a step, whole or not at all, in a file for `torch.load`.

    Raises:
        OSError: The disk is full, or the folder cannot be written to.
    """
    content = io.BytesIO()
    batch = {name: vars(part) for name, part in vars(step.batch).items() if part is not None}
    links = step.batch.events.links if step.batch.events is not None else None
    if links is not None:
        batch["events"] = {**batch["events"], "links": vars(links)}
    torch.save({"step": number, "losses": step.losses, **batch}, content)
    write_whole(file, content.getvalue())


@torch.no_grad()
def why_nothing_is_learnt(step: TrainStep, sensor: SensorModel) -> dict[str, str]:
    """Sentences that say why a field renders nothing, by reason; empty if it renders something."""
    found = {}
    accumulation = float(step.accumulation.mean())
    if accumulation < NOTHING:
        found["empty"] = f"rays meet no surface, their mean accumulation is {accumulation:.1g}"
    events = step.batch.events
    if events is not None:
        start, end, _ = step.batch.split(step.rgb)
        fired = events.fired
        change = brightness_change(start, end, events, sensor)[fired]
        measured = sensor.measured_change(events)[fired]
        ratio = float(change.square().mean().sqrt() / measured.square().mean().sqrt())
        if ratio < NOTHING:
            found["constant"] = f"rendered changes of log brightness are {ratio:.1g} times the measured changes"
    return found
