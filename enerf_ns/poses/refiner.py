"""Clock, mount, lens and drift of the poses, found while a field is trained: by damped Gauss-Newton steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Optional

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.poses.corrections import Corrections, DriftBasis

if TYPE_CHECKING:
    from enerf_ns.enerf_model import EnerfModel

Part = Literal["clock", "rotation", "translation", "focal_length", "distortion", "drift"]

UNITS: dict[Part, float] = {
    "clock": 20.0,
    "rotation": math.radians(1.0),
    "translation": 0.01,
    "focal_length": 0.03,
    "distortion": 0.05,
    "drift": 1.0,
}
"""How large each number may be expected to be: its unit here, and the standard deviation of what is known of it
beforehand. Milliseconds, radians, metres, shares."""

DRIFT_UNITS = np.array([0.01] * 3 + [math.radians(0.5)] * 3)
"""The same of the coefficients of the drift."""

PIECE_SECONDS, FEWEST_PIECES, MOST_PIECES = 0.2, 6, 60
"""Length (s) of the pieces of a drift, and their fewest and most number."""

FIRST_STEP = 50
"""Steps before which a field shows too little."""

FROZEN_FROM = 0.8
"""Share of the steps after which corrections stay as they are."""

LOOK_EVERY, LOOKS_A_SOLUTION = 4, 6
"""Steps from which pairs are looked at to the next, and how often that is done before corrections are."""

PAIRS = 256
"""Most pairs that are looked at at once."""

MEMORY = 0.9
"""Share of what was seen before that counts after poses were corrected."""

SURE = 9.0
"""By how much the squared error, in units of its variance, must fall beyond what chance explains before something is
corrected."""

LARGEST_STEP = 0.5
"""Most that any number changes at once, in its unit."""

LIMITS: dict[Part, float] = {
    "clock": 5.0,
    "rotation": 10.0,
    "translation": 20.0,
    "focal_length": 8.0,
    "distortion": 8.0,
    "drift": 20.0,
}
"""Largest corrections, in their units, that are believed."""

MIDDLE_GREY = 0.3
"""Brightness of what is not stopped by surfaces."""

NUM_SHAPES = 10
"""Number of polynomials of the place, up to squares, along each axis, by which the scene may bend."""

BEND = 0.1
"""How far the scene may be expected to bend, scene units."""


@dataclass
class RefinerConfig:
    """What of clock, poses and lens is corrected while training. What is None is chosen from the recording."""

    clock_ms: Optional[float] = None  # noqa: UP045
    """Milliseconds by which poses are stamped later than events of the same instant. None: what the contrast of the
    events tells, refined while training; a value is kept."""
    refine_clock: Optional[bool] = None  # noqa: UP045
    """Correct the clock between poses and events. None: where the events show that it is wrong."""
    refine_mount: Optional[bool] = None  # noqa: UP045
    """Correct how the camera is mounted on what the poses are of. None: where the events show that it is wrong."""
    refine_lens: Optional[bool] = None  # noqa: UP045
    """Correct the focal length and the first coefficient of distortion. None: where the events show that they are
    wrong."""
    refine_drift: Optional[bool] = None  # noqa: UP045
    """Correct a smooth drift of the poses. None: where the events show that there is one."""


class PoseRefiner(nn.Module):
    """What is wrong with the poses, as far as the events have told. Its buffers are stored with the run.

    Each look compares pairs of events with what is rendered of them, and asks by how much the difference would change
    with each number: the slope of rendered brightness along each ray's place and direction, of one backward pass, times
    how place and direction change with it. From time to time what was seen is solved for the numbers (Gauss-Newton,
    with Huber's weights, and what is known beforehand as damping).

    A field that learns from wrong poses hides their error in itself: the scene is bent so that it fits them. So the
    scene may bend in the solution, too, by polynomials of the place; what is left of an error after that is what it
    shows in spite of the field. Without this, a focal length that was wrong by 3 % came to 0.4 % after 600 steps; with
    it, to 2.8 %.

    A part is corrected only where the squared error falls by more than chance explains; until then it costs nothing but
    the looks.

    Args:
        config: Without anything open but what the events decide.
        recording: As it was read.
    """

    value: Tensor

    def __init__(self, config: RefinerConfig, recording: EventRecording):
        super().__init__()
        self.config, self.recording = config, recording
        trajectory = recording.trajectory
        pieces = round(1e-9 * (trajectory.end - trajectory.start) / PIECE_SECONDS)
        pieces = min(max(pieces, FEWEST_PIECES), MOST_PIECES)
        self.basis = DriftBasis(trajectory.start, trajectory.end, pieces)
        sizes: dict[Part, int] = {"clock": 1, "rotation": 3, "translation": 3, "focal_length": 1, "distortion": 1}
        sizes["drift"] = 6 * self.basis.size
        if recording.camera.model == "lookup":
            del sizes["distortion"]
        ends = np.cumsum([*sizes.values()])
        self.parts = {part: slice(end - size, end) for (part, size), end in zip(sizes.items(), ends, strict=True)}
        self.number = int(ends[-1])
        whole = self.number + 3 * NUM_SHAPES
        self.register_buffer("value", torch.zeros(self.number, dtype=torch.float64))
        self.register_buffer("errors", torch.zeros(self.number, dtype=torch.float64))
        self.register_buffer("is_corrected", torch.zeros(len(self.parts), dtype=torch.bool))
        self.register_buffer("normal", torch.zeros(whole, whole, dtype=torch.float64))
        self.register_buffer("right", torch.zeros(whole, dtype=torch.float64))
        self.register_buffer("looks", torch.zeros((), dtype=torch.int64))
        self._lens_cache: dict[tuple[str, float, float], np.ndarray] = {}
        self._before = np.eye(whole)
        drift = self.parts["drift"]
        self._before[drift, drift] += np.kron(self.basis.roughness, np.eye(6))
        self._units = np.concatenate([np.full(size, UNITS[part]) for part, size in sizes.items()])
        self._units[drift] = np.tile(DRIFT_UNITS, self.basis.size)
        if config.clock_ms:
            self.value[self.parts["clock"]] = config.clock_ms / UNITS["clock"]
        wanted: dict[Part, bool | None] = {
            "clock": config.refine_clock,
            "rotation": config.refine_mount,
            "translation": config.refine_mount,
            "focal_length": config.refine_lens,
            "distortion": config.refine_lens,
            "drift": config.refine_drift,
        }
        self.allowed = [part for part in self.parts if wanted[part] is not False]
        for number, part in enumerate(self.parts):
            self.is_corrected[number] = wanted[part] is True

    @property
    def corrected(self) -> list[Part]:
        """The parts that are corrected."""
        return [part for part, is_corrected in zip(self.parts, self.is_corrected.tolist(), strict=True) if is_corrected]

    @property
    def corrections(self) -> Corrections:
        """As they are."""
        return self._corrections(self.value.numpy())

    def _corrections(self, value: Float64[np.ndarray, " numbers"]) -> Corrections:
        numbers = {part: (value * self._units)[where] for part, where in self.parts.items()}
        drifts = "drift" in self.corrected
        return Corrections(
            delay=float(numbers["clock"][0]),
            rotation=tuple(numbers["rotation"].tolist()),
            translation=tuple(numbers["translation"].tolist()),
            focal_scale=1.0 + float(numbers["focal_length"][0]),
            distortion=float(numbers["distortion"][0]) if "distortion" in numbers else 0.0,
            basis=self.basis if drifts else None,
            drift=numbers["drift"].reshape(-1, 6) if drifts else None,
        )

    def look(
        self,
        residual: Float64[np.ndarray, " pairs"],
        slopes: Slopes,
        times: Int64[np.ndarray, "2 pairs"],
        pixels: Int64[np.ndarray, " pairs"],
    ) -> None:
        """Takes in some pairs.

        Args:
            residual: Measured changes of log brightness less rendered ones, thresholds.
            slopes: Of the rendered log brightness, thresholds, of all first instants and then of all second ones.
            times: Of both instants, ns.
            pixels: Their numbers, y * width + x.
        """
        times = times.reshape(-1)
        twists = np.concatenate([slopes.shifts, slopes.turns], axis=1)
        columns = [*self._columns(twists, slopes, times, np.tile(pixels, 2)).values(), slopes.bends]
        each = np.concatenate(columns, axis=1)
        each[:, : self.number] *= self._units
        each[:, self.number :] *= BEND
        changes = each[len(residual) :] - each[: len(residual)]
        weight = 1.0 / np.maximum(np.abs(residual), 1.0)
        variance = max(float((weight * residual**2).sum() / weight.sum()), 1e-6)
        weighted = changes * (weight / variance)[:, None]
        self.normal += torch.from_numpy(weighted.T @ changes)
        self.right += torch.from_numpy(weighted.T @ residual)
        self.looks += 1

    def _columns(
        self,
        twists: Float64[np.ndarray, "rays 6"],
        slopes: Slopes,
        times: Int64[np.ndarray, " rays"],
        pixels: Int64[np.ndarray, " rays"],
    ) -> dict[Part, Float64[np.ndarray, "rays numbers"]]:
        """By how much the log brightness of rays changes with each number."""
        now = self.corrections
        early, late = (now.poses(self.recording.trajectory, times + step) for step in (-500_000, 500_000))
        back = early[:, :, :3].transpose(0, 2, 1)
        shift = (back @ (late[:, :, 3:] - early[:, :, 3:]))[..., 0]
        turn = Rotation.from_matrix(back @ late[:, :, :3]).as_rotvec()
        a_millisecond = np.concatenate([shift, turn], axis=1)
        drift = self.basis.at(times)[:, :, None] * twists[:, None, :]
        columns: dict[Part, np.ndarray] = {
            "clock": (twists * a_millisecond).sum(axis=1, keepdims=True),
            "rotation": twists[:, 3:],
            "translation": twists[:, :3],
            "focal_length": (slopes.directions * self._lens_slopes("focal_scale")[pixels]).sum(axis=1, keepdims=True),
        }
        if "distortion" in self.parts:
            by_lens = self._lens_slopes("distortion")[pixels]
            columns["distortion"] = (slopes.directions * by_lens).sum(axis=1, keepdims=True)
        return columns | {"drift": drift.reshape(len(times), -1)}

    def _lens_slopes(self, name: str) -> Float64[np.ndarray, "pixels 3"]:
        """By how much the directions of pixels change with a number of the lens."""
        now, step = self.corrections, 1e-3
        key = name, now.focal_scale, now.distortion
        if key not in self._lens_cache:
            self._lens_cache = {old: value for old, value in self._lens_cache.items() if old[0] != name}
            directions = []
            for sign in (-1, 1):
                lens = Corrections(focal_scale=now.focal_scale, distortion=now.distortion)
                lens = replace(lens, **{name: getattr(lens, name) + sign * step})
                rays = lens.camera(self.recording.camera).pixel_directions().reshape(-1, 3)
                directions.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
            self._lens_cache[key] = (directions[1] - directions[0]) / (2.0 * step)
        return self._lens_cache[key]

    def solve(self) -> bool:
        """Corrects what was seen to be wrong.

        Returns:
            Whether anything was.

        Raises:
            RecordingError: Something is wrong by more than can be.
        """
        bends = np.arange(self.number, len(self.right))
        normal, right = self.normal.numpy(), self.right.numpy()
        corrected = self.corrected
        gains = self._gains(normal, right, corrected, bends)
        found = [part for part, gain in gains.items() if gain > 0]
        if found:
            best = max(found, key=lambda part: gains[part])
            self.is_corrected[list(self.parts).index(best)] = True
            corrected = self.corrected
        if not corrected:
            return False
        own = np.concatenate([np.arange(self.number)[self.parts[part]] for part in corrected])
        free = np.concatenate([own, bends])
        some = np.ix_(free, free)
        damped, value = normal[some] + self._before[some], np.zeros(len(free))
        value[: len(own)] = self.value.numpy()[own]
        pull = right[free] - self._before[some] @ value
        step = np.linalg.solve(damped, pull)
        step *= min(1.0, LARGEST_STEP / max(float(np.abs(step[: len(own)]).max()), 1e-12))
        self.errors.zero_()
        self.errors[own] = torch.from_numpy(np.sqrt(np.linalg.inv(damped).diagonal()[: len(own)]))
        self.value[own] += torch.from_numpy(step[: len(own)])
        whole = np.zeros(len(right))
        whole[free] = step
        self.right.copy_(torch.from_numpy(MEMORY * (right - normal @ whole)))
        self.normal *= MEMORY
        self._check()
        return True

    def _gains(self, normal, right, corrected: list[Part], bends: np.ndarray) -> dict[Part, float]:
        """By how much more than chance explains correcting each part would lower the squared error (score test)."""
        base = [np.arange(self.number)[self.parts[part]] for part in corrected] + [bends]

        def explained(numbers: list[np.ndarray]) -> float:
            free = np.concatenate(numbers)
            damped = normal[np.ix_(free, free)] + 1e-3 * self._before[np.ix_(free, free)]
            return float(right[free] @ np.linalg.solve(damped, right[free]))

        before, found = explained(base), {}
        for part in self.allowed:
            if part not in corrected:
                numbers = np.arange(self.number)[self.parts[part]]
                chance = len(numbers) + 3.0 * math.sqrt(2.0 * len(numbers)) + SURE
                found[part] = explained([*base, numbers]) - before - chance
        return found

    def _check(self) -> None:
        for part, where in self.parts.items():
            if not bool((self.value[where].abs() <= LIMITS[part]).all()):
                raise RecordingError(
                    f"{self.recording.path}: the {part.replace('_', ' ')} would have to be corrected by more than "
                    f"{LIMITS[part] * UNITS[part]:g}, which no recording is wrong by; check the poses with enerf "
                    "inspect, or train with the poses as they are."
                )


@dataclass(frozen=True)
class Slopes:
    """By how much rendered log brightness changes with a ray, in the axes of the camera."""

    shifts: Float64[np.ndarray, "rays 3"]
    """With its origin, a metre."""
    turns: Float64[np.ndarray, "rays 3"]
    """With the camera's rotation vector, a radian."""
    directions: Float64[np.ndarray, "rays 3"]
    """With its direction of length 1."""
    bends: Float64[np.ndarray, "rays shapes"]
    """With each of the shapes by which the scene may bend."""


def render_slopes(
    model: EnerfModel,
    rays: RayBundle,
    seen: Callable[[Tensor], Tensor],
    axes: Float[Tensor, "rays 3 3"],
    scale: float,
) -> tuple[Tensor, Slopes]:
    """What rays show, and its slopes.

    Samples stay at their places along the rays. The field's parameters get no gradients.

    Args:
        model: That renders.
        rays: One after the other.
        seen: Makes log brightness (rays,) of rendered brightness (rays, channels).
        axes: Rotations from the axes of the camera to those of the scene.
        scale: Scene units per metre.

    Returns:
        Log brightness (rays,), and its slopes.
    """
    if rays.nears is None:
        rays = model.collider(rays)
    with torch.no_grad():
        samples, _, _ = model._samples(rays)
    frustums = samples.frustums
    middles = 0.5 * (frustums.starts + frustums.ends)
    learned = [parameter for parameter in model.field.parameters() if parameter.requires_grad]
    for parameter in learned:
        parameter.requires_grad_(False)
    try:
        with torch.enable_grad():
            origins = frustums.origins.expand(-1, middles.shape[1], -1).clone().requires_grad_()
            frustums.origins = origins
            outputs = model.field(samples)
            weights = samples.get_weights(outputs[FieldHeadNames.DENSITY])
            rgb = (weights * outputs[FieldHeadNames.RGB]).sum(dim=-2) + MIDDLE_GREY * (1.0 - weights.sum(dim=-2))
            logs = seen(model.gain * rgb)
            (slopes,) = torch.autograd.grad(logs.sum(), origins)
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)
    places = (origins + frustums.directions * middles).detach()
    x, y, z = places.unbind(-1)
    shapes = torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], dim=-1)
    bends = torch.einsum("rsk,rsa->rka", shapes, slopes).flatten(1)
    back = axes.transpose(1, 2)
    local = (back @ rays.directions[..., None])[..., 0]
    to_direction = (back @ (slopes * middles).sum(dim=1)[..., None])[..., 0]
    to_origin = scale * (back @ slopes.sum(dim=1)[..., None])[..., 0]
    turns = torch.linalg.cross(local, to_direction)
    found = (column.double().cpu().numpy() for column in (to_origin, turns, to_direction, bends))
    return logs.detach(), Slopes(*found)
