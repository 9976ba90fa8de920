"""Starts commands in processes that are forked from a program that has imported all that they need."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

PROGRAM = Path(__file__).with_name("forked_commands.py")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "NUMBA_THREADING_LAYER": "workqueue"}


@dataclass
class Started:
    """A command that is running."""

    commands: WarmCommands
    number: int
    printed: Path

    def running(self) -> bool:
        """Whether it has not ended yet."""
        return not self.commands.has_answer()

    def kill(self) -> None:
        """Ends it at once."""
        os.kill(self.number, signal.SIGKILL)

    def wait(self) -> tuple[int, str]:
        """The exit code, and what it has printed to both of its outputs."""
        code = int(self.commands.answer())
        return code, self.printed.read_text(errors="replace")


class WarmCommands:
    """Commands of enerf, ns-train, ns-eval, ns-render and python -c, one after another, each in a process of its own.

    A process of its own that imports everything anew takes ten seconds of CPU. What a command does while it is imported
    is tested elsewhere.

    Args:
        folder: What the commands print is written into it.
    """

    def __init__(self, folder: Path):
        self._folder, self._started = folder, 0
        self._program: subprocess.Popen[str] | None = None

    def start(
        self,
        *command: object,
        cwd: Path | None = None,
        environment: Mapping[str, str] | None = None,
        limit: int = 60,
        bound: bool = False,
        memory: int | None = None,
    ) -> Started:
        """Starts a command, which is killed after some seconds.

        Args:
            command: The program, and its arguments.
            cwd: Its working directory; that of the caller unless given.
            environment: That of the caller unless given.
            limit: Seconds.
            bound: Whether permissions of files bind it where it is root, too, which needs Linux.
            memory: Bytes that it may use beside those of what is imported, which needs Linux. Default: any number.
        """
        program, *arguments = map(str, command)
        printed = self._folder / str(self._started)
        self._started += 1
        told = {
            "program": program,
            "arguments": arguments,
            "folder": str(cwd or Path.cwd()),
            "limit": limit,
            "bound": bound,
            "memory": memory,
        }
        told |= {"environment": {**(environment or os.environ), **ONE_THREAD}, "output": str(printed)}
        if self._program is None:
            self._program = subprocess.Popen(
                [sys.executable, PROGRAM],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, **ONE_THREAD},
            )
        assert self._program.stdin is not None
        self._program.stdin.write(json.dumps(told) + "\n")
        self._program.stdin.flush()
        return Started(self, int(self.answer()), printed)

    def run(self, *command: object, **options: object) -> tuple[int, str]:
        """The exit code of a command, and what it printed; as `start` and `wait`."""
        return self.start(*command, **options).wait()  # type: ignore[arg-type]

    def answer(self) -> str:
        """The next line of the program."""
        assert self._program is not None and self._program.stdout is not None
        return self._program.stdout.readline()

    def has_answer(self) -> bool:
        """Whether the program has written a line that was not read."""
        assert self._program is not None and self._program.stdout is not None
        return bool(select.select([self._program.stdout], [], [], 0.0)[0])

    def close(self) -> None:
        """Ends the program."""
        if self._program is not None:
            self._program.communicate()
