from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.scripts.train import train_loop
from small_runs import SMALL

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.method import runs
from enerf_ns.method.datamanager import EnerfDataManagerConfig
from enerf_ns.method.pipeline import EnerfPipelineConfig
from enerf_ns.method.runs import Run, load, method_config, set_up


def parameters(pipeline: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in pipeline.state_dict().items()}


def test_a_configuration_is_a_copy_with_changes(tmp_path: Path):
    before = all_methods["enerf"].pipeline.datamanager.held_out_events
    changes = {"pipeline.datamanager.held_out_events": 2 * before}
    config = method_config("enerf", tmp_path / "data", tmp_path, changes)
    assert config.pipeline.datamanager.held_out_events == 2 * before
    assert config.data == config.pipeline.datamanager.data == tmp_path / "data"
    assert (config.output_dir, config.vis) == (tmp_path, "tensorboard")
    assert all_methods["enerf"].pipeline.datamanager.held_out_events == before and all_methods["enerf"].data is None


def test_a_configuration_with_options_of_a_format_is_that_of_its_sub_command(tmp_path: Path):
    parser = "pipeline.datamanager.dataparser."
    changes = {f"{parser}format": "llff_events", f"{parser}options": {"pose_set": "uslam"}}
    found = method_config("enerf", tmp_path, tmp_path, changes).pipeline.datamanager.dataparser
    command = tyro.cli(EnerfDataManagerConfig, args=["llff-events", "--pose-set", "uslam"]).dataparser
    assert (found.format, found.options) == (command.format, command.options)
    with pytest.raises(FlagError, match=r"of llff_events lack one of the options split; known: pose_set\."):
        method_config("enerf", tmp_path, tmp_path, {**changes, f"{parser}options": {"split": "train"}})


@pytest.mark.parametrize("name", ["nerfacto", "nothing"])
def test_a_method_that_is_not_of_this_package_is_refused(tmp_path: Path, name: str):
    with pytest.raises(FlagError, match=rf"no method {name} in this package; choose one of enerf, .*enerf-paper.*"):
        method_config(name, tmp_path, tmp_path)


@pytest.mark.parametrize("path", ["nothing", "pipeline.nothing.event_pairs", "pipeline.datamanager.event-pairs"])
def test_a_setting_that_there_is_not_is_refused(tmp_path: Path, path: str):
    with pytest.raises(FlagError, match=f"has no setting {path}; ns-train enerf --help"):
        method_config("enerf", tmp_path, tmp_path, {path: 1})


def test_a_run_is_trained_as_ns_train_does(run: Run, recording: Path, tmp_path: Path):
    """The same seed, the same steps: the same parameters, to the last bit."""
    config = method_config("enerf", recording, tmp_path, SMALL)
    config.save_config()
    torch.manual_seed(123)
    train_loop(local_rank=0, world_size=1, config=config)
    (file,) = config.get_checkpoint_dir().glob("*.ckpt")
    theirs = torch.load(file)["pipeline"]
    ours = parameters(run.pipeline)
    assert ours.keys() == theirs.keys() and len(ours) > 3
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=0, atol=0)


def test_another_seed_begins_elsewhere(recording: Path, tmp_path: Path):
    first, second, other = (
        parameters(set_up(method_config("enerf", recording, tmp_path, {**SMALL, "machine.seed": seed})).pipeline)
        for seed in (1, 1, 2)
    )
    assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert any(not torch.equal(value, other[name]) for name, value in first.items())


def test_a_run_is_loaded_as_it_was_trained(run: Run):
    assert run.train_seconds is not None and run.train_seconds > 0
    assert run.config_file.name == "config.yml" and (run.config_file.parent / "choices.json").is_file()
    loaded = load(run.config_file)
    assert loaded.train_seconds is None and loaded.config_file == run.config_file
    assert loaded.config.max_num_iterations == 2
    ours = parameters(loaded.pipeline)
    assert all(torch.equal(value, ours[name]) for name, value in parameters(run.pipeline).items())


