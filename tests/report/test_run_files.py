from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.evaluation.history import HistoryRow, append_row
from enerf_ns.method.checkpoints import checkpoint_path
from enerf_ns.method.runs import Run
from enerf_ns.report import run_files
from enerf_ns.report.run_files import find_runs, read_run, run_names

CopyRun = Callable[..., Path]


@pytest.fixture
def copy_run(run: Run, tmp_path: Path) -> CopyRun:
    """Copies the run, of 2 steps; its config with changes, its checkpoint as of a number of steps, or left out."""

    def copy(name: str, stored: int = 2, **changes: object) -> Path:
        folder = tmp_path / name
        shutil.copytree(run.config_file.parent, folder)
        config = yaml.load(run.config_file.read_text(), Loader=yaml.Loader)
        for attribute, value in changes.items():
            assert hasattr(config, attribute)
            setattr(config, attribute, value)
        (folder / "config.yml").write_text(yaml.dump(config))
        checkpoints = folder / "nerfstudio_models"
        (checkpoint,) = checkpoints.iterdir()
        if stored:
            checkpoint.rename(checkpoint_path(checkpoints, stored - 1))
        else:
            shutil.rmtree(checkpoints)
        return folder

    return copy


def age(folder: Path) -> None:
    """As if training had written its files long ago."""
    then = time.time() - 2 * run_files.RECENT_SECONDS
    for file in folder.rglob("*"):
        os.utime(file, (then, then))


@pytest.mark.parametrize(
    ("stored", "recorded", "final", "old", "state"),
    [
        (0, 0, False, False, "still going, 0 of 5,000 steps"),
        (0, 0, False, True, "crashed or killed after 0 of 5,000 steps, of which none is stored"),
        (0, 70, False, True, "crashed or killed after 70 of 5,000 steps, of which none is stored"),
        (1001, 1001, False, False, "still going, 1,001 of 5,000 steps"),  # a checkpoint that is due, after step 1000
        (1001, 1600, False, False, "still going, 1,600 of 5,000 steps"),
        (1001, 1600, False, True, "crashed or killed after 1,600 of 5,000 steps, of which the first 1,001 are stored"),
        (1234, 1200, False, False, "stopped after 1,234 of 5,000 steps"),  # none is due then
        (1234, 1200, False, True, "stopped after 1,234 of 5,000 steps"),
        (1234, 1600, False, False, "still going, 1,600 of 5,000 steps"),  # it goes on after it was stopped
        (5000, 4000, False, True, "done"),
        (0, 5000, True, True, "done"),
    ],
)
def test_the_state_of_a_run(copy_run: CopyRun, stored: int, recorded: int, final: bool, old: bool, state: str):
    folder = copy_run("run", stored, max_num_iterations=5000, steps_per_save=1000)
    if recorded:
        append_row(folder, HistoryRow(recorded, 1.0, final=final))
    (folder / "report.html").write_text("a report is no sign of training")
    if old:
        age(folder)
        (folder / "report.html").touch()
    read = read_run(folder)
    assert (read.state, read.stored, read.steps) == (state, stored, max(stored, recorded))
    assert read.notes == () and read_run(folder / "config.yml") == read


