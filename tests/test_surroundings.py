"""Training where the terminal, the locale, the permissions and the files around it are not the usual ones."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import set_up, small_config
from warm_commands import WarmCommands

from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.indexing import index_events

TRAIN = """
import locale, os, sys
os.umask({umask})
locale.setlocale(locale.LC_ALL, {locale!r})
print("numbers as", locale.str(1.5))
from enerf_ns.scripts import cli
from nerfstudio.scripts.train import entrypoint
sys.argv = ["enerf", "inspect", "recording"]
cli.entrypoint()
sys.argv = ["ns-train", "enerf", "--data", "recording", "--max-num-iterations", "2", "--vis", "tensorboard"]
sys.argv += ["--pipeline.datamanager.event-pairs", "64", "--pipeline.model.log2-table-size", "12"]
entrypoint()
"""


def in_surroundings(
    commands: WarmCommands, recording: Path, folder: Path, umask: int = 0o22, locale: str = "C", **environment: str
) -> str:
    """What `enerf inspect` and two steps of `ns-train` print."""
    (folder / "recording").symlink_to(recording)
    code, printed = commands.run(
        *("python", "-c", TRAIN.format(umask=umask, locale=locale)),
        cwd=folder,
        environment={**os.environ, **environment},
        limit=200,
    )
    assert code == 0 and "Traceback" not in printed, printed
    assert "Pictures are in" in printed and "step 2 of 2" in printed
    return printed


@pytest.mark.slow
@pytest.mark.parametrize("columns", ["20", "many"])
def test_terminals_of_any_kind(recording: Path, tmp_path: Path, warm_commands: WarmCommands, columns: str):
    told = in_surroundings(warm_commands, recording, tmp_path, TERM="dumb", COLUMNS=columns)
    assert "\x1b" not in told
    (config,) = tmp_path.glob("outputs/*/enerf/*/config.yml")
    assert f"configuration: {config}" in told, "what is to be copied is on one line"


@pytest.mark.slow
def test_what_is_written_is_private_with_a_umask(recording: Path, tmp_path: Path, warm_commands: WarmCommands):
    in_surroundings(warm_commands, recording, tmp_path, umask=0o77)
    written = [path for path in tmp_path.rglob("*") if not path.is_symlink()]
    assert len(written) > 10 and not any(path.stat().st_mode & 0o77 for path in written)


@pytest.mark.slow
def test_decimal_commas_of_the_locale_change_no_number(recording: Path, tmp_path: Path, warm_commands: WarmCommands):
    made = shutil.which("localedef") and subprocess.run(
        ["localedef", "-i", "de_DE", "-f", "UTF-8", tmp_path / "de_DE.UTF-8"], capture_output=True
    )
    if not made or made.returncode:
        pytest.skip("no locale with decimal commas can be made here")
    told = []
    for name, locale in {"usual": "C", "commas": "de_DE.UTF-8"}.items():
        (tmp_path / name).mkdir()
        environment: dict[str, Any] = {"LOCPATH": str(tmp_path), "ENERF_CACHE": str(tmp_path / "cache")}
        told.append(in_surroundings(warm_commands, recording, tmp_path / name, locale=locale, **environment))
        shutil.rmtree(tmp_path / name / "recording", ignore_errors=True)
    usual, commas = ([line for line in text.splitlines() if line.startswith("step 2 of 2")] for text in told)
    assert "numbers as 1,5" in told[1] and usual == commas


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps files that are open")
@pytest.mark.parametrize("changed", ["removed", "overwritten"])
def test_a_recording_and_a_cache_that_are_lost_during_training_cost_the_scores_alone(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], changed: str
):
    """What is trained on is read at the first step, or is in files that stay open; held-out frames are read when
    they are scored."""
    monkeypatch.setattr(index_cache, "CACHED_FROM", 1)
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "cache"))
    losses = []
    for name in ("left alone", changed):
        index_events.cache_clear()
        own = shutil.copytree(recording, tmp_path / name / "recording")
        trainer: Any = set_up(small_config(own, tmp_path / name / "outputs", data__supervision="events+frames"))
        draw = trainer.pipeline.datamanager.next_batch

        def drawn(sensor: Any) -> Any:
            batch = draw(sensor)  # noqa: B023
            if name == "removed":  # noqa: B023
                shutil.rmtree(own, ignore_errors=True)  # noqa: B023
                shutil.rmtree(tmp_path / "cache", ignore_errors=True)
            elif name == "overwritten":  # noqa: B023
                for file in own.glob("*/*"):  # noqa: B023
                    file.write_bytes(b"another")
            return batch

        trainer.pipeline.datamanager.next_batch = drawn
        trainer.train()
        (checkpoint,) = trainer.checkpoint_dir.iterdir()
        assert ("goes on without evaluation" in capsys.readouterr().out) == (name == changed)
        state = torch.load(checkpoint)["pipeline"]
        losses.append(np.concatenate([value.numpy().ravel() for value in state.values() if value.is_floating_point()]))
    np.testing.assert_array_equal(*losses)
