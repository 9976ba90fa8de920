"""Functions compiled to machine code."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache


@cache
def compiled(function: Callable) -> Callable:
    """The function compiled by Numba when it is first called: without the GIL, dividing as NumPy does, and kept on disk
    for the next process where there is a folder to write it to."""
    import numba  # here, since importing it takes longer than reading a small recording

    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no such folder
        return numba.njit(**options)(function)
