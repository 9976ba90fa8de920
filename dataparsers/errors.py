"""What goes wrong by no fault of the program: an input, a flag, or the place where results are to go.

Every message is one sentence: which file or flag, what was found, what was expected, what to do. The command line shows
it alone, without a traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class UserError(Exception):
    """Something that the user can mend."""


class RecordingError(UserError, ValueError):
    """Input that cannot be used: a recording, a scene, a video, a trained run."""


class FlagError(UserError, ValueError):
    """A flag or setting that is out of its range, contradicts another, or changes nothing."""


class OutputError(UserError):
    """Results cannot be written: the disk is full, or the place exists already or must not be written to."""


@contextmanager
def exit_with_a_sentence() -> Iterator[None]:
    """Ends the program, where the block ends with something that the user can mend, with a sentence that says it.

    Raises:
        SystemExit: In place of a `UserError`.
    """
    try:
        yield
    except UserError as error:
        raise SystemExit(f"enerf: {error}") from error
