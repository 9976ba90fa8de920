"""The program of `WarmCommands`: it forks processes of commands, and has imported all that they import.

Each line that it reads is a command as JSON: `program` (of `MAIN`), `arguments`, `folder`, `environment`, `output` (the
file that it prints into), `limit` (seconds, after which it is killed), `bound` (whether permissions of files bind it
where it is root, too) and `memory` (bytes that it may use beside those of what is imported). It answers each with two
lines, the number of its process and its exit code. A process ends as Python would end it, but does not take all modules
apart, which takes seconds.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import json
import os
import resource
import signal
import sys
import traceback
from importlib import import_module
from pathlib import Path

from nerfstudio.scripts import eval, render, train

from enerf_ns.scripts import cli

MAIN = {
    "enerf": cli.entrypoint,
    "ns-train": train.entrypoint,
    "ns-eval": eval.entrypoint,
    "ns-render": render.entrypoint,
    "python": lambda: exec(sys.argv[2], {}),
}
"""The programs; of Python, that with the option -c."""


OVERRIDES = 0b110
"""The capabilities of Linux by which root reads and writes what permissions forbid: CAP_DAC_OVERRIDE and
CAP_DAC_READ_SEARCH."""


def bind_to_permissions() -> None:
    """Lets this process do no more than permissions allow, as that of any user."""
    libc, header, sets = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(0x20080522), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, sets) == 0
    sets[0] &= ~OVERRIDES  # of the effective ones
    assert libc.capset(header, sets) == 0


def bind_to_memory(size: int) -> None:
    """Lets this process use no more than this number of bytes beside what it uses already."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + size, resource.RLIM_INFINITY))


def forked() -> dict:
    """The next command, in the process that is to run it; ends where there is none."""
    for line in sys.stdin:
        command = json.loads(line)
        number = os.fork()
        if not number:
            return command
        print(number, flush=True)
        signal.signal(signal.SIGALRM, lambda *_: os.kill(number, signal.SIGKILL))  # noqa: B023
        signal.alarm(command["limit"])
        code = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
        signal.alarm(0)
        print(code, flush=True)
    sys.exit()


if __name__ == "__main__":
    for name in cli.COMMANDS:
        import_module(f"enerf_ns.scripts.{name.replace('-', '_')}")
    gc.freeze()
    command = forked()
    output = os.open(command["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(command["folder"])
    if command["bound"]:
        bind_to_permissions()
    if command["memory"] is not None:
        bind_to_memory(command["memory"])
    os.environ.clear()
    os.environ.update(command["environment"])
    sys.argv = [command["program"], *command["arguments"]]
    code = 0
    try:
        MAIN[command["program"]]()
    except SystemExit as end:
        code = 0 if end.code is None else end.code if isinstance(end.code, int) else 1
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()
    sys.stdout.flush()
    os._exit(code)
