"""Experiments that are run, stopped, killed, run on, and run again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import SMALL_BENCH
from warm_commands import WarmCommands

from enerf_ns.bench import measures, runner
from enerf_ns.bench.experiments import ROWS, SEQUENCES, Row, Sequence
from enerf_ns.bench.measures import MEASURES, TRUTH, evaluate, milliseconds_a_step
from enerf_ns.bench.runner import Bench, parse_budget, steps_of
from enerf_ns.bench.settings import BenchSettings
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.evaluation.metrics import depth_rmse
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import load, method_config
from enerf_ns.method.trainer import EnerfTrainer
from enerf_ns.scripts.bench import Bench as BenchCommand
from enerf_ns.sensor.threshold_map import ThresholdMap
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def simulated(finished: Path, tmp_path: Path) -> Path:
    """An output folder with the recording alone."""
    shutil.copytree(finished / "recordings", tmp_path / "recordings")
    return tmp_path


def bench(folder: Path, name: str = "design", **changes: Any) -> Bench:
    return Bench(name, BenchSettings(**{**SMALL_BENCH, "output_dir": folder, **changes}))


def finish(folder: Path, **changes: Any) -> list[str]:
    """Runs to the end; names of the rows that were begun."""
    return [cell.row for cell, result in bench(folder, **changes).run() if result is None]


def table(folder: Path) -> list[dict[str, Any]]:
    """Results but for what is of the clock."""
    runs = json.loads((folder / "design.json").read_text())["runs"]
    for run in runs:
        run.pop("seconds")
        run.pop("processor_seconds", None)
        for scores in run["scores"].values():
            scores.pop("ms_a_step")
    return runs


def test_what_is_finished_is_not_run_again_and_gives_the_same_tables(finished: Path, tmp_path: Path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    written = {file: file.read_bytes() for file in folder.glob("design.*")}
    for file in written:
        file.unlink()
    assert finish(folder) == []
    assert {file: file.read_bytes() for file in folder.glob("design.*")} == written
    assert {file.suffix for file in written} == {".md", ".json", ".csv"}


def test_a_result_file_alone_is_enough_to_go_on(finished: Path, tmp_path: Path):
    """It may be the committed one, made on another machine."""
    folder = shutil.copytree(finished, tmp_path / "copy")
    before = table(folder)
    shutil.rmtree(folder / "runs")
    assert finish(folder) == []
    assert table(folder) == before


def test_a_result_of_other_code_is_made_again(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = shutil.copytree(finished, tmp_path / "copy")
    monkeypatch.setattr(runner, "code_digest", lambda *_, **__: "other code")
    assert len(finish(folder)) == len(table(folder))
    assert len(list((folder / "recordings").iterdir())) == 2, "the simulator is other code, too"


def test_a_training_that_failed_here_hides_no_result_of_another_machine(finished: Path, tmp_path: Path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    before = table(folder)
    for file in folder.glob("runs/*/*/*/result.json"):
        file.write_text(json.dumps({**json.loads(file.read_text()), "failure": "No space left."}))
    assert finish(folder) == []
    assert table(folder) == before


@pytest.mark.parametrize(("better", "fails"), [(-1.0, False), (0.0, False), (1.0, True)])
def test_a_row_that_lost_against_another_version_is_an_error(finished: Path, tmp_path: Path, better, fails, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    for file in folder.glob("runs/*/*/*/result.json"):  # two steps of training have no score to compare
        result = json.loads(file.read_text())
        result["scores"]["log-affine-set"]["psnr"] = 20.0
        file.write_text(json.dumps(result))
    finish(folder)
    before = json.loads((folder / "design.json").read_text())
    for of_run in before["runs"]:
        of_run["scores"]["log-affine-set"]["psnr"] += better
    (tmp_path / "before.json").write_text(json.dumps(before))
    settings = BenchSettings(**{**SMALL_BENCH, "output_dir": folder, "against": tmp_path / "before.json"})
    command = BenchCommand("design", settings)
    if fails:
        with pytest.raises(FlagError, match=r"lost more than 0\.3 dB"):
            command.main()
    else:
        command.main()
    assert "before, dB" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("what", "value"), [("experiment", "sensor"), ("budget", "1000"), ("scale", 1.0), ("method", "enerf-paper")]
)
def test_results_of_other_conditions_are_not_compared(finished: Path, tmp_path: Path, what: str, value: Any):
    before = json.loads((finished / "design.json").read_text())
    Bench("design", BenchSettings(**{**SMALL_BENCH, "output_dir": tmp_path, "against": finished / "design.json"}))
    (tmp_path / "before.json").write_text(json.dumps({**before, what: value}))
    with pytest.raises(FlagError, match=r"design\.json is the file that this bench writes; give another --output-dir"):
        Bench("design", BenchSettings(**{**SMALL_BENCH, "output_dir": finished, "against": finished / "design.json"}))
    if what == "scale":  # recordings of the user have none
        (tmp_path / "recorded.json").write_text(json.dumps({**before, "scale": None}))
        Bench("design", BenchSettings(**{**SMALL_BENCH, "output_dir": tmp_path, "against": tmp_path / "recorded.json"}))
    with pytest.raises(FlagError, match=f"results of {what} {value}, but this bench has {what} {before[what]}; give a"):
        Bench("design", BenchSettings(**{**SMALL_BENCH, "output_dir": tmp_path, "against": tmp_path / "before.json"}))


def test_a_result_says_what_it_was_made_of(finished: Path):
    for file in finished.glob("runs/*/*/*/result.json"):
        result = json.loads(file.read_text())
        assert (file.parent / "config.yml").exists() and (file.parent / "log.txt").stat().st_size
        assert result["steps"] == 2 and result["seconds"] > 0 and result["threads"] == 1
        assert result["version"] == runner.code_version() and result["device"] == runner.device_name()
        assert result["settings"]["changes"]["machine.seed"] == result["seed"] == 0
        assert set(result["scores"]) == {"log-affine-set"}
        assert not (file.parent / "history.jsonl").exists(), "held-out frames are scored once, after training"
    assert len(list(finished.glob("runs/*/*/*/result.json"))) == 2


@pytest.mark.parametrize(
    "changes",
    [{"budget": "3"}, {"scale": 0.06}, {"seeds": 2}, {"method": "enerf-paper"}],
    ids=lambda changes: next(iter(changes)),
)
def test_what_was_made_with_other_settings_is_run_again(finished: Path, changes: dict[str, Any]):
    """The last cell is of another seed where there are more."""
    run = bench(finished, **changes)
    assert not run.folder(run.cells[-1]).exists()
    assert bench(finished).folder(run.cells[0]).exists()


@pytest.mark.usefixtures("python_interrupts")
def test_a_bench_that_is_stopped_between_rows_and_inside_of_one_ends_with_the_same_table(
    finished: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch
):
    for _, result in bench(simulated).run():  # between rows
        if result is not None:
            break
    train_iteration = EnerfTrainer.train_iteration

    def interrupted(self: EnerfTrainer, step: int):
        os.kill(os.getpid(), signal.SIGINT)
        return train_iteration(self, step)

    with monkeypatch.context() as patched:
        patched.setattr(EnerfTrainer, "train_iteration", interrupted)
        with pytest.raises(KeyboardInterrupt):  # inside of the second
            finish(simulated)
    assert [run["row"] for run in table(simulated)] == ["events"]
    assert finish(simulated) == ["uniform-samples"]
    assert table(simulated) == table(finished)


@pytest.mark.slow
def test_a_bench_that_is_killed_between_rows_and_inside_of_them_ends_with_the_same_table(
    finished: Path, tmp_path: Path, warm_commands: WarmCommands
):
    """Killed while it simulates, while the first row is trained, and once that is finished."""
    command = ["enerf", "bench", "design", "--budget", "2", "--scale", "0.05", "--threads", "1"]
    command += ["--output-dir", str(tmp_path), "--rows", *SMALL_BENCH["rows"]]
    for pattern in ("recordings/.*/*", "runs/*/*/*/config.yml", "runs/*/*/*/result.json"):
        started = warm_commands.start(*command, limit=300)
        while not list(tmp_path.glob(pattern)):
            assert started.running(), f"it ended before there was {pattern}"
            time.sleep(0.002)
        started.kill()
        assert started.wait()[0] == -signal.SIGKILL
    code, printed = warm_commands.run(*command, limit=300)
    assert code == 0, printed
    assert table(tmp_path) == table(finished)


def test_a_row_that_fails_says_why_is_tried_again_and_stops_no_other(
    finished: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as broken:
        broken.setitem(ROWS, "events", Row({"pipeline.model.nothing": 1}))
        assert finish(simulated) == ["events", "uniform-samples"]
        assert finish(simulated) == ["events"]
        sentence = "The method enerf has no setting pipeline.model.nothing"
        failed, scored = json.loads((simulated / "design.json").read_text())["runs"]
        assert failed["failure"].startswith(sentence) and "failure" not in scored
        assert f"* shapes, events, seed 0 failed: {sentence}" in (simulated / "design.md").read_text()
    assert finish(simulated) == ["events"]
    assert table(simulated) == table(finished)


def test_a_recording_that_is_not_there_fails_its_rows_in_a_sentence(tmp_path: Path):
    assert finish(tmp_path, name="slider-depth", data=tmp_path / "nowhere", rows=("events",)) == ["events"]
    (run,) = json.loads((tmp_path / "slider-depth.json").read_text())["runs"]
    assert "nowhere" in run["failure"] and run["failure"].count(". ") == 0


def test_results_on_a_recording_of_the_user_are_compared(tmp_path: Path):
    """They have no scale of simulated pictures."""
    finish(tmp_path, name="slider-depth", data=tmp_path / "nowhere", rows=("events",))
    against, output_dir = tmp_path / "slider-depth.json", tmp_path / "new"
    changes = {"data": tmp_path / "nowhere", "rows": ("events",), "against": against, "output_dir": output_dir}
    before = Bench("slider-depth", BenchSettings(**{**SMALL_BENCH, **changes})).before
    assert before is not None and before["scale"] is None


def test_a_simulation_that_was_cut_short_is_not_used(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(settings: Any, output_dir: Path) -> None:
        output_dir.mkdir(parents=True)
        (output_dir / "poses_all.txt").write_text("")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(runner, "simulate", full)
        finish(tmp_path, rows=("events",))
        assert "No space left" in (tmp_path / "design.md").read_text()
    finish(tmp_path, rows=("events",))
    assert table(tmp_path) == table(finished)[:1]


def test_experiments_share_the_runs_of_rows_and_sequences_that_they_share():
    def folders(name: str) -> set[Path]:
        run = Bench(name, BenchSettings())
        return {run.folder(cell) for cell in run.cells}

    shared = folders("spiral") | folders("shake")
    assert folders("depth") < shared and len(folders("views") & shared) == 2
    assert len(folders("ablation") & shared) == 5


@pytest.mark.parametrize(
    ("budget", "expected"),
    [("1002", ["250", "501", "1002", "2004"]), ("1.5s", ["0.375s", "0.750s", "1.5s", "3.000s"])],
)
def test_rows_of_several_budgets_share_the_run_of_the_budget_itself(budget: str, expected: list[str]):
    run = Bench("levelling", BenchSettings(budget=budget, rows=("events-0.25x", "events-0.5x", "events", "events-2x")))
    cells = [cell for cell in run.cells if cell.sequence == "shake-moon2"]
    assert [run._about(cell)["budget"] for cell in cells] == expected
    shake = Bench("shake", BenchSettings(budget=budget, rows=("events",), sequences=("shake-moon2",)))
    assert {shake.folder(cell) for cell in shake.cells} < {run.folder(cell) for cell in cells}


def test_all_rows_on_a_recording_have_one_field_though_their_preset_leaves_gloss_open():
    run = Bench("spiral", BenchSettings(method="enerf"))
    for cell in run.cells:
        row = ROWS[cell.row]
        if row.reconstruction is None:
            run._recording = lambda _: Path("recording")  # type: ignore[method-assign]
            assert run._config(cell, Path("run")).pipeline.model.view_direction is False


def test_settings_that_are_multiplied_are_those_that_were_chosen(finished: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(ROWS, "events", Row(factors={"pipeline.model.num_levels": 1.5, "pipeline.model.max_res": 12}))
    run = bench(finished)
    (cell, _) = run.cells
    found = run._config(cell, Path("run")).pipeline.model
    recording = run._recording(cell)
    chosen = method_config("enerf", recording, finished).resolved().pipeline.resolution.values
    assert found.num_levels == round(1.5 * chosen["model.num_levels"])
    assert found.max_res == 12 * chosen["model.max_res"]


def test_a_scene_of_its_own_is_written_and_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    unbounded = SEQUENCES["unbounded"]
    short = {**unbounded.files, "unbounded.txt": "0 0 0 0 0 2 0\n0.05 0.02 0 0 0 2 0\n"}
    simulation = {**unbounded.simulation, "num_frames": 11}
    sequence = Sequence(unbounded.scene, changes=unbounded.changes, simulation=simulation, files=short)
    monkeypatch.setitem(SEQUENCES, "unbounded", sequence)
    assert finish(tmp_path, name="unbounded", rows=("no-contraction",)) == ["no-contraction"]
    (run,) = json.loads((tmp_path / "unbounded.json").read_text())["runs"]
    assert run["scores"]["log-affine-set"]["near_depth_error"] > 0


def test_measures_of_a_run(finished: Path):
    """Depths at all poses against those of `held_out_views`, once for each half of the frames."""
    (folder,) = finished.glob("runs/shapes/enerf/events-*")
    run = replace(load(folder / "config.yml"), train_seconds=3.0)
    assert milliseconds_a_step(run) == 1500.0
    scores, _ = evaluate(run, ["log-affine-set"], ["memory", "step"])
    found = scores["log-affine-set"]
    manager = run.pipeline.datamanager
    views = held_out_views(run.pipeline)[0]
    manager.eval_dataset = manager.train_dataset
    views += held_out_views(run.pipeline)[0]
    pairs = [(view.depth, view.recorded_depth) for view in views]
    errors = [depth_rmse(depth, true) for depth, true in pairs if depth is not None and true is not None]
    assert len(errors) == 41  # frames of the recording
    assert found["depth_rmse_all_poses"] == pytest.approx(sum(map(float, errors)) / len(errors), rel=1e-5)
    parameters = sum(parameter.nbytes for parameter in run.pipeline.model.parameters())
    assert found["megabytes_a_step"] > 4 * parameters / 1e6
    parts = [found[name] for name in ("sample", "poses", "rays", "images", "forward_and_backward")]
    assert sum(parts) == pytest.approx(100.0) and found["images"] == 0.0 and min(parts[:3]) > 0.0


def test_a_part_of_a_step_takes_the_median_of_its_calls_in_milliseconds(monkeypatch: pytest.MonkeyPatch):
    """With a clock that each call moves on; the first call, which warms up, does not count."""
    seconds = [7.0, *4 * [0.001], 0.0025, *4 * [0.9]]
    now = 0.0

    def call() -> None:
        nonlocal now
        now += seconds.pop(0)

    monkeypatch.setattr(time, "perf_counter", lambda: now)
    run: Any = SimpleNamespace(pipeline=SimpleNamespace(device="cpu"))
    assert measures._milliseconds(call, run) == pytest.approx(2.5) and not seconds


def test_megabytes_of_a_step_are_what_is_kept_and_four_numbers_of_each_parameter(monkeypatch: pytest.MonkeyPatch):
    """The parameter, its gradient and two moments of Adam, of four bytes each."""
    monkeypatch.setattr(measures, "kept_bytes", lambda *_: 3_000_000)
    pipeline = torch.nn.Module()
    pipeline.model = torch.nn.Linear(999, 250)
    run: Any = SimpleNamespace(pipeline=pipeline)
    assert MEASURES["memory"](run, [])["megabytes_a_step"] == pytest.approx(3.0 + 16 * 250_000 / 1e6)


@pytest.fixture(scope="session")
def finished_sensor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a small bench of the experiment sensor, of one sequence with faults."""
    folder = tmp_path_factory.mktemp("sensor")
    finish(folder, name="sensor", sequences=("faults",), rows=())
    return folder


