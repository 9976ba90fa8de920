"""Bursts of events when frames are taken, which sensors with one array of pixels for both show, such as the DAVIS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import EventRecording

SAMPLED_EVENTS = 2**22
"""Most events whose times are looked at, evenly taken from each pixel."""

BIN = 100_000
"""Width of a bin of the time from a frame, ns. Bins are wider if they would hold fewer than `EVENTS_PER_BIN`."""

EVENTS_PER_BIN = 100
"""Fewest events in a bin on average, summed over all frames."""

FEWEST_FRAMES = 8
"""Fewest frames with events around them in which bursts are searched."""

LEAST_RATIO = 1.5
"""Least event rate of a burst, as a multiple of the median rate around the frame."""

CLEARLY = 5.0
"""Standard errors, over frames, by which a burst must exceed the median rate."""

EDGE_RATIO, EDGE_CLEARLY = 1.1, 2.0
"""Least event rate, and standard errors, of the bins beside a burst that belong to it."""


@dataclass(frozen=True, eq=False)
class FrameBursts:
    """Bursts of events at fixed times from each frame."""

    delays: Int64[np.ndarray, "bursts 2"]
    """Begin and end of each burst, ns from the stamp of a frame. Negative before the stamp."""
    excess: float
    """Share of all events by which the bursts exceed the usual rate."""
    edges: Float64[np.ndarray, " bins+1"]
    """Edges of the bins of `ratio`, ns from the stamp of a frame."""
    ratio: Float64[np.ndarray, " bins"]
    """Event rate around frames, as a multiple of the median one."""

    def words(self) -> str:
        """Times and sizes of the bursts, in words."""
        when = " and ".join(f"{begin * 1e-6:+.1f} to {end * 1e-6:+.1f} ms" for begin, end in self.delays)
        return (
            f"{when} from the stamp of each frame, up to {self.ratio.max():.3g} times the usual rate; "
            f"{100 * self.excess:.1f} % of all events are in excess of that rate"
        )


def frame_bursts(recording: EventRecording) -> FrameBursts | None:
    """Bursts of events that come with frames, from the event rate folded at the stamps of the frames.

    In a burst, the rate exceeds its median by a factor of 1.5 and by 5 standard errors over frames. Neighbouring bins
    belong to the burst if they exceed the median by a factor of 1.1 and by 2 standard errors. Frames that are
    reconstructed from events do not count.

    Args:
        recording: Its index is made if it is not there yet.

    Returns:
        None if there are no bursts, or too few frames.

    Raises:
        RecordingError: The events cannot be used.
    """
    frames = recording.camera_frames
    if frames is None or len(frames.times) < FEWEST_FRAMES + 1:
        return None
    edges, counts = _folded(index_events(recording), frames.times)
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
    return FrameBursts(
        delays=np.rint(edges[ends]).astype(np.int64),
        excess=float((counts[:, bursts].sum() - len(counts) * usual * bursts.sum()) / counts.sum()),
        edges=edges,
        ratio=ratio,
    )


def _folded(
    index: EventIndex, stamps: Int64[np.ndarray, " frames"]
) -> tuple[Float64[np.ndarray, " bins+1"], Int64[np.ndarray, "frames bins"]]:
    """Edges (ns) of bins of the time from a stamp, and the number of events in each bin around each stamp."""
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
