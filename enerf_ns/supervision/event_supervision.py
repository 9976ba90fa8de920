"""Losses and metrics of rendered brightness against events, for any renderer."""

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
"""Loss of events: a function of the rendered changes of log brightness (pairs,), the measured changes (pairs,) and the
mean contrast threshold. It returns one number."""

EVENT_LOSSES: dict[str, EventLoss] = {
    "huber": huber_event_loss,
    "squared": squared_event_loss,
    "normalised": lambda predicted, measured, _: normalised_event_loss(predicted, measured),
}
"""Losses by the values of the flag event-loss. Add your own loss here."""


@dataclass(frozen=True)
class EventSupervision:
    """Losses and metrics of the pairs of a batch, for a field, splats, or any other renderer of brightness."""

    event_loss: str
    """Name of the loss of events, one of `EVENT_LOSSES`."""
    event_loss_weight: float
    """Weight of the loss of events."""
    no_event_loss_weight: float
    """Weight of the loss on silent pixels."""
    no_event_margin: float
    """Change of a silent pixel that costs nothing, as a share of the threshold."""

    def losses(
        self,
        start: Float[Tensor, "pairs channels"],
        end: Float[Tensor, "pairs channels"],
        batch: EventBatch,
        sensor: SensorModel,
    ) -> dict[str, Tensor]:
        """The weighted losses of a batch, by name.

        These are event_loss for pairs of events, instant_loss for pairs of any instants, and no_event_loss for silent
        pixels, each if the batch has such pairs. Of a chain of two pairs, all six changes between its four instants
        count alike.

        Args:
            start: Brightness rendered at the first instants.
            end: Brightness rendered at the second instants.
            batch: The pairs.
            sensor: The sensor that fired the events.
        """
        change = brightness_change(start, end, batch, sensor)
        silent = batch.silent
        losses: dict[str, Tensor] = {}
        measured = sensor.measured_change(batch)
        kinds = {"event_loss": batch.of_events, "instant_loss": batch.of_any}
        changes = {name: (change[pairs], measured[pairs]) for name, pairs in kinds.items()}
        if (links := batch.links) is not None:
            before = torch.cat([end[first : first + number] for first, number in batch.chains])
            after = torch.cat([start[first + number : first + 2 * number] for first, number in batch.chains])
            of_links = brightness_change(before, after, links, sensor), sensor.measured_change(links)
            for name, part in (("event_loss", links.of_events), ("instant_loss", links.of_any)):
                rendered, reported = (
                    changes_of_chains(of_pairs, column[part])
                    for of_pairs, column in zip(changes[name], of_links, strict=True)
                )
                changes[name] = rendered, reported
        for name, (rendered, reported) in changes.items():
            if len(rendered):
                loss = EVENT_LOSSES[self.event_loss](rendered, reported, sensor.mean_threshold)
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
        """event_correlation: the linear correlation of rendered and measured changes. Arguments as in `losses`."""
        fired = batch.fired
        change = brightness_change(start, end, batch, sensor)[fired]
        measured = sensor.measured_change(batch)[fired]
        # the cosine of centred values; torch.corrcoef would wait for a GPU
        change, measured = change - change.mean(), measured - measured.mean()
        return {"event_correlation": cosine_similarity(change, measured, dim=0)}


def changes_of_chains(pairs: Float[Tensor, " pairs"], links: Float[Tensor, " links"]) -> Float[Tensor, " changes"]:
    """The six changes between the four instants of each chain, then the changes of the pairs that are in no chain.

    Args:
        pairs: Changes of pairs, of which i and n + i are the first and the last pair of a chain, for n links.
        links: Changes from the end of the first pair of each chain to the start of its last pair.
    """
    first, last, alone = pairs.split([len(links), len(links), len(pairs) - 2 * len(links)])
    begun, ended = first + links, links + last
    return torch.cat([first, links, last, begun, ended, begun + last, alone])


@full_precision
def brightness_change(
    start: Float[Tensor, "pairs channels"],
    end: Float[Tensor, "pairs channels"],
    batch: EventBatch,
    sensor: SensorModel,
) -> Float[Tensor, " pairs"]:
    """Rendered change of log brightness of each pair, as its pixel sees it. Arguments as in
    `EventSupervision.losses`."""
    change = sensor.log_brightness(end, batch.pixels) - sensor.log_brightness(start, batch.pixels)
    return change - sensor.lag(start, end, batch) if sensor.lags and batch.rates is not None else change