def test_a_recording_of_the_experiment_on_sensors_states_nothing_of_its_sensor(finished_sensor: Path):
    (folder,) = finished_sensor.glob("recordings/*")
    recording = read_recording(folder)
    assert (recording.contrast_thresholds, recording.response, recording.refractory_period) == (None, None, 0)
    assert recording.depth_range is not None and recording.blurred_frames is not None, "all else is stated"
    truth = json.loads((folder / TRUTH).read_text())
    assert truth["contrast_thresholds"] == [0.28, 0.2] and truth["sensor"]["refractory_period"] == 8_000_000
    for file in folder.glob("*.json"):
        assert (file.name == TRUTH) == ("thresholds" in file.read_text())


def test_an_own_layout_states_nothing_of_its_sensor_either_but_for_its_filter(tmp_path: Path):
    settings = SimulationSettings("shapes", width=32, height=24, duration=0.02, num_frames=1, layout="event_recording")
    sensor = SensorSettings(contrast_thresholds=(0.3, 0.2), refractory_period=1000)
    stated, hidden = tmp_path / "stated", tmp_path / "hidden"
    simulate(replace(settings, sensor=sensor), stated)
    about = stated / "recording.json"
    about.write_text(json.dumps({**json.loads(about.read_text()), "bayer_pattern": "RGGB"}))
    shutil.copytree(stated, hidden)
    runner.hide_sensor(hidden)
    before, after = read_recording(stated), read_recording(hidden)
    assert (before.contrast_thresholds, before.refractory_period) == ((0.3, 0.2), 1000) and before.response is not None
    assert (after.contrast_thresholds, after.response, after.refractory_period) == (None, None, 0)
    assert (after.bayer_pattern, after.camera, after.depth_range) == ("RGGB", before.camera, before.depth_range)


