"""What one training step looks at: pairs of instants of pixels of the event camera, and pixels of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor


@dataclass(frozen=True)
class EventBatch:
    """Pixels, each with two instants and the events that it fired between them, the second instant included."""

    pixels: Int64[Tensor, " pairs"]
    """Number of the pixel of each pair, y * width + x."""
    start: Int64[Tensor, " pairs"]
    """First instant of each pair, ns; of a pair of events, that of its first event."""
    end: Int64[Tensor, " pairs"]
    """Second instant of each pair, ns; later than the first, or that one again, where there was no pair to draw."""
    on: Int64[Tensor, " pairs"]
    """Number of positive events of each pair, after the first instant and up to and with the second."""
    off: Int64[Tensor, " pairs"]
    """Number of negative events of each pair, after the first instant and up to and with the second."""
    num_silent: int = 0
    """Number of pairs of silent pixels, whose instants are any between two of their events; they come last."""
    num_any: int = 0
    """Number of pairs of any two instants, whatever the pixel fired between them; they come before silent ones."""
    starts_at_events: bool = True
    """Whether the pairs of events begin at events, after which pixels may be blind; windows of time do not."""
    rates: Float[Tensor, "pairs 2 2"] | None = None
    """Events a second around the first and the second instant of each pair, on and off (`samplers.rates_around`); None
    where nobody needs them."""
    ahead: Float[Tensor, " pairs"] | None = None
    """Thresholds by which log brightness changed more than the events between the instants say, as far as that is known
    of instants that are no events. None: 0."""
    slopes: Float[Tensor, "pairs 2"] | None = None
    """By how much rendered log brightness changes a second at either instant, of the first pairs; 0 of the others. None
    where nobody needs it."""

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def columns(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What is known of each pair, in the order of the fields."""
        return self.pixels, self.start, self.end, self.on, self.off

    @property
    def fired(self) -> slice:
        """Which pairs are of events, or of any instants."""
        return slice(len(self) - self.num_silent)

    @property
    def num_of_events(self) -> int:
        """Number of pairs of events."""
        return len(self) - self.num_silent - self.num_any

    @property
    def of_events(self) -> slice:
        """Which pairs are of events."""
        return slice(self.num_of_events)

    @property
    def of_any(self) -> slice:
        """Which pairs are of any instants."""
        return slice(self.of_events.stop, self.fired.stop)

    @property
    def silent(self) -> slice:
        """Which pairs are of silent pixels."""
        return slice(len(self) - self.num_silent, None)

    def followed_by(self, others: EventBatch) -> EventBatch:
        """A batch of these pairs, none of which is of a silent pixel, and then of others, whose instants are no events:
        those of silent pixels, or of any instants."""
        columns = zip(self.columns, others.columns, strict=True)
        joined = (torch.cat(both) for both in columns)
        rates = None if self.rates is None else torch.cat([self.rates, self.rates.new_zeros(len(others), 2, 2)])
        ahead = None
        if self.ahead is not None or others.ahead is not None:
            parts = [
                self.start.new_zeros(len(part)).float() if part.ahead is None else part.ahead for part in (self, others)
            ]
            ahead = torch.cat(parts)
        return EventBatch(
            *joined,
            num_silent=others.num_silent,
            num_any=self.num_any + others.num_any,
            starts_at_events=self.starts_at_events,
            rates=rates,
            ahead=ahead,
        )

    def subset(self, chosen: Bool[Tensor, " pairs"]) -> EventBatch:
        """The pairs that are chosen."""
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
    """Pixels of frames, each the mean of what it saw at instants of its exposure."""

    indices: Int64[Tensor, "pixels 3"]
    """Frame, row and column of each pixel."""
    times: Int64[Tensor, "pixels instants"]
    """Instants at which each pixel is rendered, ns."""
    colours: Float[Tensor, "pixels 3"]
    """Colours that were recorded at the pixels, in [0, 1]."""
    are_grey: bool
    """Whether the frames have no colour anywhere."""

    def subset(self, chosen: Bool[Tensor, " pixels"]) -> FrameBatch:
        """The pixels that are chosen."""
        return FrameBatch(self.indices[chosen], self.times[chosen], self.colours[chosen], self.are_grey)


@dataclass(frozen=True)
class TrainBatch:
    """A batch of events, of frames, or of both. Its rays are rendered in one go: all starts, all ends, all pixels of
    frames, of each pixel all instants."""

    events: EventBatch | None
    frames: FrameBatch | None

    @property
    def num_pairs(self) -> int:
        """Number of pairs of instants, of events and of silent pixels."""
        return 0 if self.events is None else len(self.events)

    def split(self, rendered: Float[Tensor, "rays channels"]) -> tuple[Tensor, Tensor, Tensor]:
        """What was rendered at the first instants (pairs, channels), at the second ones, and of the frames (pixels,
        channels), whose light adds up over their instants."""
        pairs = self.num_pairs
        frames = rendered[2 * pairs :]
        if self.frames is not None:
            frames = frames.unflatten(0, self.frames.times.shape).mean(dim=1)
        return rendered[:pairs], rendered[pairs : 2 * pairs], frames
