"""What a run records of itself while it trains."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from PIL import Image
from small_runs import EVENTS, set_up, small_config

from enerf_ns import terminal
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.evaluation import scores as evaluation_scores
from enerf_ns.evaluation.history import HISTORY_FILE, read_history
from enerf_ns.evaluation.metrics import EVENT_SCORES
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.method import error_against_time, stopwatch
from enerf_ns.method.error_against_time import EARLIEST, SMALLEST_GROWTH, next_moment
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.pipeline import EnerfPipeline


class Clock:
    """Time that goes on only where it is told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def takes(self, seconds: float, function: Any) -> Any:
        """The function, which takes so long by this clock."""

        def slow(*args: Any, **kwargs: Any) -> Any:
            self.now += seconds
            return function(*args, **kwargs)

        return slow


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    """A step takes one second, scoring a frame half of one, and nothing else any time."""
    clock = Clock()
    for module in (error_against_time, stopwatch):
        monkeypatch.setattr(
            module, "time", SimpleNamespace(perf_counter=clock.perf_counter, process_time=clock.perf_counter)
        )
    monkeypatch.setattr(Trainer, "train_iteration", clock.takes(1.0, Trainer.train_iteration))
    monkeypatch.setattr(evaluation_scores, "view_scores", clock.takes(0.5, evaluation_scores.view_scores))
    monkeypatch.setattr(error_against_time, "PAIRS", 64)  # so that moments fit into so few steps
    yield clock


def config_of(recording: Path, output_dir: Path, steps: int, share: float = 0.5, **changes: Any) -> Any:
    config = small_config(recording, output_dir, **{"data__held_out_events": 0.2, **changes})
    config.max_num_iterations, config.evaluation_share = steps, share
    return config


def trained(config: Any, stop_after: int | None = None) -> Any:
    """A trainer that trained to its end, or was interrupted in a step."""
    trainer = set_up(config)
    draw = trainer.pipeline.datamanager.next_batch

    def interrupted_draw(sensor: Any) -> Any:
        if trainer.step == stop_after:
            os.kill(os.getpid(), signal.SIGTERM)
        return draw(sensor)

    trainer.pipeline.datamanager.next_batch = interrupted_draw
    if stop_after is None:
        trainer.train()
    else:
        with pytest.raises(SystemExit):
            trainer.train()
    return trainer


def again(trainer: Any) -> Any:
    """The config of a run that goes on."""
    return yaml.load((trainer.base_dir / "config.yml").read_text(), Loader=yaml.Loader)