def test_what_is_told_of_the_sensor_is_what_was_simulated_or_nothing(finished_sensor: Path):
    """Fixed and known by their flags; learned by none."""
    runs = {run["row"]: run for run in json.loads((finished_sensor / "sensor.json").read_text())["runs"]}
    assert not [run for run in runs.values() if "failure" in run]
    run = bench(finished_sensor, name="sensor", sequences=("faults",), rows=())
    configs = {cell.row: run._config(cell, Path("run")).pipeline.model.sensor for cell in run.cells}
    told = {row: (of.contrast_thresholds, of.response, of.refractory_period_ns) for row, of in configs.items()}
    assert told["learned"] == (None, None, None)
    assert told["fixed"] == ((0.25, 0.25), "linlog", 0)
    assert told["known"] == ((0.28, 0.2), "logarithm:0.001", 8_000_000)
    scores = {row: run["scores"]["log-affine-set"] for row, run in runs.items()}
    found = [(scores[row]["threshold_ratio"], scores[row]["refractory_ms"]) for row in ("fixed", "known")]
    assert found == [(1.0, 0.0), (pytest.approx(1.4), 8.0)]
    for of in scores.values():
        assert (of["true_threshold_ratio"], of["true_refractory_ms"]) == (pytest.approx(1.4), 8.0)


