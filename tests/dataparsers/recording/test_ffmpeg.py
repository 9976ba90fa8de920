from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

CALL = (
    "import os, shutil, sys; from enerf_ns.dataparsers.recording.ffmpeg import make_ffmpeg_available; "
    "make_ffmpeg_available();"
    "print(shutil.which('ffmpeg'), 'imageio_ffmpeg' in sys.modules)"
)

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="looks at links")


def ffmpeg_and_whether_imageio_was_imported(path: Path | None, cache: Path) -> tuple[str, str]:
    """What a fresh process finds after the call, with this folder (or none) on its PATH."""
    environment = {**os.environ, "PATH": str(path or ""), "XDG_CACHE_HOME": str(cache)}
    run = subprocess.run([sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, check=True)
    ffmpeg, imported = run.stdout.split()
    return ffmpeg, imported


def test_processes_that_start_together_all_get_a_program_that_runs(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: ffmpeg_and_whether_imageio_was_imported(None, tmp_path), range(4)))
    assert {ffmpeg for ffmpeg, _ in found} == {str(tmp_path / "enerf-ns" / "bin" / "ffmpeg")}
    assert "ffmpeg version" in subprocess.run([found[0][0], "-version"], capture_output=True, text=True).stdout
    assert os.listdir(tmp_path / "enerf-ns" / "bin") == ["ffmpeg"]
    assert ffmpeg_and_whether_imageio_was_imported(None, tmp_path) == (found[0][0], "False")


def test_the_ffmpeg_of_the_machine_comes_first(tmp_path):
    own = tmp_path / "ffmpeg"
    own.write_text("#!/bin/sh\n")
    own.chmod(0o755)
    assert ffmpeg_and_whether_imageio_was_imported(tmp_path, tmp_path / "cache") == (str(own), "False")
    assert not (tmp_path / "cache").exists()


def test_a_link_to_an_environment_that_is_gone_is_renewed(tmp_path):
    link = tmp_path / "enerf-ns" / "bin" / "ffmpeg"
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "gone")
    assert ffmpeg_and_whether_imageio_was_imported(None, tmp_path) == (str(link), "True")


def test_a_cache_folder_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "file").touch()
    assert ffmpeg_and_whether_imageio_was_imported(None, tmp_path / "file") == ("None", "True")
