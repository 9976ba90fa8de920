from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import enerf_ns
from enerf_ns.method.origin import code_version, origin


def test_the_version_names_the_commit():
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    if head.returncode:
        assert code_version() == enerf_ns.__version__
    else:
        version, _, commit = code_version().partition("+")
        assert version == enerf_ns.__version__ and head.stdout.startswith(commit.removesuffix("-dirty"))


def test_the_command_can_be_pasted_and_the_machine_is_named(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/ns-train", "enerf", "--data", "my recording; rm"])
    found = origin()
    assert json.loads(json.dumps(found)) == found and set(found) == {"command", "version", "date", "machine"}
    assert shlex.split(found["command"]) == ["ns-train", "enerf", "--data", "my recording; rm"]
    assert f"enerf-ns {enerf_ns.__version__}" in found["version"] and f"{os.cpu_count()} cores" in found["machine"]