def test_a_threshold_map_is_compared_with_the_thresholds_of_the_pixels(finished_sensor: Path):
    """One that is the true one but for noise has the correlation that noise leaves; one that is flat has none."""
    (folder,) = finished_sensor.glob("runs/faults/enerf/learned-*")
    run = replace(load(folder / "config.yml"), train_seconds=3.0)
    (recording,) = finished_sensor.glob("recordings/*")
    thresholds = np.load(recording / "thresholds.npy")
    assert thresholds.shape == (2, 24, 32)
    relative = thresholds / thresholds.mean(axis=(1, 2), keepdims=True) - 1
    relative[0] += np.random.default_rng(0).normal(0, relative[0].std(), relative[0].shape)
    sensor = run.pipeline.model.sensor

    assert isinstance(sensor.leak_rate, torch.Tensor)
    torch.nn.init.constant_(sensor.leak_rate, 0.25)
    sensor.threshold_map = ThresholdMap(24 * 32)

    def measured() -> dict[str, float]:
        return MEASURES["sensor"](run, held_out_views(run.pipeline)[0])

    assert not any(name.startswith("threshold_map") for name in measured())
    sensor.threshold_map.deviations.copy_(torch.from_numpy(relative.reshape(2, -1).T))
    found = measured()
    assert found["threshold_map_on"] == pytest.approx(2**-0.5, abs=0.05)
    assert found["threshold_map_off"] == pytest.approx(1.0, abs=1e-6)
    assert (found["leak_rate"], found["true_leak_rate"]) == (0.25, 0.0)


