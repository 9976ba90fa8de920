"""Samplers of the pixels and instants that a training step compares: pairs of events, and silent pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float32, Int32, Int64
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_rates import rates_around, rates_between
from enerf_ns.events.batch import EventBatch
from enerf_ns.events.missed_changes import MissedChanges

MOST_DRAWS = 64
"""Largest number of draws for one pair that is kept."""

CHUNK = 2**20
"""Events that are handled at once while pairs are counted, which limits memory."""


class EventPairSampler:
    """Draws pairs of events of one pixel.

    Events of one pixel with the same time stamp are one instant, so that no pair has zero length. With i the number of
    an instant of a pixel, the pairs are

    * successor: (i, i + 1), the default of E-NeRF;
    * partner: (i, i + d) with every distance d from 1 to `max_distance`;
    * window: windows of `window_ns` divide the time from the first event on, and the pair is (i, last instant of this
      pixel in the same window), the 60 ms ablation of E-NeRF.

    If pixels are blind for a while after each event (`SensorModel.blind_after`), successor pairs are exact. Other pairs
    are approximate: the pixel is also blind after the events between the two, and its changes during that time are
    missing from the sum of the events, or known about (`MissedChanges`).

    Instants outside `stretches` do not count. The instants before and after a gap are neighbours, and their pair counts
    the events in the gap, so that it is approximate, too. Windows end at gaps.

    Args:
        index: The events. Batches are on its device.
        mode: Kind of the pairs.
        max_distance: For mode partner, at least 1.
        window_ns: For mode window, at least 1.
        uniform_over: With "pairs", all pairs are equally likely. With "pixels", all pixels that have a pair are equally
            likely, and so are all pairs of a pixel.
        stretches: First and last time (ns) of each part of the time that is used, in order and disjoint. Default: all.
        missed: What pixels missed while they were blind, which is then counted with the events. Default: nothing.

    Raises:
        ValueError: There is no pair to draw, or an argument is outside its range.
    """

    def __init__(
        self,
        index: EventIndex,
        mode: Literal["successor", "partner", "window"],
        max_distance: int = 30,
        window_ns: int = 60_000_000,
        uniform_over: Literal["pairs", "pixels"] = "pairs",
        stretches: Int64[Tensor, "stretches 2"] | None = None,
        missed: MissedChanges | None = None,
    ):
        if max_distance < 1 or window_ns < 1:
            raise ValueError(
                f"Pairs need max_distance and window_ns of at least 1, not {max_distance} and {window_ns}."
            )
        self.index, self.missed = index, missed
        self.window = mode == "window"
        self.max_distance = 1 if mode == "successor" else max_distance

        instants = _last_of_each(index, None, stretches)
        if self.window:
            lasts = _last_of_each(index, window_ns, stretches)
            instants &= ~lasts
            self._lasts = _places(lasts)
            del lasts  # it takes a byte an event
            self._starts = _places(instants)
            self._pair_offsets = torch.searchsorted(self._starts, index.offsets.int()).long()
        else:
            skipped = _places(instants.logical_not_())
            self._offsets = index.offsets - torch.searchsorted(skipped, index.offsets.int())
            self._before_skipped = skipped.sub_(torch.arange(len(skipped), dtype=skipped.dtype, device=skipped.device))
            count = self._offsets.diff()
            distances = (count - 1).clamp(min=0, max=self.max_distance)
            pairs = distances * (2 * count - distances - 1) // 2
            self._pair_offsets = torch.cat([pairs.new_zeros(1), pairs.cumsum(0)])
        self.num_pairs = int(self._pair_offsets[-1])
        if self.num_pairs == 0:
            where = f" within a window of {window_ns * 1e-6:g} ms" if self.window else ""
            where += " in the time that is used" if stretches is not None else ""
            raise ValueError(f"No pixel fired events at two different times{where}, so there is no pair to train on.")
        self._active = self._pair_offsets.diff().nonzero()[:, 0] if uniform_over == "pixels" else None

    def sample(self, batch_size: int, generator: torch.Generator, blind_ns: int | None = None) -> EventBatch:
        """Draws `batch_size` pairs with replacement.

        Args:
            batch_size: Number of pairs.
            generator: On the device of the index.
            blind_ns: How long a pixel is blind after an event, to add the event rates around the instants to the batch.
                Default: no rates.
        """
        pair, pixels = self._draw(batch_size, generator)
        if self.window:
            return _pairs_of(self.index, pixels, *self._window_pair(pair), blind_ns, self.missed)
        start, end = (self._event(instant) for instant in self._partner_pair(pair, pixels))
        return _pairs_of(self.index, pixels, start, end, blind_ns, self.missed)

    def sample_chains(self, batch_size: int, generator: torch.Generator, blind_ns: int | None = None) -> EventBatch:
        """Draws `batch_size` pairs with replacement, two of them in a chain: four events of one pixel, each at most
        `max_distance` events of the pixel after the one before. Of an odd number, one pair is in no chain.

        Four events have six changes of brightness between them, of which two pairs alone use two, for as many rays. A
        chain begins with a pair that is drawn as in `sample`. It is moved to an earlier event where the pixel has too
        few later events. Where it has fewer than four events in all, the last one is repeated.

        Where pixels are blind after events, the first event of the last pair counts when its pixel sees again, and the
        link to it ends then.

        Args:
            batch_size, generator, blind_ns: As in `sample`.

        Raises:
            ValueError: The pairs are those of a window of time.
        """
        if self.window:
            raise ValueError("Pairs of events within a window of time are not in chains.")
        number = batch_size // 2
        pair, pixels = self._draw(batch_size - number, generator)
        start, end = self._partner_pair(pair, pixels)
        steps = torch.full_like(start[:number].expand(2, -1), self.max_distance)
        further = 1 + _randint(steps, generator)
        chain = torch.stack([start[:number], end[:number], end[:number] + further[0], end[:number] + further.sum(0)])
        first, last = self._offsets[pixels[:number]], self._offsets[pixels[:number] + 1] - 1
        chain = torch.minimum(chain - torch.minimum((chain[3] - last).clamp(min=0), chain[0] - first), last)
        alone = torch.stack([start[number:], end[number:]])
        pairs_of = partial(_pairs_of, self.index, blind_ns=blind_ns, missed=self.missed)
        chain = self._event(chain)
        batch = _batch_of_chains(pairs_of, pixels, chain, self._event(alone))
        if self.missed is None:
            return batch
        return replace(batch, links=_links_of(self.index, pixels[:number], chain, blind_ns, self.missed))

    def _draw(self, number: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Numbers of random pairs, and their pixels."""
        device = self.index.times.device
        if self._active is None:
            pair = torch.randint(self.num_pairs, (number,), generator=generator, device=device)
            return pair, torch.searchsorted(self._pair_offsets, pair, right=True) - 1
        pixels = self._active[torch.randint(len(self._active), (number,), generator=generator, device=device)]
        begin = self._pair_offsets[pixels]
        return begin + _randint(self._pair_offsets[pixels + 1] - begin, generator), pixels

    def _window_pair(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        start = self._starts[pair]
        return start.long(), self._lasts[torch.searchsorted(self._lasts, start)].long()

    def _partner_pair(self, pair: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Instants of pairs, which are numbered over all pixels."""
        # n instants have n - d pairs of distance d. Distances d and m + 1 - d, m the largest, together have 2n - m - 1,
        # whatever d is: in a table with rows of that length, row r holds distance r + 1 and then distance m - r.
        first = self._offsets[pixels]
        count = self._offsets[pixels + 1] - first
        largest = (count - 1).clamp(max=self.max_distance)
        length = 2 * count - largest - 1
        place = pair - self._pair_offsets[pixels]
        row = place // length
        column = place - row * length
        second_half = column >= count - row - 1
        distance = torch.where(second_half, largest - row, row + 1)
        start = first + torch.where(second_half, column - (count - row - 1), column)
        return start, start + distance

    def _event(self, instants: Tensor) -> Tensor:
        """Numbers of the events at some instants, which are numbered over all pixels."""
        return instants + torch.searchsorted(self._before_skipped, instants.int(), right=True)


def _pairs_of(
    index: EventIndex,
    pixels: Tensor,
    start: Tensor,
    end: Tensor,
    blind_ns: int | None,
    missed: MissedChanges | None = None,
) -> EventBatch:
    """The batch of pairs of events with given numbers in the index, with rates if `blind_ns` is given, and with what
    was missed between them."""
    rates = None
    if blind_ns is not None:
        begins = rates_around(index, start, pixels, blind_ns, blind_ns)
        rates = torch.stack([begins, rates_around(index, end, pixels, 0, blind_ns)], dim=1)
    times = index.times[start], index.times[end]
    seen = times if missed is None else (missed.seen_again(*times), times[1])
    sums = _sums(index, missed, pixels, (start + 1, end + 1), seen)
    return EventBatch(pixels, *times, *sums, rates=rates)


def _links_of(
    index: EventIndex, pixels: Tensor, chains: Int64[Tensor, "4 chains"], blind_ns: int | None, missed: MissedChanges
) -> EventBatch:
    """The links of chains of events with given numbers in the index: from the second event to when the pixel sees again
    after the third one."""
    start, end, last = chains[1:]
    rates = None
    if blind_ns is not None:
        ends = rates_around(index, end, pixels, blind_ns, blind_ns)
        rates = torch.stack([rates_around(index, start, pixels, 0, blind_ns), ends], dim=1)
    times = index.times[start], missed.seen_again(index.times[end], index.times[last])
    sums = _sums(index, missed, pixels, (start + 1, end + 1), times)
    return EventBatch(pixels, *times, *sums, starts_at_events=False, rates=rates)


def _sums(
    index: EventIndex,
    missed: MissedChanges | None,
    pixels: Tensor,
    until: tuple[Tensor, Tensor],
    times: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Number of on and of off events between two instants, with what was missed.

    Args:
        until: Number of the first event in the index after each instant, or of the first one of the next pixel.
        times: The instants, ns.
    """
    on = _positives(index, until[1]) - _positives(index, until[0])
    off = until[1] - until[0] - on
    if missed is None:
        return on, off
    before, after = (missed.until(pixels, *instant) for instant in zip(until, times, strict=True))
    return on + (after - before)[:, 0], off + (after - before)[:, 1]


def _rates_at(
    index: EventIndex, until: Sequence[Tensor], pixels: Tensor, times: Sequence[Tensor], blind_ns: int
) -> Float32[Tensor, "pairs 2 2"]:
    """Rates of events at two instants of each pair, as `EventBatch.rates`. Arguments as in `_sums`."""
    instants = zip(until, times, strict=True)
    return torch.stack([rates_between(index, number, pixels, time, blind_ns) for number, time in instants], dim=1)


def _batch_of_chains(
    pairs_of: Callable[[Tensor, Tensor, Tensor], EventBatch],
    pixels: Int64[Tensor, " chains_and_others"],
    chains: Int64[Tensor, "4 chains"],
    others: Int64[Tensor, "2 others"],
) -> EventBatch:
    """The first pairs of all chains, their last pairs, and the pairs that are in no chain, with the links of chains.

    Args:
        pairs_of: Makes pairs of pixels and of their first and second instants or events.
        pixels: Pixels of the chains, then of the other pairs.
        chains, others: Instants of each, or numbers of events, in order.
    """
    in_chains = pixels[: chains.shape[1]]
    start, end = torch.cat([chains[0], chains[2], others[0]]), torch.cat([chains[1], chains[3], others[1]])
    return replace(
        pairs_of(torch.cat([in_chains, pixels]), start, end), links=pairs_of(in_chains, chains[1], chains[2])
    )


class HeldOutPairSampler:
    """Draws pairs of events of one pixel that both lie within held-out spans of time.

    All pairs that are at most `max_distance` events of the pixel apart are equally likely, and no pair has zero length.
    The two events may lie in different spans. The events between them count.

    Args:
        index: The events. Batches are on its device.
        spans: First and last time (ns) of each held-out span, in order and disjoint.
        max_distance: At least 1.
        missed: As in `EventPairSampler`.

    Raises:
        ValueError: There is no pair to draw.
    """

    def __init__(
        self,
        index: EventIndex,
        spans: Int64[Tensor, "spans 2"],
        max_distance: int,
        missed: MissedChanges | None = None,
    ):
        self.index, self.missed = index, missed
        held_out = _places(_last_of_each(index, None, spans))
        pixels = torch.searchsorted(index.offsets.int(), held_out, right=True, out_int32=True) - 1
        pairs = [held_out.new_zeros((0, 3))]
        for distance in range(1, min(max_distance + 1, len(held_out))):
            start, end, pixel = held_out[:-distance], held_out[distance:], pixels[distance:]
            chosen = (pixels[:-distance] == pixel) & (end - start <= max_distance)
            pairs.append(torch.stack([pixel, start, end], dim=-1)[chosen])
        self._pairs = torch.cat(pairs)
        if not len(self._pairs):
            raise ValueError(f"no pixel fired twice, {max_distance} events apart or less, in the time that is held out")

    def __len__(self) -> int:
        """Number of different pairs."""
        return len(self._pairs)

    def sample(self, batch_size: int, generator: torch.Generator, blind_ns: int | None = None) -> EventBatch:
        """Draws `batch_size` pairs with replacement, with the arguments of `EventPairSampler.sample`."""
        chosen = torch.randint(len(self._pairs), (batch_size,), generator=generator, device=self._pairs.device)
        pixels, start, end = self._pairs[chosen].long().T
        return _pairs_of(self.index, pixels, start, end, blind_ns, self.missed)


class SilentPixelSampler:
    """Draws pixels and two instants between which they fired nothing, for the no-event loss of E-NeRF.

    A pixel is drawn uniformly over the sensor, without hot pixels, and an instant uniformly over the recording or its
    stretches. The silent interval around the instant ends at the pixel's neighbouring events, or at the ends of the
    recording or of the stretch. It begins when the pixel is no longer blind. If the interval is at least
    `min_duration_ns` long, two instants in it are drawn uniformly, at most `max_duration_ns` apart, never at an event
    and never within `held_out`.

    The number of draws for one pair that is kept is measured once, at the first batch. So each step draws tensors of
    the same shape, and a GPU need not be waited for.

    Args:
        index: The events. Batches are on its device.
        start_ns, end_ns: First and last instant that may be drawn.
        min_duration_ns: At least 1.
        max_duration_ns: At least 2.
        stretches: First and last time (ns) of each part of the time that is used, in order and disjoint. Default: all.
        held_out: First and last time (ns) of spans in which no pair starts or ends, in order and disjoint.

    Raises:
        ValueError: A duration is shorter than its minimum, or no stretch lies between start and end.
    """

    def __init__(
        self,
        index: EventIndex,
        start_ns: int,
        end_ns: int,
        min_duration_ns: int,
        max_duration_ns: int,
        stretches: Int64[Tensor, "stretches 2"] | None = None,
        held_out: Int64[Tensor, "spans 2"] | None = None,
    ):
        if min_duration_ns < 1 or max_duration_ns < 2:
            raise ValueError(
                "Silent pixels need min_duration_ns of at least 1 and max_duration_ns of at least 2, "
                f"not {min_duration_ns} and {max_duration_ns}."
            )
        self.index = index
        self.min_duration_ns, self.max_duration_ns = min_duration_ns, max_duration_ns
        self._moments = _PixelMoments(index, start_ns, end_ns, stretches)
        self._held_out = held_out
        self._draws = _Draws()

    def sample(self, batch_size: int, generator: torch.Generator, refractory_ns: int = 0) -> EventBatch:
        """Draws `batch_size` silent pairs (on = off = 0).

        If `MOST_DRAWS` draws per pair find fewer silent intervals, the found ones are used again. If they find none,
        the two instants of each pair are equal.

        Args:
            batch_size: Number of pairs.
            generator: On the device of the index.
            refractory_ns: How long a pixel is blind after an event.
        """

        def pairs(draws: int, generator: torch.Generator) -> tuple[EventBatch, Tensor]:
            pixels, begin, end, usable = self._silent_intervals(draws, generator, max(refractory_ns, 1))
            batch = _silent_pairs(pixels, begin, end, generator)
            if self._held_out is not None:
                usable &= (_part(torch.stack([batch.start, batch.end]), self._held_out) % 2 == 0).all(dim=0)
            return batch, usable

        return self._draws.pairs(pairs, batch_size, generator)

    def _silent_intervals(
        self, draws: int, generator: torch.Generator, blind_ns: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Random pixels, first and last instant of the silence around a random instant, and whether it is long
        enough."""
        times, offsets = self.index.times, self.index.offsets
        pixels, instant, start_ns, end_ns = self._moments.draw(draws, generator)
        first, stop = offsets[pixels], offsets[pixels + 1]
        following = first + self.index.count_until(pixels, instant)
        previous_time = times[(following - 1).clamp(min=0)]
        following_time = times[following.clamp(max=len(times) - 1)]
        begin = torch.where(following > first, previous_time + blind_ns, start_ns).clamp(min=start_ns)
        end = torch.where(following < stop, following_time - 1, end_ns).clamp(max=end_ns)
        usable = (instant >= begin) & (end - begin >= self.min_duration_ns)
        begin = torch.maximum(begin, instant - self.max_duration_ns // 2)
        end = torch.minimum(end, instant + self.max_duration_ns // 2)
        return pixels, begin, end, usable


class SilentIntervalSampler:
    """Draws two instants between two successive events of a pixel, for the total variation of Deblur e-NeRF (Low and
    Lee, ECCV 2024).

    All intervals between successive events are equally likely, however long. An interval begins when the pixel is no
    longer blind. Two instants in it are drawn uniformly, never at an event.

    Args:
        index: The events. Batches are on its device.
        stretches: First and last time (ns) of each part of the time that is used, in order and disjoint. No interval
            reaches over a gap. Default: all.

    Raises:
        ValueError: There is no interval to draw.
    """

    def __init__(self, index: EventIndex, stretches: Int64[Tensor, "stretches 2"] | None = None):
        self._intervals = EventPairSampler(index, "successor", stretches=stretches)
        self._stretches = stretches
        self._draws = _Draws()

    def sample(self, batch_size: int, generator: torch.Generator, refractory_ns: int = 0) -> EventBatch:
        """Draws `batch_size` silent pairs (on = off = 0), with the rules of `SilentPixelSampler.sample` for rare ones.

        Args:
            batch_size: Number of pairs.
            generator: On the device of the index.
            refractory_ns: How long a pixel is blind after an event.
        """

        def pairs(draws: int, generator: torch.Generator) -> tuple[EventBatch, Tensor]:
            intervals = self._intervals.sample(draws, generator)
            begin, end = intervals.start + max(refractory_ns, 1), intervals.end - 1
            usable = begin < end
            if self._stretches is not None:
                usable &= _part(intervals.start, self._stretches) == _part(intervals.end, self._stretches)
            return _silent_pairs(intervals.pixels, begin, end, generator), usable

        return self._draws.pairs(pairs, batch_size, generator)


AHEAD = 0.2
"""Mean change of log brightness since a pixel's last event, in thresholds and in the direction of that event. The
signal that fired the event goes on, but not far enough to fire again. Simulated recordings have 0.14 to 0.24
(`benchmarks/instants.py`)."""


class InstantPairSampler:
    """Draws pairs of any two instants of a pixel, with the sum of its events between them.

    A pair of events gives the exact change of brightness of a pixel's area. But an edge passes through the pixel at
    these instants, so that a ray through its centre sees another brightness. Random instants mostly lie between edges.
    There, a ray sees what the pixel sees, and the sum of the events gives its brightness within half a threshold (root
    mean square). On average, the rest lies in the direction of the last event: `EventBatch.ahead`. Pairs without events
    are kept, too, since pairs with events alone would show too much contrast.

    A pixel is drawn uniformly over the sensor, without hot pixels, and one instant uniformly over the recording or its
    stretches. The other instant is drawn up to `max_duration_ns` before or after it. Beyond the first or the last
    instant, it is mirrored. Between two stretches, it moves to the beginning of the next stretch; after the last one,
    to its end. If pixels are blind for a while after an event, changes during that time are missing from the sum, or
    known about (`MissedChanges`).

    Args:
        index: The events. Batches are on its device.
        start_ns, end_ns: First and last instant that may be drawn.
        max_duration_ns: At least 1.
        stretches: First and last time (ns) of each part of the time that is used, in order and disjoint. Default: all.
        missed: As in `EventPairSampler`.

    Raises:
        ValueError: The duration is shorter than its minimum, or no stretch lies between start and end.
    """

    def __init__(
        self,
        index: EventIndex,
        start_ns: int,
        end_ns: int,
        max_duration_ns: int,
        stretches: Int64[Tensor, "stretches 2"] | None = None,
        missed: MissedChanges | None = None,
    ):
        if max_duration_ns < 1:
            raise ValueError(f"Pairs of instants need a max_duration_ns of at least 1, not {max_duration_ns}.")
        self.index, self.missed = index, missed
        self.start_ns, self.end_ns = start_ns, end_ns
        self.max_duration_ns = min(max_duration_ns, max(end_ns - start_ns, 1))
        self._moments = _PixelMoments(index, start_ns, end_ns, stretches)

    def sample(self, batch_size: int, generator: torch.Generator) -> EventBatch:
        """Draws `batch_size` pairs by a generator on the device of the index."""
        pixels, one, _, _ = self._moments.draw(batch_size, generator)
        start, end = torch.stack([one, self._other(one, generator)]).sort(dim=0)[0]
        return self._pairs(pixels, start, end)

    def sample_chains(self, batch_size: int, generator: torch.Generator, blind_ns: int | None = None) -> EventBatch:
        """Draws `batch_size` pairs, two of them in a chain, as those of `EventPairSampler.sample_chains`: four instants
        of one pixel, in order. One is drawn uniformly, and three near it. Of an odd number, one pair is in no chain.

        Args:
            batch_size, generator: As in `sample`.
            blind_ns: As in `EventPairSampler.sample`; the rates are those of `rates_between`.
        """
        number = batch_size // 2
        pixels, one, _, _ = self._moments.draw(batch_size - number, generator)
        others = [self._other(one[:number], generator) for _ in range(3)]
        chain = torch.stack([one[:number], *others]).sort(dim=0)[0]
        alone = torch.stack([one[number:], self._other(one[number:], generator)]).sort(dim=0)[0]
        return _batch_of_chains(partial(self._pairs, blind_ns=blind_ns), pixels, chain, alone)

    def _other(self, one: Int64[Tensor, " pairs"], generator: torch.Generator) -> Int64[Tensor, " pairs"]:
        """Random instants near others, in the time that is used."""
        steps = torch.full_like(one, 2 * self.max_duration_ns + 1)
        other = one + _randint(steps, generator) - self.max_duration_ns
        other = torch.where(other < self.start_ns, 2 * self.start_ns - other, other)
        other = torch.where(other > self.end_ns, 2 * self.end_ns - other, other)
        stretches = self._moments.stretches
        if stretches is None:
            return other
        part = _part(other, stretches)
        following = torch.cat([stretches[:, 0], stretches[-1:, 1]])
        return torch.where(part % 2 == 0, following[part // 2], other)

    def _pairs(
        self,
        pixels: Int64[Tensor, " pairs"],
        start: Int64[Tensor, " pairs"],
        end: Int64[Tensor, " pairs"],
        blind_ns: int | None = None,
    ) -> EventBatch:
        """The pairs of these instants, of which the second is not before the first."""
        begin = self.index.offsets[pixels]
        first, last = (begin + self.index.count_until(pixels, time) for time in (start, end))
        until = first, last
        going = [torch.where(number > begin, 2 * self._is_on(number) - 1, 0) for number in until]
        ahead = torch.where(until[1] > until[0], AHEAD * (going[1] - going[0]), 0.0)
        return EventBatch(
            *(pixels, start, end, *_sums(self.index, self.missed, pixels, until, (start, end))),
            num_any=len(pixels),
            starts_at_events=False,
            rates=None if blind_ns is None else _rates_at(self.index, until, pixels, (start, end), blind_ns),
            ahead=ahead,
        )

    def _is_on(self, until: Int64[Tensor, " pairs"]) -> Int64[Tensor, " pairs"]:
        """1 if the last of the first `until` events of the index is an on event, else 0."""
        return _positives(self.index, until) - _positives(self.index, (until - 1).clamp(min=0))


class AccumulationSampler:
    """Draws pixels and windows of time whose events are summed, as in EventNeRF (Rudnev et al., CVPR 2023).

    A window ends at an instant that is drawn uniformly over the recording or its stretches. Its length is drawn
    uniformly up to `max_duration_ns`, and cut at the beginning of the recording or of the stretch. A pixel is drawn
    uniformly over the sensor, without hot pixels. The pairs are windows in which the pixel fired, and a share
    `NEGATIVE_SHARE` of windows with or without events, so that silence counts, too.

    The change over a window is known only up to a threshold at either end, since neither end is an event. If pixels are
    blind for a while after an event, changes during that time are missing from the sum.

    Args:
        index: The events. Batches are on its device.
        start_ns, end_ns: First and last instant that may be drawn.
        max_duration_ns: At least 1.
        stretches: First and last time (ns) of each part of the time that is used, in order and disjoint. Default: all.

    Raises:
        ValueError: The duration is shorter than its minimum, or there is no event to draw.
    """

    NEGATIVE_SHARE = 0.1

    def __init__(
        self,
        index: EventIndex,
        start_ns: int,
        end_ns: int,
        max_duration_ns: int,
        stretches: Int64[Tensor, "stretches 2"] | None = None,
    ):
        if max_duration_ns < 1:
            raise ValueError(f"Windows need a max_duration_ns of at least 1, not {max_duration_ns}.")
        if start_ns == end_ns or not _last_of_each(index, None, stretches).any():
            where = " outside the gaps of the poses" if stretches is not None else ""
            raise ValueError(f"No pixel fired events at two different times{where}, so there is nothing to train on.")
        self.index = index
        self.max_duration_ns = max_duration_ns
        self._moments = _PixelMoments(index, start_ns, end_ns, stretches)
        self._of_fired, self._of_any = _Draws(), _Draws()

    def sample(self, batch_size: int, generator: torch.Generator, blind_ns: int | None = None) -> EventBatch:
        """Draws `batch_size` pairs.

        If `MOST_DRAWS` draws per pair find fewer windows with events, the found ones are used again. If they find none,
        the two instants of each pair are equal, and it counts no events.

        Args:
            batch_size: Number of pairs.
            generator: On the device of the index.
            blind_ns: As in `EventPairSampler.sample`; the rates are those of `rates_between`.
        """
        negatives = round(self.NEGATIVE_SHARE * batch_size)

        def windows(draws: int, generator: torch.Generator) -> tuple[EventBatch, Tensor]:
            windows = self._windows(draws, generator)
            return windows, windows.start < windows.end

        def fired(draws: int, generator: torch.Generator) -> tuple[EventBatch, Tensor]:
            windows = self._windows(draws, generator)
            return windows, windows.on + windows.off > 0

        found = (
            self._of_fired.pairs(fired, batch_size - negatives, generator),
            self._of_any.pairs(windows, negatives, generator),
        )
        columns = zip(*(batch.columns for batch in found), strict=True)
        pixels, start, end, on, off = (torch.cat(both) for both in columns)
        rates = None
        if blind_ns is not None:
            until = [self.index.offsets[pixels] + self.index.count_until(pixels, time) for time in (start, end)]
            rates = _rates_at(self.index, until, pixels, (start, end), blind_ns)
        return EventBatch(pixels, start, end, on, off, starts_at_events=False, rates=rates)

    def _windows(self, draws: int, generator: torch.Generator) -> EventBatch:
        """Windows of any length, 0 included, at random pixels."""
        pixels, end, first, _ = self._moments.draw(draws, generator)
        duration = torch.randint(self.max_duration_ns, (draws,), generator=generator, device=end.device) + 1
        start = (end - duration).clamp(min=first)
        until_start, until_end = (self.index.count_until(pixels, time) for time in (start, end))
        before = self.index.offsets[pixels]
        on = _positives(self.index, before + until_end) - _positives(self.index, before + until_start)
        return EventBatch(pixels, start, end, on, until_end - until_start - on, starts_at_events=False)


class _PixelMoments:
    """Draws pixels, without hot ones, and instants of the time that is used, uniformly. Arguments as in the
    samplers."""

    def __init__(self, index: EventIndex, start_ns: int, end_ns: int, stretches: Int64[Tensor, "stretches 2"] | None):
        self.start_ns, self.end_ns = start_ns, end_ns
        usable = torch.ones(len(index.offsets) - 1, dtype=torch.bool, device=index.times.device)
        usable[index.hot_pixels] = False
        self._pixels = usable.nonzero()[:, 0]
        self.stretches = stretches
        """The stretches between `start_ns` and `end_ns`. None: all of the time."""
        if stretches is not None:
            used = (stretches[:, 0] <= end_ns) & (stretches[:, 1] >= start_ns)
            if not used.any():
                raise ValueError("All events lie in one gap of the poses, so that no silence can be drawn.")
            self.stretches = stretches[used].clamp(start_ns, end_ns)
            self._after = (self.stretches.diff(dim=1)[:, 0] + 1).cumsum(0)
            self._total = int(self._after[-1])

    def draw(self, number: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor | int, Tensor | int]:
        """Random pixels, random instants, and the first and the last instant of the stretch around each instant."""
        device = self._pixels.device
        pixels = self._pixels[torch.randint(len(self._pixels), (number,), generator=generator, device=device)]
        if self.stretches is None:
            instant = torch.randint(self.start_ns, self.end_ns + 1, (number,), generator=generator, device=device)
            return pixels, instant, self.start_ns, self.end_ns
        place = torch.randint(self._total, (number,), generator=generator, device=device)
        stretch = torch.searchsorted(self._after, place, right=True)
        begin, end = self.stretches[stretch].T
        return pixels, end + 1 - (self._after[stretch] - place), begin, end


class _Draws:
    """Draws enough random pairs to keep a wanted number."""

    def __init__(self) -> None:
        self._kept: float | None = None
        """Lower bound of the share of draws that are kept."""

    def pairs(
        self,
        draw: Callable[[int, torch.Generator], tuple[EventBatch, Tensor]],
        number: int,
        generator: torch.Generator,
    ) -> EventBatch:
        """The first kept pairs among those drawn.

        If too few are kept, they are repeated. If none are, the pairs have two equal instants and no events.

        Args:
            draw: Draws a number of pairs by a generator, and returns them and whether each is kept.
            number: Wanted number of pairs.
            generator: Of the draws.
        """
        if self._kept is None:
            _, kept = draw(max(MOST_DRAWS * number, 1024), torch.Generator(generator.device).manual_seed(0))
            sure = kept.double().mean() - 4.0 * (kept.double().var() / len(kept)).sqrt()
            self._kept = max(float(sure), 1.0 / MOST_DRAWS)
        spread = 4.0 * math.sqrt(number) + 16.0
        batch, kept = draw(math.ceil(min((number + spread) / self._kept, MOST_DRAWS * (number + 16))), generator)
        places = kept.logical_not().to(torch.uint8).argsort(stable=True)  # kept pairs come first, in order
        num_kept = kept.count_nonzero()
        places = places[torch.arange(number, device=kept.device) % num_kept.clamp(min=1)]
        pixels, start, end, on, off = (column[places] for column in batch.columns)
        none = num_kept == 0
        end, on, off = torch.where(none, start, end), on.masked_fill(none, 0), off.masked_fill(none, 0)
        silent = number if batch.num_silent else 0
        return EventBatch(pixels, start, end, on, off, num_silent=silent, starts_at_events=batch.starts_at_events)


def _silent_pairs(pixels: Tensor, begin: Tensor, end: Tensor, generator: torch.Generator) -> EventBatch:
    """Pairs of two different instants in silent intervals, which are given by their first and last instants.

    An interval with a single instant is extended by a nanosecond.
    """
    instants = (end - begin + 1).clamp(min=2)
    one = _randint(instants, generator)
    other = _randint(instants - 1, generator)
    other += other >= one
    none = torch.zeros_like(pixels)
    start, end = begin + torch.minimum(one, other), begin + torch.maximum(one, other)
    return EventBatch(pixels, start, end, none, none, num_silent=len(pixels))


def _last_of_each(
    index: EventIndex, window_ns: int | None, stretches: Int64[Tensor, "stretches 2"] | None
) -> Bool[Tensor, " events"]:
    """Whether each event is the last one of its pixel at its time, or in its window of time.

    Args:
        index: The events.
        window_ns: Length of the windows, which begin at the first event. None: windows of a single time.
        stretches: Windows also end at the ends of stretches, and no event outside of stretches is a last one. None: all
            of the time.
    """
    times = index.times
    origin = index.span[0] if window_ns is not None and len(times) else 0
    last = torch.ones(len(times), dtype=torch.bool, device=times.device)
    for first in range(0, len(times) - 1, CHUNK):
        values = times[first : first + CHUNK + 1]
        part = None if stretches is None else _part(values, stretches)
        if window_ns is not None:
            values = (values - origin) // window_ns
        chunk = last[first : first + len(values) - 1]
        chunk[:] = values[1:] != values[:-1]
        if part is not None:
            chunk |= part[1:] != part[:-1]
    last[index.offsets[1:][index.offsets.diff() > 0] - 1] = True
    if stretches is not None:
        for first in range(0, len(times), CHUNK):
            last[first : first + CHUNK] &= _part(times[first : first + CHUNK], stretches) % 2 == 1
    return last


def _part(times: Int64[Tensor, "*times"], stretches: Int64[Tensor, "stretches 2"]) -> Int64[Tensor, "*times"]:
    """Number of the part of time at each time: 0 before the first stretch, 1 within it, 2 in the gap behind it, …"""
    begins, ends = stretches.T.contiguous()
    return torch.searchsorted(begins, times, right=True) + torch.searchsorted(ends, times)


def _positives(index: EventIndex, events: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """Number of positive events among the first `events` events of the index."""
    return torch.where(events > 0, index.positives[(events - 1).clamp(min=0)], 0).long()


def _places(chosen: Bool[Tensor, " events"]) -> Int32[Tensor, " chosen"]:
    """Numbers of the chosen events."""
    places = torch.empty(int(chosen.count_nonzero()), dtype=torch.int32, device=chosen.device)
    filled = 0
    for first in range(0, len(chosen), CHUNK):
        found = chosen[first : first + CHUNK].nonzero()[:, 0] + first
        places[filled : filled + len(found)] = found
        filled += len(found)
    return places


def _randint(high: Tensor, generator: torch.Generator) -> Tensor:
    """Random integers in [0, high), with a bound for each. The bias is less than high / 2^62."""
    return torch.randint(2**62, high.shape, generator=generator, device=high.device) % high
