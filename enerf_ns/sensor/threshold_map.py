"""Deviations of the contrast thresholds of single pixels from those of the sensor, learned beside a field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.sensor_estimates.estimates import threshold_spread
from enerf_ns.events.batch import EventBatch
from enerf_ns.kernels.precision import full_precision
from enerf_ns.sensor.part import SensorChoices
from enerf_ns.sensor.thresholds import Thresholds, ThresholdsConfig, chosen_thresholds, unknown_events

SOLVED_EVERY = 50
"""Observations between two solutions of the map."""

FIRST_SPREAD = 0.05
"""Relative standard deviation of thresholds from pixel to pixel before anything is observed."""

SMALLEST_SPREAD = 1e-3
"""Smallest standard deviation, from which a map can still grow."""

LARGEST_DEVIATION = 0.5
"""Largest deviation of a threshold, as a share of the sensor's."""


class ThresholdMap(nn.Module):
    """Relative deviations of the on and off thresholds of each pixel, by a regression that runs along with training.

    The log brightness of a pixel with n_on and n_off events should change by
    C_on (1 + d_on) n_on - C_off (1 + d_off) n_off. The residual between a rendered change and this change at d = 0 is
    linear in both deviations d. Each pixel keeps the normal equations of its two deviations. An observation is weighted
    robustly, as in the Huber loss, by the inverse variance of the residuals at that time, and by the square of its
    number, so that observations of an early field fade. A ridge draws the deviations to 0. Its strength comes from the
    variance of the deviations of all pixels (empirical Bayes), so that a sensor whose pixels are alike gets no map. The
    mean over the pixels stays 0, since it belongs to the thresholds of the sensor. The events of a pixel alone
    determine the difference of its deviations (`start_from`), which is one more equation.

    The map has no gradient and no learning rate. It is stored with the run, but without the equations that it started
    from: the pipeline sets these again.

    Args:
        num_pixels: Number of pixels of the sensor.
    """

    products: Tensor
    deviations: Tensor
    variance: Tensor
    spread: Tensor
    number: Tensor
    known: Tensor

    def __init__(self, num_pixels: int):
        super().__init__()
        self.register_buffer("products", torch.zeros(num_pixels, 5))
        self.register_buffer("deviations", torch.zeros(num_pixels, 2))
        self.register_buffer("variance", torch.ones(()))
        self.register_buffer("spread", torch.full((2,), FIRST_SPREAD))
        self.register_buffer("number", torch.zeros(()))
        self.register_buffer("known", torch.zeros(num_pixels, 2), persistent=False)
        self._observed = 0

    def factors(self, pixels: Int64[Tensor, " pairs"]) -> Float[Tensor, "pairs 2"]:
        """Factors of the on and off thresholds of pixels."""
        return 1.0 + self.deviations[pixels]

    @torch.no_grad()
    def start_from(self, difference: Float[Tensor, " pixels"], variance: Float[Tensor, " pixels"]) -> None:
        """Adds an estimate from before training, which is not stored with the run.

        Args:
            difference: Deviation of the on threshold less that of the off threshold.
            variance: Variance of the difference; infinite for pixels without an estimate.
        """
        self.known = torch.stack([1.0 / variance, difference / variance], dim=-1).to(self.deviations.device)
        self._solve()

    @torch.no_grad()
    @full_precision
    def observe(
        self,
        pixels: Int64[Tensor, " pairs"],
        on: Int[Tensor, " pairs"],
        off: Int[Tensor, " pairs"],
        residual: Float[Tensor, " pairs"],
        shares: tuple[float | Tensor, float | Tensor],
    ) -> None:
        """Adds the pairs of a step. Residuals that are not finite are passed over.

        Args:
            pixels: Pixels of the pairs, y * width + x.
            on, off: Numbers of their events.
            residual: Rendered change of log brightness less the sum of the events at the sensor's thresholds, in mean
                thresholds.
            shares: The sensor's on and off threshold, in mean thresholds.
        """
        is_finite = residual.isfinite()
        residual, on, off = (torch.where(is_finite, column, 0) for column in (residual, on, off))
        a, b = shares[0] * on, -shares[1] * off
        left = (residual - (torch.stack([a, b], dim=-1) * self.deviations[pixels]).sum(dim=-1)).abs()
        weight = 1.0 / left.clamp(min=1.0)
        self.number += 1.0
        now = (weight * left.square()).mean()
        self.variance += (now - self.variance) / self.number.clamp(max=100.0)
        weight = weight * self.number.square() / self.variance.clamp(min=1e-6)
        columns = torch.stack([a * a, a * b, b * b, a * residual, b * residual], dim=-1)
        self.products.index_add_(0, pixels, weight[:, None] * columns)
        if not self._observed:
            self._observed = int(self.number) - 1  # also of a run that goes on
        self._observed += 1
        if self._observed % SOLVED_EVERY == 0:
            self._solve()

    def _solve(self) -> None:
        """Solves the normal equations for the deviations, and estimates their spread from them and their errors."""
        weight, weighted = self.known.unbind(dim=-1)
        equations = torch.stack([weight, -weight, weight, weighted, -weighted], dim=-1)
        aa, ab, bb, ar, br = (self.products / self.number.clamp(min=1.0).square() + equations).unbind(dim=-1)
        prior = self.spread.square().reciprocal()
        aa, bb = aa + prior[0], bb + prior[1]
        determinant = aa * bb - ab * ab
        solved = torch.stack([bb * ar - ab * br, aa * br - ab * ar], dim=-1) / determinant[:, None]
        errors = torch.stack([bb, aa], dim=-1) / determinant[:, None]
        seen = ((self.products[:, [0, 2]] > 0.0) | (weight[:, None] > 0.0)).float()
        share = seen / seen.sum(dim=0).clamp(min=1.0)
        solved = seen * (solved - (share * solved).sum(dim=0))
        spread = (share * (solved.square() + errors)).sum(dim=0).sqrt()
        self.spread.copy_(torch.where(seen.any(dim=0), spread, self.spread).clamp(min=SMALLEST_SPREAD))
        self.deviations.copy_(solved.clamp(-LARGEST_DEVIATION, LARGEST_DEVIATION))


