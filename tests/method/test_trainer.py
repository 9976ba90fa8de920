"""What training shows and stores."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.utils.rich_utils import CONSOLE
from small_runs import set_up, small_config

from enerf_ns.choices.table import choices_text, recording_table
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.method import trainer as trainer_module
from enerf_ns.method.config import enerf


def test_config_and_choices_that_are_stored(recording: Path, tmp_path: Path, monkeypatch):
    """Choices are stored beside what was set, paths are absolute; what was stored loads and prints as it was."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(recording)
    config = small_config(Path("link"), Path("outputs"))
    config.save_config()
    run = tmp_path / "outputs/recording/enerf/run"
    loaded = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    assert loaded == loaded.resolved() == replace(config.resolved(), experiment_name="recording")
    assert loaded.pipeline.model.num_channels is None and loaded.pipeline.datamanager.dataparser.depth_range is None
    filled = loaded.pipeline.resolution.applied_to(loaded.pipeline)
    manager, model = filled.datamanager, filled.model
    for path in (loaded.data, manager.data, manager.dataparser.data):
        assert path == recording.resolve()
    assert loaded.output_dir == tmp_path / "outputs"
    simulated = json.loads((recording / "simulation.json").read_text())
    assert model.sensor.contrast_thresholds == tuple(simulated["contrast_thresholds"])
    assert manager.dataparser.depth_range == pytest.approx(simulated["depth_range"])
    assert model.num_channels == 1 and model.max_res > model.base_res and 0 < model.near_plane < 1
    choices = {choice["part"]: choice for choice in json.loads((run / "choices.json").read_text())}
    assert choices["event loss"]["kept"] and not choices["silent pixels"]["kept"] and not choices["frame loss"]["kept"]
    assert all(choice["why"] and choice["flag"] for choice in choices.values())
    lines = (run / "choices.txt").read_text().splitlines()
    assert all(len(line) <= 100 for line in lines), "none has a path here, which alone may be longer"
    for choice in choices.values():
        assert f"    {choice['flag']}" in lines, "a flag stands alone on its line, so that it can be copied"
        assert any(line.startswith(f"{choice['part']}, {'kept' if choice['kept'] else 'left out'}") for line in lines)


def test_all_ranks_train_with_what_config_yml_states_though_each_would_measure_something_else(
    recording: Path, tmp_path: Path, monkeypatch
):
    """Nerfstudio stores the config, and then hands it over to the process of each device."""
    factors = iter([2, 4, 8])
    monkeypatch.setattr(trainer_module, "batch_factor", lambda filled, device: next(factors))
    config = small_config(recording, tmp_path)
    data = config.pipeline.datamanager
    data.event_pairs = data.silent_pairs = data.train_num_rays_per_batch = None
    config.save_config()
    stored = yaml.load((tmp_path / "recording/enerf/run/config.yml").read_text(), Loader=yaml.Loader)
    for rank in (pickle.loads(pickle.dumps(config)), config, copy.deepcopy(config)):
        assert rank.resolved().pipeline.resolution == stored.pipeline.resolution
    pairs = stored.pipeline.resolution.values["datamanager.event_pairs"]
    config.machine.seed += 1
    changed = config.resolved().pipeline.resolution.values["datamanager.event_pairs"]
    assert changed == 2 * pairs, "what is asked for anew is resolved anew"


@pytest.mark.parametrize("name, message", [("cuda", "must be auto, torch, triton or numba"), ("numba", "on meta")])
def test_a_hash_grid_that_does_not_fit_the_device_is_refused(recording: Path, tmp_path: Path, name: str, message: str):
    config = small_config(recording, tmp_path)
    config.pipeline.model.hash_grid = name
    config.machine.device_type = "meta"  # type: ignore[assignment] - a device that is everywhere, and not the CPU
    with pytest.raises(FlagError, match=f"--pipeline.model.hash-grid.*{message}"):
        config.resolved()


def test_the_learning_rate_falls_to_a_tenth_at_the_last_step_however_long_the_run(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 7
    trainer = set_up(config)
    rates = []
    for step in range(8):
        rates.append(trainer.optimizers.optimizers["fields"].param_groups[0]["lr"])
        trainer.train_iteration(step)
    ratio = np.array(rates[1:]) / np.array(rates[:-1])
    np.testing.assert_allclose(ratio, 0.1 ** (1 / 7), rtol=1e-6)


def test_resuming_from_what_was_stored_prints_the_same_choices(recording: Path, tmp_path: Path, capsys):
    """What was chosen does not come to count as set by flag."""
    config = small_config(recording, tmp_path)
    config.verbose = True
    config.save_config()
    first = capsys.readouterr().out
    stored = tmp_path / "recording/enerf/run/config.yml"
    again = yaml.load(stored.read_text(), Loader=yaml.Loader)
    again.save_config()
    choices, again_choices = (
        text[text.index("The field learns from") : text.index("all choices")]
        for text in (first, capsys.readouterr().out)
    )
    assert again_choices == choices
    assert "because the recording" in choices and "measured" not in choices
    assert yaml.load(stored.read_text(), Loader=yaml.Loader) == again


def test_without_data_it_says_which_flag_is_missing(tmp_path: Path):
    config = copy.deepcopy(enerf.config)
    with pytest.raises(SystemExit, match=r"enerf: --data is missing"):
        config.save_config()


@pytest.mark.parametrize("place", ["data", "manager", "parser"])
def test_the_recording_may_be_named_in_any_place(recording: Path, tmp_path: Path, place: str):
    config = small_config(recording, tmp_path)
    config.data = recording if place == "data" else None
    config.pipeline.datamanager.data = recording if place == "manager" else None
    config.pipeline.datamanager.dataparser.data = recording if place == "parser" else Path()
    used = config.resolved()
    assert used.data == used.pipeline.datamanager.data == used.pipeline.datamanager.dataparser.data == recording


def test_the_tables_name_what_there_is(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path).resolved()
    with CONSOLE.capture() as captured:
        CONSOLE.print(recording_table(config.pipeline.datamanager.dataparser))
        CONSOLE.print(choices_text(config.pipeline.resolution.choices, 100))
    text = captured.get()
    for expected in ("32 x 24, pinhole", "11, 32 x 24, with depth", "blurred frames", "kept", "left out"):
        assert expected in text


@pytest.mark.parametrize(("end", "flag"), [(0.1, ""), (0.03, " --pose-source train")])
def test_the_video_along_the_cameras_is_along_more_than_one(
    recording: Path, tmp_path: Path, capsys, end: float, flag: str
):
    """Of the three held-out frames, one is in the first 0.03 s, which Nerfstudio cannot interpolate."""
    config = small_config(recording, tmp_path)
    config.pipeline.datamanager.dataparser.time_range = 0.0, end
    trainer = set_up(config)
    trainer.train()
    assert len(trainer.pipeline.datamanager.eval_dataset) == (1 if flag else 3)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("video along the cameras: ")]
    assert line.endswith(f"config.yml --output-path video.mp4 --rendered-output-names display{flag}")


def test_a_run_is_the_same_on_any_number_of_threads(recording: Path, tmp_path: Path):
    before, parameters = torch.get_num_threads(), []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            config = small_config(recording, tmp_path / str(number), data__event_pairs=2000)
            trainer = set_up(config)
            trainer.pipeline.train()
            for step in range(3):
                trainer.train_iteration(step)
            parameters.append(trainer.pipeline.model.state_dict())
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(parameters[0][name], value) for name, value in parameters[1].items())
