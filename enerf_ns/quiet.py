"""Warnings of the packages below, of which a user of ours can mend nothing."""

from __future__ import annotations

import warnings

KNOWN_WARNINGS = (
    (FutureWarning, r"`torch\.cuda\.amp\.\w+\(args\.\.\.\)` is deprecated", r"nerfstudio\."),
    (UserWarning, r"Converting a tensor with requires_grad=True to a scalar", r"nerfstudio\.utils\.writer"),
    (UserWarning, r"Using a non-tuple sequence for multidimensional indexing", r"nerfstudio\.cameras\."),
)
"""Category, beginning of the message, and the modules that it comes from, as regular expressions."""


def silence_known_warnings() -> None:
    """Hides `KNOWN_WARNINGS` in this process from now on: where a command or a run of ours begins, never at import."""
    for category, message, module in KNOWN_WARNINGS:
        warnings.filterwarnings("ignore", message, category, module)
