"""The verdict on a run in one sentence, from its scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def verdict(scores: Mapping[str, Any]) -> str:
    """One sentence on how well the field explains what was held out; empty without scores.

    Args:
        scores: Scores of the run by name.
    """
    correlation, psnr = scores.get("event_correlation"), scores.get("psnr")
    parts = []
    if correlation is not None:
        share = max(correlation, 0.0) ** 2
        parts.append(f"explains {share:.0%} of the variance of held-out events (correlation {correlation:.2f})")
    if psnr is not None:
        parts.append(f"matches held-out frames with a PSNR of {psnr:.1f} dB")
    return f"The field {' and '.join(parts)}." if parts else ""
