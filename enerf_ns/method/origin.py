"""Origin of a run: the command, version, date and machine of its training, kept in origin.json."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import torch

import enerf_ns

ORIGIN_FILE = "origin.json"
"""Name of the file in the folder of a run."""


def origin() -> dict[str, str]:
    """The command of this process, version, date and machine, as `ORIGIN_FILE` holds them."""
    program, *flags = sys.argv
    versions = f"enerf-ns {code_version()}, PyTorch {torch.__version__}, Python {platform.python_version()}"
    machine = f"{processor()}, {os.cpu_count()} cores, {platform.system()}"
    if torch.cuda.is_available():
        machine = f"{device_name()}, {machine}"
    return {
        "command": shlex.join([Path(program).name, *flags]),
        "version": versions,
        "date": datetime.now().astimezone().isoformat(" ", "minutes"),
        "machine": machine,
    }


def code_version() -> str:
    """Version of the package, with the commit if it runs from its repository, and -dirty if files were changed."""
    root = Path(enerf_ns.__file__).parents[1]

    def git(*arguments: str) -> str:
        asked = subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True)
        return asked.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root.resolve():
            return enerf_ns.__version__
        return f"{enerf_ns.__version__}+{git('describe', '--always', '--dirty', '--abbrev=10', '--exclude=*')}"
    except (OSError, subprocess.CalledProcessError):
        return enerf_ns.__version__


def device_name() -> str:
    """Name of the default training device."""
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"


def processor() -> str:
    """Name of the processor, or its architecture if the system does not state it."""
    with suppress(OSError):
        if found := re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1]
    return platform.processor() or platform.machine()
