"""The verdict on a run: whether its field explains the events, and advice if it does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from enerf_ns.dataparsers.recording.errors import quoted

FEW_STEPS = 300
"""Steps before which low scores mean nothing. A good run can have a correlation of 0.1 after 60 steps, and of 0.9 after
130."""

FEWEST_PAIRS = 100
"""Fewest pairs of events whose scores mean something: the standard error of a correlation is then 0.1."""

HIGH_CORRELATION, HIGH_SIGN = 0.6, 0.85
"""Correlation, or share of pairs with the right sign, from which the events are explained. Noise, or steep edges, lower
the correlation of a good run to 0.4, with the right sign at 0.89 of the pairs."""

LOW_CORRELATION, LOW_SIGN = 0.3, 0.75
"""Correlation and share of pairs with the right sign below which the events are not explained. Runs with wrong poses
have at most 0.2 and 0.66."""

SHORT = {
    "yes": "the events are explained",
    "partly": "the events are explained in part",
    "no": "the events are not explained",
    "unknown": "it is not known whether the events are explained",
}
"""The verdicts as clauses."""


@dataclass(frozen=True)
class Verdict:
    """Answer to the question whether a field explains the events of its recording."""

    explained: Literal["yes", "partly", "no", "unknown"]
    sentence: str
    """The verdict with its numbers, and advice unless the events are explained."""

    @property
    def short(self) -> str:
        """The verdict as a clause."""
        return SHORT[self.explained]


def verdict_on_events(
    scores: Mapping[str, Any],
    num_pairs: int,
    steps: int,
    cause: str,
    recording: Path,
    in_spite_of_corrections: bool = False,
) -> Verdict:
    """The verdict by the scores of held-out events.

    Args:
        scores: The `enerf_ns.evaluation.metrics.event_scores`, each a number or a reason.
        num_pairs: Number of different pairs of events that were scored.
        steps: Number of training steps done.
        cause: Likely cause why events are not explained, as a clause with advice; empty if there is none.
        recording: Folder of the recording.
        in_spite_of_corrections: Whether the cause was found with the poses, clock and lens that training corrected. The
            events are then explained in part at best.
    """
    correlation, sign = scores.get("event_correlation", "no events were scored"), scores.get("event_sign")
    if isinstance(correlation, str):
        return _verdict("unknown", f", because {correlation}.")
    if num_pairs < FEWEST_PAIRS:
        why = f"only {num_pairs} pairs of events are held out; hold out more (--pipeline.datamanager.held-out-events)"
        return _verdict("unknown", f", because {why}.")
    share, right = "", 0.0
    if isinstance(sign, (int, float)):
        share, right = f", and {100 * sign:.0f} % have the same sign", float(sign)
    found = f"at held-out events, rendered and measured changes of brightness correlate at {correlation:.2f}{share}"
    if (correlation >= HIGH_CORRELATION or right >= HIGH_SIGN) and not in_spite_of_corrections:
        return _verdict("yes", f": {found}.")
    if in_spite_of_corrections:
        advice = f"The corrections of clock, poses and lens do not suffice: {cause}."
    elif cause:
        advice = f"The likely cause: {cause}."
    elif steps < FEW_STEPS:
        rest = f", because {steps} steps are too few ({found}); train longer with --max-num-iterations."
        return _verdict("unknown", rest)
    else:
        advice = (
            f"Try in this order: check poses, clock and focal length with enerf inspect {quoted(recording)}; state the "
            "depth range with event-data --depth-range NEAR FAR; train longer with --max-num-iterations; state the "
            "thresholds with --pipeline.model.contrast-thresholds ON OFF."
        )
    is_low = correlation < LOW_CORRELATION and right < LOW_SIGN
    return _verdict("no" if is_low else "partly", f": {found}. {advice}")


def _verdict(explained: Literal["yes", "partly", "no", "unknown"], rest: str) -> Verdict:
    """The verdict whose sentence goes on with `rest`."""
    words = SHORT[explained]
    return Verdict(explained, f"{words[0].upper()}{words[1:]}{rest}")
