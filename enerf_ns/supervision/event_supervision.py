"""What a rendered field is told by events, whatever rendered it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from enerf_ns.events.batch import EventBatch
from enerf_ns.kernels.precision import full_precision
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.supervision.losses import (
    huber_event_loss,
    no_event_loss,
    normalised_event_loss,
    squared_event_loss,
)

EventLoss = Callable[[Tensor, Tensor, "float | Tensor"], Tensor]
"""Loss of events: a function of rendered changes of log brightness (pairs,), measured ones (pairs,) and the mean
contrast threshold that gives one number."""

EVENT_LOSSES: dict[str, EventLoss] = {
    "huber": huber_event_loss,
    "squared": squared_event_loss,
    "normalised": lambda predicted, measured, _: normalised_event_loss(predicted, measured),
}
"""Losses by the names that the flag event-loss takes; a loss of one's own is put in here."""


@dataclass(frozen=True)
class EventSupervision:
    """Losses and metrics of the pairs of a batch; of a field, splats, or anything else that renders brightness."""

    event_loss: str
    """Name of the loss of events, one of `EVENT_LOSSES`."""
    event_loss_weight: float
    no_event_loss_weight: float
    """Weight of the loss on silent pixels."""
    no_event_margin: float
    """Share of the threshold that a silent pixel may change at no cost."""

    def losses(
        self,
        start: Float[Tensor, "pairs channels"],
        end: Float[Tensor, "pairs channels"],
        batch: EventBatch,
        sensor: SensorModel,
    ) -> dict[str, Tensor]:
        """event_loss, where the batch has pairs of events, instant_loss, where it has pairs of any instants, and
        no_event_loss, where it has silent pixels; with their weights.

        Args:
            start: Brightness rendered at the first instants.
            end: Brightness rendered at the second instants.
            batch: What was measured.
            sensor: What measured it.
        """
        change = brightness_change(start, end, batch, sensor)
        silent = batch.silent
        losses: dict[str, Tensor] = {}
        measured = sensor.measured_change(batch)
        for name, pairs in (("event_loss", batch.of_events), ("instant_loss", batch.of_any)):
            if pairs.stop > (pairs.start or 0):
                loss = EVENT_LOSSES[self.event_loss](change[pairs], measured[pairs], sensor.mean_threshold)
                losses[name] = self.event_loss_weight * loss
        if batch.num_silent:
            silence = change[silent] - measured[silent] if sensor.leaks else change[silent]
            loss = no_event_loss(silence, sensor.contrast_thresholds, self.no_event_margin)
            losses["no_event_loss"] = self.no_event_loss_weight * loss
        return losses

    @torch.no_grad()
    @full_precision
    def metrics(
        self,
        start: Float[Tensor, "pairs channels"],
        end: Float[Tensor, "pairs channels"],
        batch: EventBatch,
        sensor: SensorModel,
    ) -> dict[str, Tensor]:
        """event_correlation: the linear correlation of rendered and measured changes; arguments as of `losses`."""
        fired = batch.fired
        change = brightness_change(start, end, batch, sensor)[fired]
        measured = sensor.measured_change(batch)[fired]
        # of what is centred, the cosine; torch.corrcoef would have a GPU waited for
        change, measured = change - change.mean(), measured - measured.mean()
        return {"event_correlation": cosine_similarity(change, measured, dim=0)}


@full_precision
def brightness_change(
    start: Float[Tensor, "pairs channels"],
    end: Float[Tensor, "pairs channels"],
    batch: EventBatch,
    sensor: SensorModel,
) -> Float[Tensor, " pairs"]:
    """Change of log brightness, as the pixels of a batch see what was rendered at their two instants."""
    change = sensor.log_brightness(end, batch.pixels) - sensor.log_brightness(start, batch.pixels)
    return change - sensor.lag(start, end, batch) if sensor.lags and batch.rates is not None else change
