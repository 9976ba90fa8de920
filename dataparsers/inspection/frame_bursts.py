"""Bursts of events when frames are taken: sensors with one array of pixels for both, as the DAVIS, disturb it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import EventRecording

SAMPLED_EVENTS = 2**22
"""Most events whose times are looked at, evenly taken of those of each pixel."""

BIN = 100_000
"""Width of a bin of the time from a frame, ns; wider where there are fewer than `EVENTS_PER_BIN`."""

EVENTS_PER_BIN = 100
"""Fewest events in a bin, of all frames together, on average."""

FEWEST_FRAMES = 8
"""Fewest frames that tell whether bursts come with them."""

LEAST_RATIO = 1.5
"""Least event rate of a burst, as a multiple of the median rate around the frame."""

CLEARLY = 5.0
"""Standard errors, over frames, by which a burst exceeds that rate."""

EDGE_RATIO, EDGE_CLEARLY = 1.1, 2.0
"""The same of the bins beside it that belong to it."""


@dataclass(frozen=True, eq=False)
class FrameBursts:
    """Bursts of events at fixed times from each frame."""

    delays: Int64[np.ndarray, "bursts 2"]
    """Begin and end of each burst, ns from the stamp of a frame; below 0 where it comes before the stamp."""
    spans: Int64[np.ndarray, "spans 2"]
    """First and last instant (ns) of the bursts of all frames, in order; those that overlap are joined."""
    share: float
    """Share of the events that are within the bursts."""
    excess: float
    """Share of the events that they are above the usual rate."""
    edges: Float64[np.ndarray, " bins+1"]
    """Edges of the bins of `ratio`, ns from the stamp of a frame."""
    ratio: Float64[np.ndarray, " bins"]
    """Event rate around frames, as a multiple of the median one."""

    def holds(self, times: Int64[np.ndarray, " times"]) -> Bool[np.ndarray, " times"]:
        """Which times (ns) lie within bursts."""
        begins, ends = self.spans.T
        return np.searchsorted(begins, times, side="right") > np.searchsorted(ends, times)

    def words(self) -> str:
        """When they come and how large they are."""
        when = " and ".join(f"{begin * 1e-6:+.1f} to {end * 1e-6:+.1f} ms" for begin, end in self.delays)
        return (
            f"{when} from the stamp of each frame, up to {self.ratio.max():.3g} times the usual rate: "
            f"{100 * self.excess:.1f} % of the events come on top of it"
        )


def frame_bursts(recording: EventRecording) -> FrameBursts | None:
    """Bursts of events that come with frames, by the event rate folded at their stamps.

    A burst is where that rate is above 1.5 times its median, and above it by 5 standard errors over frames, with the
    bins beside it where it is above 1.1 times, by 2. Frames that are reconstructed from events are none.

    Args:
        recording: Its index is made if it is not there yet.

    Returns:
        None where there are none, or too few frames to say so.

    Raises:
        RecordingError: The events cannot be used.
    """
    frames, index = recording.frames, index_events(recording)
    if frames is None and recording.reconstructed_by is None:
        frames = recording.blurred_frames
    if frames is None or len(frames.times) < FEWEST_FRAMES + 1:
        return None
    stamps = frames.times
    edges, counts = _folded(index, stamps)
    counts = counts[counts.sum(1) > 0]
    if len(counts) < FEWEST_FRAMES:
        return None
    usual = np.median(counts.mean(0))
    if not usual:
        return None
    ratio = counts.mean(0) / usual
    above = counts - np.median(counts, axis=1, keepdims=True)
    error = above.std(0) / np.sqrt(len(counts)) / usual
    clear = (ratio - 1 > CLEARLY * error) & (ratio > LEAST_RATIO)
    high = (ratio - 1 > EDGE_CLEARLY * error) & (ratio > EDGE_RATIO)
    runs = np.flatnonzero(np.diff(high, prepend=False, append=False)).reshape(-1, 2)
    ends = np.array([run for run in runs if clear[slice(*run)].any()], int).reshape(-1, 2)
    if not len(ends):
        return None
    bursts = np.zeros_like(high)
    for begin, end in ends:
        bursts[begin:end] = True
    delays = np.rint(edges[ends]).astype(np.int64)
    spans = (stamps[:, None, None] + delays).reshape(-1, 2)
    total = counts.sum()
    return FrameBursts(
        delays=delays,
        spans=_joined(spans),
        share=float(counts[:, bursts].sum() / total),
        excess=float((counts[:, bursts].sum() - len(counts) * usual * bursts.sum()) / total),
        edges=edges,
        ratio=ratio,
    )


def _folded(
    index: EventIndex, stamps: Int64[np.ndarray, " frames"]
) -> tuple[Float64[np.ndarray, " bins+1"], Int64[np.ndarray, "frames bins"]]:
    """Edges of bins of time from a stamp (ns), and the events in each of them about each stamp."""
    period = float(np.median(np.diff(stamps)))
    times = index.times[:: -(-len(index) // SAMPLED_EVENTS)].numpy()
    widest = len(times) / EVENTS_PER_BIN
    num_bins = int(np.clip(period / BIN, 1, max(widest, 1)))
    edges = np.linspace(-period / 2, period / 2, num_bins + 1)
    nearest = np.searchsorted((stamps[1:] + stamps[:-1]) / 2, times)
    bins = np.floor((times - stamps[nearest] - edges[0]) / (edges[1] - edges[0])).astype(np.int64)
    inside = (bins >= 0) & (bins < num_bins)
    places = nearest[inside] * num_bins + bins[inside]
    return edges, np.bincount(places, minlength=len(stamps) * num_bins).reshape(len(stamps), num_bins)


def _joined(spans: Int64[np.ndarray, "spans 2"]) -> Int64[np.ndarray, "joined 2"]:
    """The spans in order; those that touch or overlap are one."""
    begins, ends = spans[np.argsort(spans[:, 0])].T
    ends = np.maximum.accumulate(ends)
    first = np.concatenate([[True], begins[1:] > ends[:-1]])
    return np.stack([begins[first], ends[np.append(np.flatnonzero(first)[1:] - 1, len(ends) - 1)]], axis=1)
