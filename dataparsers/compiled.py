"""Functions compiled to machine code."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any


@cache
def compiled(function: Callable, any_order: bool = False) -> Callable:
    """The function compiled by Numba when it is first called: without the GIL, dividing as NumPy does, and kept on disk
    for the next process where there is a folder to write it to.

    Args:
        function: What Numba can compile.
        any_order: Sums may be taken in any order, and products added to them unrounded, as vector instructions do.
    """
    import numba  # here, since importing it takes longer than reading a small recording

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if any_order:
        options["fastmath"] = {"reassoc", "contract"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no such folder
        return numba.njit(**options)(function)