def test_of_a_run_that_was_copied_or_moved_the_checkpoint_beside_it_is_loaded(run: Run, tmp_path: Path):
    """Not that of the folder in which it was trained, though config.yml names this one."""
    trained, copied = tmp_path / "trained", tmp_path / "elsewhere/copy"
    shutil.copytree(run.config_file.parent, trained / "recording/enerf/run")
    config = yaml.load(run.config_file.read_text(), Loader=yaml.Loader)
    config.output_dir = trained
    (trained / "recording/enerf/run/config.yml").write_text(yaml.dump(config))
    shutil.copytree(trained / "recording/enerf/run", copied)
    (checkpoint,) = (copied / "nerfstudio_models").iterdir()
    state = torch.load(checkpoint)
    name = next(name for name, value in state["pipeline"].items() if value.is_floating_point())
    state["pipeline"][name] += 1.0
    torch.save(state, checkpoint)
    for _ in ("copied", "moved"):
        changed = parameters(load(copied / "config.yml").pipeline)[name]
        torch.testing.assert_close(changed, parameters(run.pipeline)[name] + 1.0)
        shutil.rmtree(trained, ignore_errors=True)


def test_a_run_is_loaded_though_training_replaces_its_checkpoint_meanwhile(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "run"
    shutil.copytree(run.config_file.parent, folder)
    (first,) = (folder / "nerfstudio_models").iterdir()
    set_up_pipeline = EnerfPipelineConfig.setup

    def while_training(*args, **kwargs):
        if first.exists():
            first.rename(first.with_name("step-000000002.ckpt"))
        return set_up_pipeline(*args, **kwargs)

    monkeypatch.setattr(EnerfPipelineConfig, "setup", while_training)
    loaded = load(folder / "config.yml")
    assert loaded.config.load_step == 2 and not first.exists()
    ours = parameters(loaded.pipeline)
    assert all(torch.equal(value, ours[name]) for name, value in parameters(run.pipeline).items())


def no_checkpoints(folder: Path) -> None:
    for file in (folder / "nerfstudio_models").iterdir():
        file.unlink()


def damaged_checkpoint(folder: Path) -> None:
    (file,) = (folder / "nerfstudio_models").iterdir()
    file.write_bytes(file.read_bytes()[:100])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda folder: shutil.rmtree(folder / "nerfstudio_models"), "its checkpoints are not found"),
        (no_checkpoints, "holds no whole checkpoint"),
        (damaged_checkpoint, "holds no whole checkpoint"),
        (lambda folder: (folder / "config.yml").write_text("{"), "expected the node content"),
        (lambda folder: (folder / "config.yml").write_text("a: 1"), "AssertionError"),
        (lambda folder: (folder / "config.yml").write_text("!!python/object:nowhere.Nothing {}"), "nowhere"),
        (lambda folder: (folder / "config.yml").write_bytes(b"\xff\xfe\x00"), "codec"),
    ],
)
def test_a_run_that_cannot_be_loaded_is_one_sentence(run: Run, tmp_path: Path, change, reason: str):
    folder = tmp_path / "recording" / "enerf" / "run"
    shutil.copytree(run.config_file.parent, folder)
    config = folder / "config.yml"
    stored = yaml.load(config.read_text(), Loader=yaml.Loader)
    stored.output_dir = tmp_path
    config.write_text(yaml.dump(stored))
    load(config)
    change(folder)
    with pytest.raises(RecordingError, match=rf"config\.yml cannot be loaded as a trained run \(.*{reason}") as refused:
        load(config)
    assert "\n" not in str(refused.value) and str(refused.value).endswith("in which training was started.")


def test_what_is_no_file_is_no_run(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"nothing\.yml does not exist; give the config\.yml of a trained run\.$"):
        load(tmp_path / "nothing.yml")
    with pytest.raises(RecordingError, match=r"is a folder; give the config\.yml of a trained run\.$"):
        load(tmp_path)


def test_a_run_of_another_method_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(runs, "load_any_method", lambda *_: (all_methods["nerfacto"], None))
    with pytest.raises(RecordingError, match=r"config\.yml is a run of the method nerfacto; give .* of a run of enerf"):
        load(tmp_path / "config.yml")
