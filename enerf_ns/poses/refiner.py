"""Estimation of errors of clock, mount, lens and poses while a field is trained, by damped Gauss-Newton steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Optional, Protocol

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.fields.base_field import Field
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.poses.corrections import Corrections, Drift, DriftBasis

Part = str
"""Name of a part of clock, poses or lens that may be wrong: clock, rate (of the clock), rotation and translation (of
the mount), lens, drift, or noise (after smoothing)."""

UNITS: dict[Part, float] = {
    "clock": 20.0,
    "rate": 0.1,
    "rotation": math.radians(1.0),
    "translation": 0.01,
    "lens": 0.03,
    "drift": 1.0,
    "noise": 1.0,
}
"""Prior standard deviation of each number, which is its unit here: milliseconds, milliseconds per second, radians,
metres, and a share of the focal length. Drift and noise have units of their own: `DRIFT_UNITS`, and the noise that
smoothing took off."""

STARTS_WITHIN: dict[Part, float] = {"clock": 1.0, "lens": 0.03}
"""Standard deviation of the error of a start value: milliseconds, and a share of the focal length."""

DISTORTION_UNITS = 0.02, 0.2
"""Smallest and largest unit of the first coefficient of distortion."""

DRIFT_UNITS = np.array([0.01] * 3 + [math.radians(0.5)] * 3)
"""Prior standard deviations of the coefficients of the drift: metres and radians."""

PIECE_SECONDS, FEWEST_PIECES, MOST_PIECES = 0.2, 6, 60
"""Length (s) of the pieces of a drift, and their fewest and most number."""

NOISE_POSES, MOST_NOISE_PIECES = 2, 160
"""Number of intervals between poses in a piece of the noise, and most pieces."""

NOISE_LEFT = 0.6
"""Expected standard deviation of the noise after smoothing, as a share of the noise that smoothing took off."""

FIRST_STEP = 50
"""First step at which pairs are compared. Before it, the field shows too little."""

FROZEN_FROM = 0.8
"""Share of the steps after which corrections no longer change."""

BEGINS_UNTIL = 0.4
"""Share of the steps after which no further part is corrected, since the field has to follow corrections."""

LOOK_EVERY, LOOK_AGAIN_EVERY, LOOKS_A_SOLUTION = 4, 2, 6
"""Steps from one look at pairs to the next, the same at first while a part is being corrected, and looks per
solution."""

PAIRS = 256
"""Most pairs of one look."""

MEMORY = 0.9
"""Weight of earlier looks after each correction of the poses."""

STEADY_LOOKS = 30
"""Number of looks over which the squared error of pairs is averaged, before it is compared with earlier ones."""

FITS_WORSE = 1.5
"""Increase of that error over its smallest value at which corrections are taken back."""

SURE, STAYS = 9.0, 3.0
"""Decrease of the squared error, in units of its variance and beyond chance, that begins the correction of a part, and
that keeps it."""

SYSTEMATIC = math.radians(0.004)
"""Standard deviation (radians) of an error of the whole rendered picture in any one direction, which more looks do not
reduce: 0.01 pixels of a sensor with 160 pixels over 60 degrees. A field is not more exact where pixels are finer, since
it learns from as many pairs."""

SETTLED_AFTER = 200.0
"""Step before which that error is larger, in inverse proportion to the step. Before it, the squared error of pairs may
grow with right corrections, too, since the field first shows nothing."""

FINEST_SLOPES = math.radians(0.6)
"""Angle (radians) that the smallest cells of the hash grid whose slopes count take up at a usual distance. Poses are
wrong by some tenths of a degree, and the slope of a finer detail does not reach as far."""

INSTANTS = 256
"""Number of instants at which the turn of the camera is measured."""

SMALLEST_TURN = math.radians(2.0)
"""Smallest root mean square turn of the camera about its second axis (radians) with which mount and lens are corrected
by default."""

IDENTIFIABLE = 0.25
"""Largest standard error of an identifiable number, in its unit."""

LARGEST_STEP = 0.5
"""Largest change of a number in one solution, in its unit."""

LIMITS: dict[Part, tuple[float, str]] = {
    "clock": (5.0, "the clock of the poses would have to be corrected by more than 100 ms"),
    "rate": (100.0, "the clock of the poses would have to be corrected by more than 10 ms per second"),
    "rotation": (10.0, "the mount would have to be turned by more than 10 degrees"),
    "translation": (20.0, "the mount would have to be shifted by more than 200 mm"),
    "lens": (8.0, "the focal length would have to be corrected by more than 24 %"),
    "drift": (20.0, "the poses would have to drift by more than 200 mm or 10 degrees"),
    "noise": (20.0, "the noise of the poses would have to be more than 12 times what was taken off"),
}
"""Largest plausible corrections, in their units, and the clause of the error message about a larger one."""

DISTORTED = "the lens would have to have a distortion that the calibration does not state"
"""The clause of the error message about a larger distortion, or about one that makes pixels see no direction."""

MIDDLE_GREY = 0.3
"""Brightness behind the scene, where accumulation is below 1."""

POWERS = [(i, j, k) for i in range(3) for j in range(3) for k in range(3) if i + j + k <= 2]
NUM_SHAPES = len(POWERS)
"""Number of polynomials of the position, up to squares, by which the scene may bend along each axis."""

NUM_OTHERS = 5
"""Number of nuisance columns: the photoreceptor's lag, the refractory period, contrast, the ratio of the thresholds,
and a leak."""

BEND = 0.1
"""Prior standard deviation of a bend of the scene, scene units."""


@dataclass
class RefinerConfig:
    """Selects the errors of clock, poses and lens that training corrects. Default: the recording decides."""

    clock_ms: Optional[float] = None  # noqa: UP045
    """Milliseconds by which poses are stamped later than events of the same instant. A value stays fixed. Default:
    motion compensation of the events estimates it before training, and training refines it."""
    frame_delay_ms: Optional[float] = None  # noqa: UP045
    """Milliseconds by which frames are stamped later than events of the same instant. Default: the delay that edges in
    frames and events show before training, if the clock of the poses is estimated, too; else 0."""
    focal_scale: Optional[float] = None  # noqa: UP045
    """The focal length as a multiple of the stated one. A value stays fixed. Default: motion compensation of the events
    estimates it before training, and training refines it."""
    refine_clock: Optional[bool] = None  # noqa: UP045
    """Correct the clock between poses and events. Default: if the events show that it is wrong."""
    refine_mount: Optional[bool] = None  # noqa: UP045
    """Correct the pose of the camera on the body that the poses belong to. Default: if the events show that it is
    wrong."""
    refine_lens: Optional[bool] = None  # noqa: UP045
    """Correct the focal length and the first coefficient of distortion. Default: if the events show that they are
    wrong."""
    refine_drift: Optional[bool] = None  # noqa: UP045
    """Correct a smooth drift of the poses, and the noise that smoothing left. Default: drift if the events show one,
    noise if the poses were smoothed."""


class PoseRefiner(nn.Module):
    """Estimates errors of clock, poses and lens from events. Its buffers are stored with the run.

    Each look compares pairs of events with their rendered changes of brightness. The derivative of the difference with
    respect to each number follows from one backward pass: it is the slope of rendered brightness along each ray's
    origin and direction, times their derivative with respect to the number. After some looks, a Gauss-Newton step with
    Huber's weights solves for the numbers, and their priors damp it.

    A field that learns from wrong poses hides their error, because it bends the scene until the scene fits the poses.
    So the solution lets the scene bend, too, by polynomials of the position. Only the rest of the error moves a number.
    Without the bend, a focal length that was wrong by 3 % was corrected by 0.4 % after 600 steps; with it, by 2.7 %.

    A part is corrected only if that reduces the squared error by more than chance explains. Until then, it costs only
    the looks.

    Args:
        config: With all values that the events do not decide.
        recording: As it was read.
    """

    value: Tensor
    """The numbers, in their units."""
    is_corrected: Tensor
    """Whether each part is corrected."""
    normal: Tensor
    """Matrix of the normal equations of the numbers, the bends of the scene and the nuisance columns."""
    right: Tensor
    """Right side of the normal equations."""
    looks: Tensor
    """Number of looks so far."""
    error: Tensor
    """Squared error of pairs, squared thresholds, averaged over the last looks."""
    least_error: Tensor
    """Smallest such error so far."""
    best_value: Tensor
    """The numbers of that time, in their units."""
    best_corrected: Tensor
    """The parts that were corrected at that time."""
    is_taken_back: Tensor
    """Whether later corrections were taken back, because events fitted them worse. No further ones follow."""

    def __init__(self, config: RefinerConfig, recording: EventRecording):
        super().__init__()
        self.config, self.recording = config, recording
        start, end = recording.span
        pieces = min(max(round(1e-9 * (end - start) / PIECE_SECONDS), FEWEST_PIECES), MOST_PIECES)
        self.basis = DriftBasis(start, end, pieces)
        has_coefficients = recording.camera.model != "lookup"
        sizes: dict[Part, int] = {"clock": 1, "rate": 1, "rotation": 3, "translation": 3, "lens": 1 + has_coefficients}
        sizes["drift"] = 6 * self.basis.size
        taken_off, noise_units = recording.pose_noise_taken_off, np.zeros(0)
        self.noise_basis: DriftBasis | None = None
        if taken_off is not None and config.refine_drift is not False:
            wanted_pieces = (end - start) / (NOISE_POSES * np.median(np.diff(recording.trajectory.times)))
            pieces = int(np.clip(round(wanted_pieces), 1, MOST_NOISE_PIECES))
            self.noise_basis = DriftBasis(start, end, pieces)
            # white noise: a piece that is longer than wanted averages more of it
            left = NOISE_LEFT * math.sqrt(min(pieces / wanted_pieces, 1.0)) * np.repeat(taken_off, 3)
            noise_units = np.tile(left, self.noise_basis.size)
            sizes["noise"] = len(noise_units)
        ends = np.cumsum([*sizes.values()])
        self.parts: dict[Part, slice] = {
            part: slice(end - size, end) for (part, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.number = int(ends[-1])
        whole = self.number + 3 * NUM_SHAPES + NUM_OTHERS
        self.register_buffer("value", torch.zeros(self.number, dtype=torch.float64))
        self.register_buffer("is_corrected", torch.zeros(len(self.parts), dtype=torch.bool))
        self.register_buffer("normal", torch.zeros(whole, whole, dtype=torch.float64))
        self.register_buffer("right", torch.zeros(whole, dtype=torch.float64))
        self.register_buffer("looks", torch.zeros((), dtype=torch.int64))
        self._lens: tuple[tuple[float, float], list[np.ndarray]] | None = None
        self._before = np.eye(whole)
        drift = self.parts["drift"]
        self._before[drift, drift] += np.kron(self.basis.roughness, np.eye(6))
        self._units = np.concatenate([np.full(size, UNITS[part]) for part, size in sizes.items()])
        self._units[drift] = np.tile(DRIFT_UNITS, self.basis.size)
        if self.noise_basis is not None:
            self._units[self.parts["noise"]] = noise_units
        if has_coefficients:
            self._units[self.parts["lens"].stop - 1] = _distortion_unit(recording.camera)
        wanted: dict[Part, bool | None] = {
            "clock": config.refine_clock,
            "rate": config.refine_clock,
            "rotation": config.refine_mount,
            "translation": config.refine_mount,
            "lens": config.refine_lens,
            "drift": config.refine_drift,
        }
        self.wanted = [part for part in wanted if wanted[part] is True]
        turns = turns_about_two_axes(recording)
        self.allowed = [
            part
            for part in wanted
            if wanted[part] or (wanted[part] is None and (turns or part in ("clock", "rate", "drift")))
        ]
        for number, part in enumerate(self.parts):
            self.is_corrected[number] = part in self._always or wanted[part] is True
        starts: dict[Part, float] = {"clock": config.clock_ms or 0.0, "lens": (config.focal_scale or 1.0) - 1.0}
        self._expected = np.zeros(whole)
        for part, start in starts.items():
            if start:
                number, unit = self.parts[part].start, UNITS[part]
                self.value[number] = self._expected[number] = start / unit
                self._before[number, number] = (unit / STARTS_WITHIN[part]) ** 2
                self.is_corrected[list(self.parts).index(part)] = True
        self.register_buffer("error", torch.zeros((), dtype=torch.float64))
        self.register_buffer("least_error", torch.tensor(torch.finfo(torch.float64).max, dtype=torch.float64))
        self.register_buffer("best_value", self.value.clone())
        self.register_buffer("best_corrected", self.is_corrected.clone())
        self.register_buffer("is_taken_back", torch.zeros((), dtype=torch.bool))

    @property
    def units(self) -> dict[Part, Float64[np.ndarray, " numbers"]]:
        """Prior standard deviation of each number: milliseconds, milliseconds per second, radians, metres, shares."""
        return {part: self._units[where] for part, where in self.parts.items()}

    @property
    def corrected(self) -> list[Part]:
        """The parts that are corrected."""
        return [part for part, is_corrected in zip(self.parts, self.is_corrected.tolist(), strict=True) if is_corrected]

    @property
    def corrections(self) -> Corrections:
        """The present corrections."""
        numbers = {part: (self.value.numpy() * self._units)[where] for part, where in self.parts.items()}
        drift = noise = None
        if "drift" in self.corrected:
            drift = Drift(self.basis, numbers["drift"].reshape(-1, 6))
        if self.noise_basis is not None and numbers["noise"].any():
            noise = Drift(self.noise_basis, numbers["noise"].reshape(-1, 6))
        return Corrections(
            delay=float(numbers["clock"][0]),
            delay_rate=float(numbers["rate"][0]),
            frame_delay=self.config.frame_delay_ms or 0.0,
            rotation=tuple(numbers["rotation"].tolist()),
            translation=tuple(numbers["translation"].tolist()),
            focal_scale=1.0 + float(numbers["lens"][0]),
            distortion=float(numbers["lens"][1:].sum()),
            drift=drift,
            noise=noise,
        )

    def look(
        self,
        residual: Float64[np.ndarray, " pairs"],
        slopes: Slopes,
        times: Int64[np.ndarray, "2 pairs"],
        pixels: Int64[np.ndarray, " pairs"],
        others: Float64[np.ndarray, "pairs others"],
        lags: Float64[np.ndarray, "2 pairs lags"],
    ) -> None:
        """Adds some pairs of events to the normal equations.

        Args:
            residual: Measured less rendered changes of log brightness, in thresholds.
            slopes: Slopes of the rendered log brightness, in thresholds: all first instants, then all second ones.
            times: Both instants, ns.
            pixels: Numbers of the pixels, y * width + x.
            others: Derivatives of the change of log brightness, in thresholds, with respect to nuisance parameters of
                about 1.
            lags: Derivatives of the pixels' lag (ms) at both instants, with respect to nuisance parameters of the lag.
        """
        times = times.reshape(-1)
        twists = np.concatenate([slopes.shifts, slopes.turns], axis=1)
        columns = self._columns(twists, slopes, times, np.tile(pixels, 2))
        by_lag = columns["clock"] * lags.reshape(len(times), -1) * UNITS["clock"]
        each = np.concatenate([*columns.values(), slopes.bends, by_lag], axis=1)
        each[:, : self.number] *= self._units
        each[:, self.number : self.number + 3 * NUM_SHAPES] *= BEND
        changes = np.concatenate([each[len(residual) :] - each[: len(residual)], others], axis=1)
        weight = 1.0 / np.maximum(np.abs(residual), 1.0)
        variance = max(float((weight * residual**2).sum() / weight.sum()), 1e-6)
        weighted = changes * (weight / variance)[:, None]
        self.normal += torch.from_numpy(weighted.T @ changes)
        self.right += torch.from_numpy(weighted.T @ residual)
        self.looks += 1
        self.error += (variance - self.error) / min(int(self.looks), STEADY_LOOKS)

    def _columns(
        self,
        twists: Float64[np.ndarray, "rays 6"],
        slopes: Slopes,
        times: Int64[np.ndarray, " rays"],
        pixels: Int64[np.ndarray, " rays"],
    ) -> dict[Part, Float64[np.ndarray, "rays numbers"]]:
        """Derivatives of the log brightness of rays with respect to each number."""
        now = self.corrections
        early, late = (now.poses(self.recording.trajectory, times + step) for step in (-500_000, 500_000))
        back = early[:, :, :3].transpose(0, 2, 1)
        shift = (back @ (late[:, :, 3:] - early[:, :, 3:]))[..., 0]
        turn = Rotation.from_matrix(back @ late[:, :, :3]).as_rotvec()
        a_millisecond = np.concatenate([shift, turn], axis=1)
        by_clock = (twists * a_millisecond).sum(axis=1, keepdims=True)
        trajectory = self.recording.trajectory
        columns: dict[Part, np.ndarray] = {
            "clock": by_clock,
            "rate": by_clock * (1e-9 * (times - (trajectory.start + trajectory.end) // 2))[:, None],
            "rotation": twists[:, 3:],
            "translation": twists[:, :3],
            "lens": np.stack(
                [(slopes.directions * slope[pixels]).sum(axis=1) for slope in self._lens_slopes()], axis=1
            ),
        }
        for part, basis in (("drift", self.basis), ("noise", self.noise_basis)):
            if basis is not None:
                columns[part] = (basis.at(times)[:, :, None] * twists[:, None, :]).reshape(len(times), -1)
        return columns

    def _lens_slopes(self) -> list[Float64[np.ndarray, "pixels 3"]]:
        """Derivatives of the directions of pixels with respect to each number of the lens.

        Raises:
            ValueError: The corrected lens has no inverse.
        """
        now, step = self.corrections, 1e-3
        key = now.focal_scale, now.distortion
        if self._lens is None or self._lens[0] != key:
            lens, slopes = Corrections(focal_scale=now.focal_scale, distortion=now.distortion), []
            here = self._directions(lens)
            for name in ("focal_scale", "distortion")[: self.parts["lens"].stop - self.parts["lens"].start]:
                ends = {0.0: here}
                for change in (-step, step):
                    with suppress(ValueError):  # of a lens that hardly has an inverse, one side is enough
                        ends[change] = self._directions(replace(lens, **{name: getattr(lens, name) + change}))
                first, last = min(ends), max(ends)
                slopes.append((ends[last] - ends[first]) / (last - first))
            self._lens = key, slopes
        return self._lens[1]

    def _directions(self, lens: Corrections) -> Float64[np.ndarray, "pixels 3"]:
        """Directions of pixels, of length 1; raises ValueError if the lens has no inverse."""
        rays = lens.camera(self.recording.camera).pixel_directions().reshape(-1, 3)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def solve(self, step: int, may_begin: bool = True) -> bool:
        """Solves the normal equations, and updates the corrections.

        Args:
            step: Step of the training.
            may_begin: Whether the correction of further parts may begin.

        Returns:
            Whether a correction changed.

        Raises:
            RecordingError: A correction exceeds `LIMITS`, or the corrected lens has no inverse.
        """
        if step >= SETTLED_AFTER and self._fits_worse():
            return True
        systematic = SYSTEMATIC * max(1.0, SETTLED_AFTER / step)
        believed = 1.0 / (1.0 + systematic**2 * self._information_a_radian)
        normal, right = believed * self.normal.numpy(), believed * self.right.numpy()
        value = np.zeros(len(right))
        for part in [*self.allowed, *self._always]:
            value[self.parts[part]] = self.value.numpy()[self.parts[part]]
        absolute = right + normal @ value + self._before @ self._expected
        parts = self._best_parts(normal, absolute)
        if not may_begin:
            parts = tuple(part for part in parts if part in self.corrected)
        if not parts and not self.corrected:
            return False
        for number, part in enumerate(self.parts):
            if part in self.allowed:
                self.is_corrected[number] = part in parts
        free = self._numbers(parts)
        damped = normal[np.ix_(free, free)] + self._before[np.ix_(free, free)]
        change = -value  # a part that is no longer corrected goes back to 0 at once
        change[free] = np.linalg.solve(damped, absolute[free]) - value[free]
        for part in self._always:
            change[self.parts[part]] = 0.0
        largest = float(np.abs(change[free[free < self.number]]).max(initial=0.0))
        change[free] *= min(1.0, LARGEST_STEP / max(largest, 1e-12))
        if self.noise_basis is not None:
            change[self.parts["noise"]] = self._change_of_noise(change)
        self.value += torch.from_numpy(change[: self.number])
        self.right.copy_(torch.from_numpy(MEMORY * (right - normal @ change) / believed))
        self.normal *= MEMORY
        self._check()
        return True

    def _fits_worse(self) -> bool:
        """Whether events fit the corrections much worse than the best ones before, which then come back."""
        if self.error < self.least_error:
            self.least_error.copy_(self.error)
            self.best_value.copy_(self.value)
            self.best_corrected.copy_(self.is_corrected)
        elif self.error > FITS_WORSE * self.least_error and not torch.equal(self.value, self.best_value):
            self.value.copy_(self.best_value)
            self.is_corrected.copy_(self.best_corrected)
            self.is_taken_back.fill_(True)
        return bool(self.is_taken_back)

    def _change_of_noise(self, change: Float64[np.ndarray, " whole"]) -> Float64[np.ndarray, " numbers"]:
        """The change of the noise after all other numbers have changed.

        The rendered picture may have the error `SYSTEMATIC` in each piece of the noise.
        """
        assert self.noise_basis is not None
        noise, normal = self.parts["noise"], self.normal.numpy()
        believed = 1.0 / (1.0 + SYSTEMATIC**2 * self._information_a_radian / self.noise_basis.size)
        pull = believed * (self.right.numpy() - normal @ change)[noise] - self.value.numpy()[noise]
        return np.linalg.solve(believed * normal[noise, noise] + np.eye(len(pull)), pull)

    def errors_of(self, part: Part) -> Float64[np.ndarray, " numbers"]:
        """Standard errors of the numbers of a part, corrected or not: milliseconds, milliseconds per second, radians,
        metres, shares. For the drift, they are those of its coefficients."""
        believed = 1.0 / (1.0 + SYSTEMATIC**2 * self._information_a_radian)
        numbers = self._numbers([other for other in self.parts if other == part or other in self.corrected])
        some = np.ix_(numbers, numbers)
        variances = np.zeros(len(self.right))
        variances[numbers] = np.linalg.inv(believed * self.normal.numpy()[some] + self._before[some]).diagonal()
        return (np.sqrt(variances[: self.number]) * self._units)[self.parts[part]]

    def _numbers(self, parts: Sequence[Part]) -> Int64[np.ndarray, " free"]:
        """Indices of the numbers of some parts in a solution, and of all bends and nuisance columns."""
        whole = np.arange(len(self.right))
        chosen = [*parts, *(part for part in self._always if part not in parts)]
        return np.concatenate([*(whole[self.parts[part]] for part in chosen), whole[self.number :]])

    @property
    def _always(self) -> list[Part]:
        """Parts that are corrected without a test for significance."""
        return [part for part in self.parts if part == "noise"]

    def _chance(self, part: Part) -> float:
        """Decrease of the squared error, in units of its variance, that numbers whose true value is 0 hardly ever
        reach."""
        size = self.parts[part].stop - self.parts[part].start
        return size + 3.0 * math.sqrt(2.0 * size) + (STAYS if part in self.corrected else SURE)

    @cached_property
    def _subsets(self) -> list[tuple[Part, ...]]:
        """All sets of parts that may be corrected, without the drift."""
        free = [part for part in self.allowed if part not in self.wanted and part != "drift"]
        chosen = [some for count in range(len(free) + 1) for some in combinations(free, count)]
        wanted = [part for part in self.wanted if part != "drift"]
        return [tuple(part for part in self.parts if part in wanted or part in some) for some in chosen]

    def _best_parts(
        self, normal: Float64[np.ndarray, "whole whole"], right: Float64[np.ndarray, " whole"]
    ) -> tuple[Part, ...]:
        """The set of parts whose correction reduces the squared error most, beyond chance.

        Args:
            normal, right: Normal equations for all numbers, not for their changes.
        """
        damped = normal + self._before
        small, drift = self.parts["drift"].start, "drift" in self.allowed
        best: tuple[Part, ...] = ()
        most = -math.inf
        for with_drift in (False, True)[: 1 + drift]:
            if "drift" in self.wanted and not with_drift:
                continue
            rest = self._numbers(("drift",) if with_drift else ())
            across = damped[:small, rest]
            solved = np.linalg.solve(damped[np.ix_(rest, rest)], np.column_stack([across.T, right[rest]]))
            own, pull = damped[:small, :small] - across @ solved[:, :-1], right[:small] - across @ solved[:, -1]
            base = float(right[rest] @ solved[:, -1])
            if with_drift and "drift" not in self.wanted:
                base -= self._chance("drift")
            for others in self._subsets:
                numbers = np.concatenate([np.arange(small)[self.parts[part]] for part in others] or [np.arange(0)])
                covariance = np.linalg.inv(own[np.ix_(numbers, numbers)])
                worth = base + float(pull[numbers] @ covariance @ pull[numbers])
                worth -= sum(self._chance(part) for part in others if part not in self.wanted)
                errors = np.zeros(small)
                errors[numbers] = np.sqrt(covariance.diagonal())
                known = all(errors[self.parts[part]].max() < IDENTIFIABLE for part in others if part not in self.wanted)
                if known and worth > most:
                    best, most = (*others, *(("drift",) if with_drift else ())), worth
        return best

    @property
    def _information_a_radian(self) -> float:
        """Increase of the squared error, in units of its variance, when the rendered picture moves by a radian."""
        return float(self.normal.diagonal()[self.parts["rotation"]][:2].mean()) / UNITS["rotation"] ** 2

    def _check(self) -> None:
        for part, where in self.parts.items():
            most, what = LIMITS[part]
            if not bool((self.value[where].abs() <= most).all()):
                is_distorted = part == "lens" and bool(self.value[where.start].abs() <= most)
                raise self._not_plausible(DISTORTED if is_distorted else what)
        try:
            self._lens_slopes()
        except ValueError as error:
            raise self._not_plausible(DISTORTED) from error

    def _not_plausible(self, what: str) -> RecordingError:
        return RecordingError(
            f"{self.recording.path}: to fit the events, {what}, which is not plausible; check poses and calibration "
            "with enerf inspect, or train with them as stated (--pipeline.refine-clock False, and so on)."
        )


def _distortion_unit(camera: Camera) -> float:
    """The first coefficient of distortion that moves the picture about as far as the unit of the focal length does."""
    square = (camera.width**2 + camera.height**2) / 12.0 / camera.fx**2  # mean distance from the middle, x / z
    return float(np.clip(UNITS["lens"] / square, *DISTORTION_UNITS))


def turns_about_two_axes(recording: EventRecording) -> bool:
    """Whether a camera turns far enough, while its recording is used, for its lens and its mount to be identifiable.

    If it turns about one axis alone, one direction of the mount's shift is not identifiable (Tsai and Lenz, IEEE
    Transactions on Robotics and Automation 1989). If it does not turn, neither mount nor focal length are: another
    scene explains the same events.
    """
    poses = recording.trajectory.poses(torch.from_numpy(recording.instants(INSTANTS)))
    rotations = Rotation.from_matrix(poses[:, :, :3].numpy())
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    second = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False)[1] / math.sqrt(len(turns))
    return bool(second > SMALLEST_TURN)


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the rendered log brightness of rays, in the axes of the camera."""

    shifts: Float64[np.ndarray, "rays 3"]
    """With respect to the origin of the ray, per metre."""
    turns: Float64[np.ndarray, "rays 3"]
    """With respect to the rotation vector of the camera, per radian."""
    directions: Float64[np.ndarray, "rays 3"]
    """With respect to the direction of the ray, which has length 1."""
    bends: Float64[np.ndarray, "rays shapes"]
    """With respect to each polynomial by which the scene may bend."""


