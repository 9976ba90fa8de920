"""What goes wrong by no fault of the program: an input, a flag, or the place where results are to go.

Every message is one sentence: which file or flag, what was found, what was expected, what to do. The command line shows
it alone, without a traceback.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
        SystemExit: In place of a `UserError`, of an OSError by which the system refuses a file or a folder, and of an
            error about a name that cannot be written as text. Its sentence is on one line, whatever a name in it holds.
            In place of a KeyboardInterrupt, with code 130.
    """
    try:
        yield
    except UserError as error:
        raise SystemExit(f"enerf: {printable(str(error))}") from error
    except OSError as error:
        if error.errno is None:
            raise
        what = "A file" if error.filename is None else os.fsdecode(error.filename)
        sentence = f"{what} could not be read or written ({error.strerror}); check the path, and who may use it."
        raise SystemExit(f"enerf: {printable(sentence)}") from error
    except UnicodeEncodeError as error:
        found = error.object[max(0, error.start - 40) : error.end + 40]
        sentence = f"A name holds bytes that are not UTF-8, near {found}; rename it."
        raise SystemExit(f"enerf: {printable(sentence)}") from error
    except KeyboardInterrupt as error:
        print("enerf: Stopped.", file=sys.stderr)
        raise SystemExit(130) from error


def quoted(path: Path) -> str:
    """A path as bash takes it for one word, on one line."""
    text = str(path)
    if text.isprintable():
        return shlex.quote(text)
    letters = {"\\": r"\\", "'": r"\'"}
    for letter in text:
        if not letter.isprintable():
            letters[letter] = "".join(f"\\x{byte:02x}" for byte in os.fsencode(letter))
    return "$'" + "".join(letters.get(letter, letter) for letter in text) + "'"


def printable(text: str) -> str:
    """A text on one line, in which whatever ends lines, moves a terminal's cursor or is no UTF-8 is escaped."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode() for letter in text
    )
