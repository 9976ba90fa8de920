"""Training steps that are larger than the memory: their need is measured beforehand, and the field is evaluated in
parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import psutil
import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.models.base_model import Model
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from enerf_ns.method.stopwatch import seconds_of

SHARE = 0.8
"""Fraction of the free memory that one training step may use."""

SMALL_STEP = 2**20
"""Number of samples of a step that fits any memory, and takes no more than seconds."""

PROBE_SAMPLES = 2**15
"""Least number of samples of the rays with which a step is measured."""


@dataclass(frozen=True)
class StepCost:
    """Memory and time of a training step."""

    bytes: float
    """Memory that the step keeps for its backward pass."""
    field_bytes: float
    """The part of `bytes` that the field keeps, which can be evaluated in parts."""
    seconds: float
    """Time of rendering, forward and backward."""
    num_samples: int
    """Number of samples at which the field is evaluated."""

    def samples_at_once(self, free: int) -> int | None:
        """Largest number of samples at which the field can be evaluated at once, so that a step fits the memory.

        Args:
            free: Free memory in bytes.

        Returns:
            None if all samples fit; 0 if a step does not fit even with a single sample.
        """
        # in the backward pass, a part has gradients as large as what it kept
        room, others = SHARE * free, self.bytes - self.field_bytes
        if 2 * self.bytes <= room:
            return None
        return max(0, int(self.num_samples * (room - 2 * others) / (2 * self.field_bytes)))


def free_bytes(device: torch.device | str) -> int:
    """Free memory of a device, in bytes."""
    if torch.device(device).type != "cuda":
        return psutil.virtual_memory().available
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def kept_bytes(call: Callable[[], Any], model: Model) -> int:
    """Bytes of the tensors that a call keeps for its backward pass, without parameters and buffers of the model. Each
    storage counts once."""
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = call()
    del result
    for tensor in (*model.parameters(), *model.buffers()):
        kept.pop(tensor.untyped_storage().data_ptr(), None)
    return sum(kept.values())


def rays_from_the_middle(model: Model, num_rays: int) -> RayBundle:
    """Rays from the middle of the scene in random directions, on the device of the model."""
    box = model.scene_box.aabb
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3, device=box.device), dim=-1)
    pixel_area = torch.full((num_rays, 1), 1e-6, device=box.device)
    return RayBundle(box.mean(dim=0).expand(num_rays, 3), directions, pixel_area)


def forward_and_backward(model: Model, rays: RayBundle) -> None:
    """Renders rays as in training, and computes the gradients of all parameters without keeping them."""
    outputs: Any = model.get_outputs(rays)
    loss = outputs["rgb"].sum() + outputs["accumulation"].sum()
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    torch.autograd.grad(loss, parameters, allow_unused=True)


def step_cost(model: Model, num_rays: int, num_samples: int) -> StepCost:
    """Memory and time of a training step, extrapolated from rendering some rays from the middle of the scene.

    Args:
        model: Model on its device, whose field is evaluated at all samples at once. Neither its parameters nor the
            states of the random generators change.
        num_rays: Rays of a step.
        num_samples: Samples of the field along a ray.
    """
    device = model.scene_box.aabb.device
    devices = [device] if device.type == "cuda" else []
    field: Any = model.field
    number = max(16, PROBE_SAMPLES // num_samples)
    with torch.random.fork_rng(devices):
        rays = rays_from_the_middle(model, number)
        was_training = model.training
        model.train()
        forward_and_backward(model, rays)  # compiles
        seconds = seconds_of(lambda: forward_and_backward(model, rays), device)
        samples: Any = model.get_outputs(rays)["ray_samples_list"][-1]
        whole = kept_bytes(lambda: model.get_outputs(rays), model)
        of_field = kept_bytes(lambda: field(samples), model)
        model.train(was_training)
    share = num_rays / number
    return StepCost(whole * share, of_field * share, seconds * share, num_rays * num_samples)


def in_parts(
    field: Callable[[RaySamples], dict[Any, Tensor]], samples: RaySamples, samples_at_once: int | None
) -> dict[Any, Tensor]:
    """Outputs of a field at samples, evaluated in parts: the same values and gradients, in less memory.

    A part keeps nothing for its backward pass, but is computed again there (Chen et al., Training Deep Nets with
    Sublinear Memory Cost, 2016).

    Args:
        field: A function that computes each sample independently.
        samples: Samples of shape (rays, samples per ray).
        samples_at_once: Largest number of samples of a part, which has at least one ray; None for all samples.
    """
    assert samples.shape is not None
    rays, samples_a_ray = samples.shape
    rays_at_once = rays if samples_at_once is None else max(1, samples_at_once // samples_a_ray)
    if rays <= rays_at_once:
        return field(samples)
    parts = [samples[first : first + rays_at_once] for first in range(0, rays, rays_at_once)]
    found: list[Any]
    if torch.is_grad_enabled():
        found = [checkpoint(field, part, use_reentrant=False, preserve_rng_state=False) for part in parts]
    else:
        found = [field(part) for part in parts]
    return {name: torch.cat([values[name] for values in found]) for name in found[0]}
