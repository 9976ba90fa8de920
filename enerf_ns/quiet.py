"""Warnings of other packages, about which a user can do nothing."""

from __future__ import annotations

import warnings

KNOWN_WARNINGS = (
    (FutureWarning, r"`torch\.cuda\.amp\.\w+\(args\.\.\.\)` is deprecated", r"nerfstudio\."),
    (UserWarning, r"Converting a tensor with requires_grad=True to a scalar", r"nerfstudio\.utils\.writer"),
    (UserWarning, r"Using a non-tuple sequence for multidimensional indexing", r"nerfstudio\.cameras\."),
)
"""Category, and regular expressions of the message's beginning and of the module."""


def silence_known_warnings() -> None:
    """Hides `KNOWN_WARNINGS` in this process from now on. Commands and runs call it when they begin, never imports."""
    for category, message, module in KNOWN_WARNINGS:
        warnings.filterwarnings("ignore", message, category, module)
