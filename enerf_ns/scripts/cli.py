"""The `enerf` command. It imports only the module of the command that is called."""

from __future__ import annotations

import io
import os
import re
import shlex
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from itertools import takewhile
from typing import Any

from enerf_ns import __version__
from enerf_ns.dataparsers.recording.errors import exit_with_a_sentence, printable
from enerf_ns.flags import about_unknown, close, shorten_help, spelt
from enerf_ns.quiet import silence_known_warnings

COMMANDS = {
    "bench": ("Bench", "train and score the rows of a table, such as those of the paper"),
    "check-numerics": ("CheckNumerics", "check the numerical errors of extreme cases"),
    "convert": ("Convert", "write a recording or an event file in the format of this package"),
    "demo": ("Demo", "simulate, train, and report with a video, in some minutes"),
    "export": ("Export", "write a mesh, points, splats or the refined poses of a run"),
    "fetch-lpips": ("FetchLpips", "download the weights that the score LPIPS needs"),
    "inspect": ("Inspect", "check a recording before training on it"),
    "reconstruct": ("Reconstruct", "reconstruct frames from the events of a recording"),
    "report": ("Report", "show scores, error against time, pictures and videos of runs"),
    "score": ("Score", "score the renders of any method against held-out frames"),
    "simulate": ("Simulate", "simulate the events of a scene, a mesh, a video or a trained run"),
}
"""Class and one-line help of each command. The module has the name of the command."""


def entrypoint() -> None:
    """Runs the command line.

    A mistake of the user ends it with one sentence. It ends in silence when the reader of its output does, as `head`.
    """
    try:
        _enerf()
    except BrokenPipeError:
        raise SystemExit(141) from None  # as a shell says of SIGPIPE, which Windows does not know
    finally:
        try:
            sys.stdout.flush()
        except BrokenPipeError:  # Python would write it once more at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _enerf() -> None:
    silence_known_warnings()
    name, arguments = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else ("--help", [])
    if name in ("-h", "--help"):
        _print_help()
    elif name == "--version":
        print(f"enerf-ns {__version__}")
    elif name in COMMANDS:
        _run(name, arguments)
    else:
        near = close(name, COMMANDS)
        found = f"the nearest is {near}" if near else f"choose one of {', '.join(COMMANDS)}"
        print(printable(f"enerf: There is no command {name}; {found}."), file=sys.stderr)
        raise SystemExit(2)


def _print_help() -> None:
    print("usage: enerf [--help] [--version] COMMAND ...\n\nRadiance fields from event cameras.\n")
    for name, (_, what) in COMMANDS.items():
        print(f"  {name:16}{what}")
    print("\nenerf COMMAND --help lists the flags of a command. ns-train enerf trains.")


def _imported(name: str) -> type:
    """The class of a command.

    SIGINT, unless it is ignored, ends the program during the import, because some libraries turn a KeyboardInterrupt
    into other errors while they are imported.
    """
    heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        signal.signal(signal.SIGINT, _stop)
    try:
        return getattr(import_module(f"enerf_ns.scripts.{name.replace('-', '_')}"), COMMANDS[name][0])
    finally:
        if heeded:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _stop(*_: object) -> None:
    os.write(2, b"enerf: Stopped.\n")
    os._exit(130)


def _run(name: str, arguments: list[str]) -> None:
    try:
        with exit_with_a_sentence():
            _parsed(_imported(name), name, arguments).main()
    except MemoryError as error:
        asked = printable(shlex.join(["enerf", name, *arguments]))
        raise SystemExit(f"enerf: There is not enough memory for {asked}; ask for less at a time.") from error


def _parsed(command: type, name: str, arguments: list[str]) -> Any:
    """The command with the flags of the user.

    Raises:
        SystemExit: The flags are wrong. One sentence names the nearest flag to one that does not exist.
    """
    import tyro  # here, since SIGINT ends an import with a traceback

    shorten_help()
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(command, prog=f"enerf {name}", args=arguments)
    except SystemExit as end:
        text = said.getvalue()
        if end.code == 2:
            before = list(takewhile(lambda word: not word.startswith("-"), arguments))
            shown = io.StringIO()
            with redirect_stdout(shown), redirect_stderr(shown), suppress(SystemExit):
                tyro.cli(command, prog=f"enerf {name}", args=[*before, "--help"])
            known = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*", shown.getvalue()))
            unknown = [word for word in arguments if word.startswith("--") and spelt(word) not in known]
            if known and unknown:
                text = printable(about_unknown(unknown[0], known, f"enerf {name}")) + "\n"
        sys.stderr.write(text)
        raise