@pytest.mark.parametrize(
    ("budget", "expected"), [("120s", (120.0, True)), ("0.5s", (0.5, True)), ("600", (600.0, False))]
)
def test_a_budget_is_seconds_or_steps(budget: str, expected: tuple[float, bool]):
    assert parse_budget(budget) == expected


@pytest.mark.parametrize("budget", ["", "0", "0s", "1.5", "-3", "2m", "s", "1e3", "inf"])
def test_a_budget_that_is_neither_is_told(budget: str):
    with pytest.raises(FlagError, match="--budget"):
        parse_budget(budget)


def test_seconds_become_as_many_steps_as_fit(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With a clock that goes on by a tenth of a second a step."""
    steps = 0
    train_iteration = EnerfTrainer.train_iteration

    def counted(self: EnerfTrainer, step: int):
        nonlocal steps
        steps += 1
        return train_iteration(self, step)

    monkeypatch.setattr(EnerfTrainer, "train_iteration", counted)
    monkeypatch.setattr(time, "perf_counter", lambda: 0.1 * steps)
    run = bench(finished)
    config = run._config(run.cells[0], tmp_path)
    assert steps_of("50s", config) == 500 and steps_of("7", config) == 7
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "changes", "sentence"),
    [
        ("nothing", {}, "There is no experiment nothing; choose one of spiral, "),
        (
            "design",
            {"rows": ("events", "nothing")},
            "--rows nothing is not part of this experiment; choose from",
        ),
        (
            "design",
            {"sequences": ("spiral1",)},
            "--sequences spiral1 is not part of this experiment; choose from",
        ),
        ("shake", {"data": Path("x")}, "--data changes nothing for shake"),
        ("eds", {}, "enerf bench eds needs --data"),
        ("design", {"scale": 0.0}, "--scale is 0"),
        ("design", {"seeds": 0}, "--seeds is 0"),
        ("design", {"threads": 10**6}, "--threads is 1000000"),
        ("design", {"against": Path("no.json")}, "--against no.json cannot be read (No such file or directory)"),
        ("design", {"against": Path(__file__)}, f"--against {__file__} holds no results of enerf bench"),
        ("spiral", {"reconstruction_weights": Path("no.pth")}, "--reconstruction-weights no.pth does not exist"),
    ],
)
def test_settings_that_cannot_be_are_told_before_anything_starts(name, changes, sentence, tmp_path: Path):
    with pytest.raises(FlagError) as told:
        Bench(name, BenchSettings(output_dir=tmp_path, **changes))
    assert str(told.value).startswith(sentence)
    assert not list(tmp_path.iterdir())


def test_reconstructed_frames_need_weights_or_are_left_out(tmp_path: Path):
    weights = tmp_path / "weights.pth"
    weights.write_bytes(b"weights")
    with_weights, without = (Bench("shake", BenchSettings(reconstruction_weights=file)) for file in (weights, None))
    assert "e2vid" in with_weights.rows and "e2vid" not in without.rows and "filter" in without.rows
    assert set(without.results([])["left_out"]) == {"e2vid"}
    assert with_weights.results([])["reconstruction_weights"] == "weights.pth"


def test_the_command_names_no_place_of_this_machine(tmp_path: Path):
    settings = BenchSettings(data=tmp_path / "slider", seeds=2, rows=("events",), output_dir=tmp_path)
    assert Bench("slider-depth", settings).results([])["command"] == (
        "enerf bench slider-depth --data path/to/slider --budget 120s --scale 0.25 --seeds 2 --rows events"
    )
