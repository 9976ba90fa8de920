"""Compilation of functions to machine code."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any


@cache
def compiled(function: Callable, any_order: bool = False) -> Callable:
    """The function, compiled by Numba at its first call.

    It runs without the GIL, divides by zero as NumPy does, and is stored on disk for the next process if there is a
    folder to write to.

    Args:
        function: A function that Numba can compile.
        any_order: Let sums be taken in any order, and products be added unrounded, as vector instructions do.
    """
    import numba  # here, since importing it takes longer than reading a small recording

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if any_order:
        options["fastmath"] = {"reassoc", "contract"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no folder to write to
        return numba.njit(**options)(function)