class SampledModel(Protocol):
    """A model that renders its field at samples along rays."""

    collider: Any
    gain: float

    @property
    def field(self) -> Field: ...

    def _samples(self, rays: RayBundle) -> tuple[RaySamples, list[Tensor], list[RaySamples]]: ...


def render_slopes(
    model: SampledModel,
    rays: RayBundle,
    seen: Callable[[Tensor], Tensor],
    axes: Float[Tensor, "rays 3 3"],
    scale: float,
) -> tuple[Tensor, Slopes]:
    """Renders rays, and differentiates what a pixel sees with respect to origin and direction of each ray.

    Samples keep their distances along the rays. The field's parameters get no gradients.

    Args:
        model: Renders the rays.
        rays: A flat bundle.
        seen: Function from rendered brightness (rays, channels) to log brightness (rays,).
        axes: Rotations from the axes of the camera to the axes of the scene.
        scale: Scene units per metre.

    Returns:
        Brightness (rays, channels), and the slopes of the log brightness.
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
            (slopes,) = torch.autograd.grad(seen(model.gain * rgb).sum(), origins)
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)
    places = (origins + frustums.directions * middles).detach()
    shapes = torch.stack([(places ** places.new_tensor(powers)).prod(dim=-1) for powers in POWERS], dim=-1)
    bends = torch.einsum("rsk,rsa->rka", shapes, slopes).flatten(1)
    back = axes.transpose(1, 2)
    local = (back @ rays.directions[..., None])[..., 0]
    to_direction = (back @ (slopes * middles).sum(dim=1)[..., None])[..., 0]
    to_origin = scale * (back @ slopes.sum(dim=1)[..., None])[..., 0]
    turns = torch.linalg.cross(local, to_direction)
    found = (column.double().cpu().numpy() for column in (to_origin, turns, to_direction, bends))
    return model.gain * rgb.detach(), Slopes(*found)