def test_a_run_whose_last_line_or_checkpoint_is_half_written_is_what_it_was_before(copy_run: CopyRun):
    folder = copy_run("run", max_num_iterations=5000)
    append_row(folder, HistoryRow(1, 0.5, scores={"psnr": 10.0}))
    with (folder / "history.jsonl").open("a") as file:
        file.write('{"step": 2, "sec')
    content = (checkpoint := next((folder / "nerfstudio_models").iterdir())).read_bytes()
    checkpoint_path(folder / "nerfstudio_models", 3).write_bytes(content[: len(content) // 2])
    read = read_run(folder)
    assert [row.step for row in read.history] == [1]
    assert read.stored == 2 and checkpoint.name.endswith("1.ckpt")


def test_seconds_are_those_of_the_files_as_they_were_read(copy_run: CopyRun):
    """Though training stores a newer checkpoint then. In proportion between two rows, and behind the last one."""
    folder = copy_run("run", 11, max_num_iterations=5000)
    for row in (HistoryRow(2, 1.0), HistoryRow(6, 3.0)):
        append_row(folder, row)
    (checkpoint,) = (folder / "nerfstudio_models").iterdir()
    state = torch.load(checkpoint)
    state["error_against_time"]["seconds"] = 13.0
    torch.save(state, checkpoint)
    read = read_run(folder)
    state["error_against_time"]["seconds"] = 99.0
    torch.save(state, checkpoint_path(checkpoint.parent, 20))
    checkpoint.unlink()
    assert [read.seconds_at(step) for step in (2, 4, 6, 7, 11)] == [1.0, 2.0, 3.0, 5.0, 13.0]


def test_a_config_alone_is_a_run_of_no_step(copy_run: CopyRun, tmp_path: Path):
    shutil.copy(copy_run("run") / "config.yml", tmp_path / "other.yml")
    assert read_run(tmp_path / "other.yml").state == "still going, 0 of 2 steps"


def test_a_history_that_cannot_be_read_is_one_sentence(copy_run: CopyRun):
    folder = copy_run("run")
    (folder / "history.jsonl").mkdir()
    with pytest.raises(RecordingError, match=r"^\S+history\.jsonl is a folder; the history of a run was expected"):
        read_run(folder)


def test_runs_are_found_in_a_folder_and_below_it_in_order(tmp_path: Path):
    folders = [tmp_path / name for name in ("b/enerf/2026-01-02", "a/enerf/2026-01-01", "b/enerf-robust/2026-01-01")]
    for folder in folders:
        (folder / "nerfstudio_models").mkdir(parents=True)
        (folder / "config.yml").touch()
    assert find_runs(tmp_path) == sorted(folders)
    assert find_runs(tmp_path / "b") == sorted([folders[0], folders[2]])
    assert find_runs(folders[0]) == [folders[0]]
    for alone in (folders[0] / "config.yml", folders[0] / "nerfstudio_models", tmp_path / "nothing"):
        assert find_runs(alone) == [alone]


def test_what_is_no_run_is_one_sentence(tmp_path: Path, copy_run: CopyRun):
    with pytest.raises(
        RecordingError, match=r"^\S+ holds no config\.yml; give the folder of a run, of several, or a config\.yml\.$"
    ):
        read_run(tmp_path)
    with pytest.raises(RecordingError, match=r"^\S+nothing does not exist; give"):
        read_run(tmp_path / "nothing")
    for content, words in (
        (b"", "is not the config.yml of a run"),
        (b"a: 1", "is not the config.yml of a run"),
        (b"\xff\x00", "cannot be read as the config.yml of a run"),
        (b"!!python/object:nowhere.Nothing {}", r"names what is not installed \(cannot find module 'nowhere'"),
    ):
        (tmp_path / "config.yml").write_bytes(content)
        with pytest.raises(RecordingError, match=words) as caught:
            read_run(tmp_path)
        assert str(caught.value).count("\n") == 0


def test_a_run_of_another_method_is_one_sentence(tmp_path: Path):
    from nerfstudio.configs.method_configs import all_methods

    (tmp_path / "config.yml").write_text(yaml.dump(all_methods["nerfacto"]))
    with pytest.raises(RecordingError, match=r"is a run of the method nerfacto; give the folder of a run of enerf\.$"):
        read_run(tmp_path)


def test_names_say_no_more_than_tells_runs_apart(copy_run: CopyRun):
    def named(*changes: dict[str, str]) -> list[str]:
        named.count = getattr(named, "count", 0) + 1
        return run_names([read_run(copy_run(f"{named.count}-{n}", **change)) for n, change in enumerate(changes)])

    a, b = {"experiment_name": "a", "timestamp": "t"}, {"experiment_name": "b", "timestamp": "t"}
    assert named(a) == ["a"]
    assert named(a, b) == ["a", "b"]
    assert named(a, a | {"timestamp": "u"}) == ["a/t", "a/u"]
    assert named(a, a | {"method_name": "other"}) == ["a/enerf", "a/other"]
    assert named(a, b, a | {"method_name": "other"}, a | {"timestamp": "u"}) == [
        "a/enerf/t", "b/enerf/t", "a/other/t", "a/enerf/u",
    ]  # fmt: skip
    assert all(Path(name).is_dir() for name in named(a, a))
