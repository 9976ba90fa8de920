"""What training says on the terminal, or in what stands for one."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from nerfstudio.utils.rich_utils import CONSOLE
from rich.control import Control
from rich.panel import Panel
from rich.segment import ControlType
from rich.text import Text

from enerf_ns.dataparsers.recording.errors import printable

REWRITTEN_EVERY, PRINTED_EVERY = 0.25, 30.0
"""Seconds between two states of the line on a terminal, and where lines cannot be rewritten."""


class StatusLine:
    """One line that is rewritten in place; where the output is no terminal, it is printed now and then."""

    def __init__(self) -> None:
        self._next = 0.0

    @property
    def is_due(self) -> bool:
        """Whether the line is to be shown anew."""
        return time.monotonic() >= self._next

    def show(self, text: str) -> None:
        """Shows the line; what is printed next takes its place on a terminal."""
        clear_line()
        if CONSOLE.is_terminal:
            width = shutil.get_terminal_size().columns - 1
            CONSOLE.print(text[:width], end="\r", soft_wrap=True, markup=False, highlight=False)
        else:
            CONSOLE.print(text, soft_wrap=True, markup=False, highlight=False)
        self._next = time.monotonic() + (REWRITTEN_EVERY if CONSOLE.is_terminal else PRINTED_EVERY)


def clear_line() -> None:
    """Removes what the line shows, before anything else is printed."""
    CONSOLE.control(Control((ControlType.ERASE_IN_LINE, 2)))


def say(sentence: str) -> None:
    """Prints what a person should know, in yellow."""
    clear_line()
    CONSOLE.print(Text(printable(sentence), "yellow"), soft_wrap=True)


def say_where(what: str, where: str) -> None:
    """Prints a place, or a command, on one line, however long it is, so that it can be copied; with paths `quoted`."""
    CONSOLE.print(Text.assemble((f"{what}:", "bold"), f" {where}"), soft_wrap=True)


CHATTER = (
    "Mixed precision is disabled",
    "Saving checkpoints to",
    "[bold yellow]logging events to",
    "Loading latest checkpoint from load_dir",
    ":white_check_mark: Done loading checkpoint from",
    "Done loading Nerfstudio checkpoint from",
    "No Nerfstudio checkpoint to load",
    "[bold yellow]Disabled comet",
    "disabled local writer",
    "[NOTE] Not running eval iterations since",
)
"""How lines of Nerfstudio begin that tell a person nothing, or a path in which brackets are taken for colours."""


@contextmanager
def without_chatter() -> Iterator[None]:
    """Leaves out, in the block, `CHATTER` and the box by which Nerfstudio ends a training, whose paths ours tells."""

    def without(say: Callable[..., None]) -> Callable[..., None]:
        def said(*objects: Any, **options: Any) -> None:
            first = objects[0] if objects else None
            ends = isinstance(first, Panel) and "Training Finished" in str(first.title)
            if not ends and not (isinstance(first, str) and first.startswith(CHATTER)):
                say(*objects, **options)

        return said

    with patch.object(CONSOLE, "print", without(CONSOLE.print)), patch.object(CONSOLE, "log", without(CONSOLE.log)):
        yield


def duration(seconds: float) -> str:
    """A time as a person says it, in its two largest units."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
