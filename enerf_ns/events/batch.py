"""Batches of one training step: pairs of instants of event pixels, and pixels of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor


@dataclass(frozen=True)
class EventBatch:
    """Pairs: a pixel, two instants, and the number of events that it fired after the first one, up to the second, if
    asked for with the changes that it missed between them while it was blind, in thresholds (`MissedChanges`)."""

    pixels: Int64[Tensor, " pairs"]
    """Number of the pixel of each pair, y * width + x."""
    start: Int64[Tensor, " pairs"]
    """First instant of each pair, ns. In a pair of events, it is the time of the first event."""
    end: Int64[Tensor, " pairs"]
    """Second instant of each pair, ns. It equals the first one if there was no pair to draw."""
    on: Int64[Tensor, " pairs"] | Float[Tensor, " pairs"]
    """Number of positive events of each pair."""
    off: Int64[Tensor, " pairs"] | Float[Tensor, " pairs"]
    """Number of negative events of each pair."""
    num_silent: int = 0
    """Number of pairs of silent pixels, with two instants between successive events. They come last."""
    num_any: int = 0
    """Number of pairs of any two instants, with or without events between them. They come before the silent pairs."""
    starts_at_events: bool = True
    """Whether pairs of events begin at events, after which pixels may be blind. Windows of time do not."""
    rates: Float[Tensor, "pairs 2 2"] | None = None
    """Events per second around the first and the second instant of each pair, on and off: `rates_around` of events,
    `rates_between` of windows and of any instants, and 0 of silent pairs, both instants of which lie between the same
    events. None if the sensor model needs no rates."""
    ahead: Float[Tensor, " pairs"] | None = None
    """Expected change of log brightness beyond the sum of the events, in thresholds, for instants that are no events.
    None: 0."""
    slopes: Float[Tensor, "pairs 2"] | None = None
    """Slope of the rendered log brightness at either instant, per second, for the first pairs, and 0 for the others.
    None if the sensor model needs no slopes."""
    links: EventBatch | None = None
    """Chains: link i leads from the second instant of pair i to the first instant of pair n + i of the same pixel, for
    the n links of pairs of events and for those of any instants alike. Links have no rays of their own. None: no pair
    is in a chain."""

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """pixels, start, end, on and off."""
        return self.pixels, self.start, self.end, self.on, self.off

    @property
    def num_changes_of_events(self) -> int:
        """Number of independent changes of brightness between events: the pairs, and the links of their chains."""
        return self.num_of_events + (0 if self.links is None else self.links.num_of_events)

    @property
    def num_changes_of_any(self) -> int:
        """Number of independent changes of brightness between any instants: the pairs, and the links of chains."""
        return self.num_any + (0 if self.links is None else self.links.num_any)

    @property
    def fired(self) -> slice:
        """Slice of the pairs of events and of any instants."""
        return slice(len(self) - self.num_silent)

    @property
    def num_of_events(self) -> int:
        """Number of pairs of events."""
        return len(self) - self.num_silent - self.num_any

    @property
    def of_events(self) -> slice:
        """Slice of the pairs of events."""
        return slice(self.num_of_events)

    @property
    def of_any(self) -> slice:
        """Slice of the pairs of any instants."""
        return slice(self.of_events.stop, self.fired.stop)

    @property
    def silent(self) -> slice:
        """Slice of the pairs of silent pixels."""
        return slice(len(self) - self.num_silent, None)

    @property
    def chains(self) -> tuple[tuple[int, int], ...]:
        """Parts of the pairs that are in chains: number of the first pair, and number n of the chains."""
        if self.links is None:
            return ()
        return (0, self.links.num_of_events), (self.num_of_events, self.links.num_any)

    def followed_by(self, others: EventBatch) -> EventBatch:
        """These pairs, and then the pairs of another batch.

        Args:
            others: Pairs of silent pixels or of any instants. This batch must hold no silent pairs.
        """
        columns = zip(self.columns, others.columns, strict=True)
        joined = (torch.cat(both) for both in columns)
        rates = None
        if self.rates is not None:
            further = self.rates.new_zeros(len(others), 2, 2) if others.rates is None else others.rates
            rates = torch.cat([self.rates, further])
        ahead = None
        if self.ahead is not None or others.ahead is not None:
            parts = [
                self.start.new_zeros(len(part)).float() if part.ahead is None else part.ahead for part in (self, others)
            ]
            ahead = torch.cat(parts)
        links = self.links
        if others.links is not None:
            links = others.links if links is None else links.followed_by(others.links)
        return EventBatch(
            *joined,
            num_silent=others.num_silent,
            num_any=self.num_any + others.num_any,
            starts_at_events=self.starts_at_events,
            rates=rates,
            ahead=ahead,
            links=links,
        )

    def subset(self, chosen: Bool[Tensor, " pairs"]) -> EventBatch:
        """The chosen pairs, without the links of chains."""
        columns = (column[chosen] for column in self.columns)
        num_silent, num_any = int(chosen[self.silent].sum()), int(chosen[self.of_any].sum())
        rates, ahead, slopes = (
            None if column is None else column[chosen] for column in (self.rates, self.ahead, self.slopes)
        )
        return EventBatch(
            *columns,
            num_silent=num_silent,
            num_any=num_any,
            starts_at_events=self.starts_at_events,
            rates=rates,
            ahead=ahead,
            slopes=slopes,
        )


@dataclass(frozen=True)
class FrameBatch:
    """Pixels of frames. The colour of each is the mean over some instants of its exposure."""

    indices: Int64[Tensor, "pixels 3"]
    """Frame, row and column of each pixel."""
    times: Int64[Tensor, "pixels instants"]
    """Instants at which each pixel is rendered, ns."""
    colours: Float[Tensor, "pixels 3"]
    """Recorded colours of the pixels, in [0, 1]."""
    are_grey: bool
    """Whether all frames are grey."""

    def subset(self, chosen: Bool[Tensor, " pixels"]) -> FrameBatch:
        """The chosen pixels."""
        return FrameBatch(self.indices[chosen], self.times[chosen], self.colours[chosen], self.are_grey)


@dataclass(frozen=True)
class TrainBatch:
    """A batch of events, of frames, or of both.

    Its rays are rendered together, in this order: the first instants of all pairs, their second instants, and the
    pixels of frames with all instants of each.
    """

    events: EventBatch | None
    frames: FrameBatch | None

    @property
    def num_pairs(self) -> int:
        """Number of pairs of instants, silent ones included."""
        return 0 if self.events is None else len(self.events)

    def split(self, rendered: Float[Tensor, "rays channels"]) -> tuple[Tensor, Tensor, Tensor]:
        """Splits rendered rays into first instants (pairs, channels), second instants (pairs, channels), and pixels of
        frames (pixels, channels), which are means over their instants."""
        pairs = self.num_pairs
        frames = rendered[2 * pairs :]
        if self.frames is not None:
            frames = frames.unflatten(0, self.frames.times.shape).mean(dim=1)
        return rendered[:pairs], rendered[pairs : 2 * pairs], frames
