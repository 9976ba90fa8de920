"""Errors that the user can correct: in an input, in a flag, or at the place of results.

Every message is one sentence: which file or flag, what was found, what was expected, what to do. The command line shows
only this sentence, without a traceback.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST_SHOWN = 60
"""Most letters of a value in a file that an error shows."""


class UserError(Exception):
    """An error that the user can correct."""


class RecordingError(UserError, ValueError):
    """An input that cannot be used: a recording, a scene, a video, a trained run."""


class FlagError(UserError, ValueError):
    """A flag or setting that is out of its range, contradicts another, or changes nothing."""


class OutputError(UserError):
    """Results that cannot be written: the disk is full, or the place exists already or is protected."""


@contextmanager
def exit_with_a_sentence() -> Iterator[None]:
    """Ends the program with one sentence if the block raises an error that the user can correct.

    Raises:
        SystemExit: Replaces a `UserError`, an OSError about a file or folder, and an error about a name that is not
            text. The sentence is on one line, whatever a name in it holds. Replaces a KeyboardInterrupt, with code 130.
        BrokenPipeError: The reader of the output has gone.
    """
    try:
        yield
    except UserError as error:
        raise SystemExit(f"enerf: {printable(str(error))}") from error
    except BrokenPipeError:
        raise
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
    """Returns a path on one line, quoted as one word for bash."""
    text = str(path)
    if text.isprintable():
        return shlex.quote(text)
    letters = {"\\": r"\\", "'": r"\'"}
    for letter in text:
        if not letter.isprintable():
            letters[letter] = "".join(f"\\x{byte:02x}" for byte in os.fsencode(letter))
    return "$'" + "".join(letters.get(letter, letter) for letter in text) + "'"


def shortened(text: str) -> str:
    """Returns the start of a text, at most `LONGEST_SHOWN` letters of it."""
    return text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 3] + "..."


def printable(text: str) -> str:
    """Returns a text on one line, with line ends, control characters and invalid UTF-8 escaped."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode() for letter in text
    )