@dataclass
class PixelThresholdsConfig(ThresholdsConfig):
    """Settings of the threshold map."""

    learn_threshold_map: Optional[bool] = None  # noqa: UP045
    """Learn the deviation of the thresholds of each pixel from those of the sensor. Default: yes if the recording does
    not state the thresholds, and its events show that pixels differ."""


class PixelThresholds(Thresholds):
    """Pixels whose contrast thresholds differ, by a map that is learned."""

    def __init__(self, config: PixelThresholdsConfig):
        super().__init__(config)
        self.threshold_map = None
        if config.learn_threshold_map:
            assert config.width is not None and config.height is not None
            self.threshold_map = ThresholdMap(config.width * config.height)

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides whether the map is learned."""
        name, index = "model.sensor.learn_threshold_map", scene.once(unknown_events)
        spread = None if index is None else threshold_spread(index, scene.once(chosen_thresholds).values)
        kept = scene.use(name, lambda: spread is not None)
        why = spread.why if spread else "events do not show that the thresholds of pixels differ"
        value = "thresholds of each pixel are learned" if kept else ""
        scene.row("threshold map", kept, value, scene.why(name, why), name)

    def steps(self, batch: EventBatch) -> tuple[Tensor, Tensor]:
        """Log brightness by which the on events of each pair rise, and by which its off events fall; shape (pairs)."""
        on, off = super().steps(batch)
        if self.threshold_map is None:
            return on, off
        factors = self.threshold_map.factors(batch.pixels)
        return on * factors[:, 0], off * factors[:, 1]

    @torch.no_grad()
    def observe(self, change: Float[Tensor, " pairs"], batch: EventBatch) -> None:
        """Learns the map from what a training step rendered.

        Args:
            change: Rendered change of log brightness of each pair.
            batch: The pairs and their events.
        """
        super().observe(change, batch)
        if self.threshold_map is None:
            return
        fired, mean = batch.fired, self.mean_threshold
        on, off = batch.on[fired], batch.off[fired]
        c_on, c_off = (threshold / mean for threshold in self.contrast_thresholds)
        factors = self.threshold_map.factors(batch.pixels[fired]) - 1.0
        by_map = c_on * on * factors[:, 0] - c_off * off * factors[:, 1]
        residual = (change[fired] - self.measured_change(batch)[fired]) / mean + by_map
        self.threshold_map.observe(batch.pixels[fired], on, off, residual, (c_on, c_off))

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned: with the relative spreads `spread_on` and `spread_off`."""
        found = super().learned()
        if self.threshold_map is not None:
            on, off = self.threshold_map.spread.tolist()
            found |= {"spread_on": on, "spread_off": off}
        return found
