"""Half precision where it does no harm: mixed precision is torch.autocast's, and this is what is kept out of it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

HALF = (torch.float16, torch.bfloat16)
"""Types of half precision."""


def full_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Keeps a function out of torch.autocast, and gives it float32 for every tensor in half precision that it is given.

    In half precision a change of log brightness of 0.001 has an error of 0.03 (bfloat16) or 0.004 (float16).
    """

    @functools.wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(
                *[_widened(value) for value in args], **{name: _widened(value) for name, value in kwargs.items()}
            )  # type: ignore[arg-type]

    return run


def _widened(value: object) -> object:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value
