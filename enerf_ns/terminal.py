"""Output of training on a terminal or in a log file."""

from __future__ import annotations

import shutil
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import rich
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import RenderableType
from rich.control import Control
from rich.panel import Panel
from rich.segment import ControlType
from rich.text import Text

from enerf_ns.dataparsers.recording.errors import printable

REWRITTEN_EVERY, PRINTED_EVERY = 0.25, 30.0
"""Seconds between two updates of the status line, on a terminal and elsewhere."""


class StatusLine:
    """A line that is rewritten in place on a terminal, and printed every 30 s elsewhere."""

    def __init__(self) -> None:
        self._next = 0.0

    @property
    def is_due(self) -> bool:
        """Whether it is time to update the line."""
        return time.monotonic() >= self._next

    def show(self, text: str) -> None:
        """Shows the line. On a terminal, the next output replaces it."""
        clear_line()
        if CONSOLE.is_terminal:
            width = shutil.get_terminal_size().columns - 1
            CONSOLE.print(text[:width], end="\r", soft_wrap=True, markup=False, highlight=False)
        else:
            CONSOLE.print(text, soft_wrap=True, markup=False, highlight=False)
        self._next = time.monotonic() + (REWRITTEN_EVERY if CONSOLE.is_terminal else PRINTED_EVERY)


def clear_line() -> None:
    """Removes the status line from the terminal, before other output."""
    CONSOLE.control(Control((ControlType.ERASE_IN_LINE, 2)))


def say(sentence: str) -> None:
    """Prints a sentence to the user, in yellow."""
    clear_line()
    CONSOLE.print(Text(printable(sentence), "yellow"), soft_wrap=True)


def columns() -> int:
    """Width of what is printed: that of the terminal, of 80 columns for a file, and at most that of `CONSOLE`."""
    return min(shutil.get_terminal_size().columns, CONSOLE.width)


def say_table(table: RenderableType) -> None:
    """Prints a table or a rule in the width of the terminal."""
    CONSOLE.print(table, width=columns())


def say_plainly(text: str) -> None:
    """Prints sentences in the width of the terminal. No word is broken, so that flags can be copied."""
    lines = textwrap.wrap(printable(text), columns(), break_long_words=False, break_on_hyphens=False)
    CONSOLE.print(Text("\n".join(lines)), soft_wrap=True)


def say_where(what: str, where: str) -> None:
    """Prints a path or a command on one line of any length, so that it can be copied. Its paths must be `quoted`."""
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
"""Beginnings of lines of Nerfstudio that do not help the user, or that fail on paths with brackets."""

BOXES = ("Training Finished", "viser")
"""Titles of boxes of Nerfstudio and viser."""


@contextmanager
def without_chatter() -> Iterator[None]:
    """Suppresses `CHATTER`, and `BOXES`, which hold what our output has, too."""

    def without(say: Callable[..., None]) -> Callable[..., None]:
        def said(*objects: Any, **options: Any) -> None:
            first = objects[0] if objects else None
            is_box = isinstance(first, Panel) and any(title in str(first.title) for title in BOXES)
            if not is_box and not (isinstance(first, str) and first.startswith(CHATTER)):
                say(*objects, **options)

        return said

    with ExitStack() as patches:
        for owner, name in ((CONSOLE, "print"), (CONSOLE, "log"), (rich, "print")):
            patches.enter_context(patch.object(owner, name, without(getattr(owner, name))))
        yield


def duration(seconds: float) -> str:
    """A duration in words, in its two largest units."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