@pytest.fixture(scope="module")
def without_frames(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("without_frames") / "recording"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth"))
    return folder


@pytest.mark.parametrize("cost", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("total", [100.0, 1000.0])
@pytest.mark.parametrize("budget", [3.0, 10.0])
def test_moments_are_evenly_spaced_in_log_time_and_keep_to_the_budget(budget: float, total: float, cost: float):
    """By going through a run step by step; as many as the budget holds, unless they would be too close."""
    moments: list[float] = []
    for step in range(1, round(100 * total) + 1):
        now = step / 100
        last = moments[-1] if moments else 0.0
        if now >= next_moment(last, total, budget - cost * len(moments), cost):
            moments.append(now)
    most = math.floor(budget / cost)
    assert len(moments) == min(most, math.floor(math.log(1 / EARLIEST) / math.log(SMALLEST_GROWTH)))
    assert cost * len(moments) <= budget
    growth = max((1 / EARLIEST) ** (1 / (most + 1)), SMALLEST_GROWTH)
    expected = EARLIEST * total * growth ** np.arange(1, len(moments) + 1)
    np.testing.assert_allclose(moments, expected, rtol=0.02)


def test_where_no_moment_fits_there_is_none():
    assert next_moment(0.0, 100.0, 0.9, 1.0) == next_moment(50.0, 100.0, -3.0, 1.0) == math.inf


def test_the_time_of_a_run_is_that_of_its_steps_alone(recording: Path, tmp_path: Path, clock: Clock):
    """With scores that take long, checkpoints and previews between; evaluation keeps to its share."""
    config = config_of(recording, tmp_path, 80, 0.3)
    config.steps_per_save = 7
    trainer = trained(config)
    rows = read_history(trainer.base_dir)
    assert [row.seconds for row in rows] == [float(row.step) for row in rows]
    assert len(rows) > 5 and [row.final for row in rows] == [False] * (len(rows) - 1) + [True]
    spent = sum(map(sum, trainer.error_against_time.costs.values()))
    assert spent == len(rows[:-1]) * 2 * 0.5 <= 0.3 * 80
    assert clock.now == 80 + spent + 3 * 0.5, "all three held-out frames are scored at the end"
    steps = np.array([row.step for row in rows[:-1]])
    assert (steps[1:] >= np.floor(SMALLEST_GROWTH * steps[:-1])).all() and steps[0] <= 10


def test_the_time_left_does_not_count_the_first_step_which_compiles(
    recording: Path, tmp_path: Path, clock: Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(terminal, "PRINTED_EVERY", 0.0)
    watch = set_up(config_of(recording, tmp_path, 62, share=0.0)).error_against_time
    watch.pipeline.last_step = SimpleNamespace(losses={"event_loss": torch.tensor(0.5)})
    watch.begin(0, None)
    capsys.readouterr()
    for number, seconds in enumerate((600.0, 2.0)):
        with watch.step(number):
            clock.now += seconds
        watch.after_step(number, {})
    assert capsys.readouterr().out.splitlines() == [
        "step 1 of 62, loss 0.5",
        "step 2 of 62, 2 min 0 s left, loss 0.5",
    ]
    assert watch.seconds == 602.0, "the run did take that time"


def test_a_row_holds_scores_losses_and_the_parts_of_a_step(
    recording: Path, tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
):
    """Each part as long as what is done in it; scores also for TensorBoard."""
    put: dict[tuple[str, int], float] = {}
    monkeypatch.setattr(writer, "put_scalar", lambda name, scalar, step: put.update({(name, step): scalar}))
    monkeypatch.setattr(
        Optimizers, "optimizer_scaler_step_some", clock.takes(0.5, Optimizers.optimizer_scaler_step_some)
    )
    monkeypatch.setattr(torch.Tensor, "backward", clock.takes(2.0, torch.Tensor.backward))
    trainer = set_up(config_of(recording, tmp_path, 60))
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    manager.next_batch, manager.rays = clock.takes(0.25, manager.next_batch), clock.takes(0.125, manager.rays)
    model.get_outputs, model.get_loss_dict = clock.takes(4.0, model.get_outputs), clock.takes(8.0, model.get_loss_dict)
    trainer.train()
    *rows, last = read_history(trainer.base_dir)
    assert rows
    parts = {"draw": 1.0 + 0.25, "rays": 0.125, "render": 4.0, "losses": 8.0, "backward": 2.0, "optimiser": 0.5}
    for row in [*rows, last]:
        assert list(row.parts) == list(parts) and row.parts == parts
        assert row.seconds == row.step * sum(parts.values())
        assert set(row.losses) == EVENTS and all(math.isfinite(loss) for loss in row.losses.values())
        always = {"correlation", "depth_rmse", *EVENT_SCORES}  # early on, a render may be a negative
        assert always <= set(row.scores) and (row.final or set(row.scores) <= always | {"psnr", "ssim"})
        assert row.protocol == "log-affine-set" and not set(row.scores) & set(row.not_scored)
        for name in ("psnr", "ssim", "lpips"):
            left_out = [number for numbers in row.not_scored.get(name, {}).values() for number in numbers]
            looked_at = [0, 1, 2] if row.final else [0, 2]
            assert sorted(left_out) == ([] if name in row.scores else looked_at)
        assert "lpips" in row.not_scored, "the frames are too small for it"
        for name, score in row.scores.items():
            assert put[f"Held-out/{name}", row.step] == score
    assert {row.num_frames for row in rows} == {2} and (last.num_frames, last.final, last.step) == (3, True, 60)
    views, summary = held_out_views(trainer.pipeline)
    expected = summary_scores(views, summary)
    for name in ("psnr", "ssim", "correlation", "depth_rmse", "brightness_scale", "mean_depth"):
        assert last.scores.get(name) == expected[name]
    assert last.scores.items() >= trainer.pipeline.event_scores().items()
    losses = trainer.pipeline.last_step.losses
    assert last.losses == {name: loss.item() for name, loss in losses.items()}


@pytest.mark.parametrize("kill", [False, True])
def test_a_run_that_goes_on_has_one_history(recording: Path, tmp_path: Path, clock: Clock, kill: bool):
    """As one that was never stopped; what was recorded after the checkpoint is done anew, a half-written line too."""
    straight = trained(config_of(recording, tmp_path / "straight", 60))
    config = config_of(recording, tmp_path / "stopped", 60)
    config.steps_per_save, config.save_only_latest_checkpoint = 15, False
    stopped = trained(config, stop_after=40)
    before = read_history(stopped.base_dir)
    assert before and not any(row.final for row in before) and max(row.step for row in before) > 31
    if kill:
        (stopped.checkpoint_dir / "step-000000040.ckpt").unlink()
        with (stopped.base_dir / HISTORY_FILE).open("a") as file:
            file.write('{"step": 41, "sec')
    resumed = trained(again(stopped))
    rows = read_history(resumed.base_dir)
    assert len((resumed.base_dir / HISTORY_FILE).read_text().splitlines()) == len(rows)
    assert [row.seconds for row in rows] == [float(row.step) for row in rows]
    expected = read_history(straight.base_dir)
    assert (rows[-1].step, rows[-1].final) == (60, True) and expected[-1].scores.keys() == rows[-1].scores.keys()
    kept = [row for row in before if row.step <= (31 if kill else 41)]
    assert rows[: len(kept)] == kept and all(row.step > kept[-1].step for row in rows[len(kept) :])
    costs = resumed.error_against_time.costs["moments"]
    assert len(costs) == len(rows) - 1 and sum(costs) <= 0.5 * 60
    done = read_history(resumed.base_dir)
    trained(again(resumed))
    assert read_history(resumed.base_dir) == done, "at its end, a run stays as it is"


def test_a_run_of_events_alone_is_scored_by_them(without_frames: Path, tmp_path: Path, clock: Clock, monkeypatch):
    monkeypatch.setattr(EnerfPipeline, "event_scores", clock.takes(0.5, EnerfPipeline.event_scores))
    monkeypatch.setattr(error_against_time, "STEPS_PER_PREVIEW", 20)
    trainer = trained(config_of(without_frames, tmp_path, 50, 1.0))
    rows = read_history(trainer.base_dir)
    assert len(rows) > 2 and all(set(row.scores) == {*EVENT_SCORES} and row.num_frames == 0 for row in rows)
    assert {row.protocol for row in rows} == {"events"} and not any(row.not_scored for row in rows)
    (first, second) = sorted((trainer.base_dir / "previews").iterdir())
    assert (first.name, second.name) == ("step-000000020.png", "step-000000040.png")
    assert Image.open(first).size == (2 * 32, 24)


def test_a_preview_shows_a_held_out_frame_its_render_and_its_depth(
    recording: Path, tmp_path: Path, clock: Clock, monkeypatch
):
    monkeypatch.setattr(error_against_time, "STEPS_PER_PREVIEW", 10)
    monkeypatch.setattr(error_against_time, "PREVIEW_WIDTH", 16)
    trainer = trained(config_of(recording, tmp_path, 21, 1.0))
    pictures = [np.asarray(Image.open(file)) for file in sorted((trainer.base_dir / "previews").iterdir())]
    file = trainer.pipeline.datamanager.eval_dataset.frames.filenames[0]
    expected = load_image(file).reshape(12, 2, 16, 2, -1).mean(axis=(1, 3))
    assert len(pictures) == 2
    for picture in pictures:
        assert picture.shape == (12, 48, 3)
        np.testing.assert_allclose(picture[:, :16], np.broadcast_to(expected, (12, 16, 3)), atol=1)
    assert (pictures[0][:, 16:] != pictures[1][:, 16:]).any()


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_the_shortest_runs_are_scored_at_their_end(recording: Path, tmp_path: Path, steps: int):
    trainer = trained(config_of(recording, tmp_path, steps, 1e-6))
    (row,) = read_history(trainer.base_dir)
    assert (row.step, row.final, row.num_frames) == (steps, True, 3) and row.seconds > 0
    assert list(row.parts) == ["draw", "rays", "render", "losses", "backward", "optimiser"]
    assert all(seconds > 0 for seconds in row.parts.values()) and sum(row.parts.values()) <= row.seconds


def test_a_share_of_nothing_evaluates_nothing(recording: Path, tmp_path: Path, clock: Clock, capsys, monkeypatch):
    monkeypatch.setattr(error_against_time, "STEPS_PER_PREVIEW", 5)
    trainer = trained(config_of(recording, tmp_path, 30, 0.0))
    assert clock.now == 30 and not {HISTORY_FILE, "previews"} & {file.name for file in trainer.base_dir.iterdir()}
    assert "step 30 of 30, loss " in capsys.readouterr().out


def test_what_cannot_be_stored_is_said_once_and_training_goes_on(
    recording: Path, tmp_path: Path, clock: Clock, capsys, monkeypatch
):
    monkeypatch.setattr(error_against_time, "STEPS_PER_PREVIEW", 10)
    trainer = set_up(config_of(recording, tmp_path, 60, 1.0))
    (trainer.base_dir / "previews").write_text("in the way")
    draw = trainer.pipeline.datamanager.next_batch

    def draw_and_block(sensor: Any) -> Any:
        (trainer.base_dir / HISTORY_FILE).mkdir(exist_ok=True)
        return draw(sensor)

    trainer.pipeline.datamanager.next_batch = draw_and_block
    trainer.train()
    output = capsys.readouterr().out
    assert output.count("could not be stored") == 1 and "Training is done" in output
    assert len(trainer.error_against_time.costs["moments"]) > 2 and "PSNR" in output


def test_a_frame_that_went_missing_ends_evaluation_and_not_training(
    recording: Path, tmp_path: Path, clock: Clock, capsys
):
    shutil.copytree(recording, tmp_path / "recording")
    trainer = set_up(config_of(tmp_path / "recording", tmp_path / "outputs", 60, 1.0))
    for file in trainer.pipeline.datamanager.eval_dataset.frames.filenames:
        file.unlink()
    trainer.train()
    output = capsys.readouterr().out
    assert output.count("is missing; an image was expected there. Training goes on without evaluation.") == 1
    assert "Training is done" in output and not read_history(trainer.base_dir)
