"""The error of a run against its training time, recorded while it trains."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import mean, median
from typing import Any

import nerfstudio.engine.trainer  # noqa: F401 - before its writer, which would import it in a circle
import torch
from nerfstudio.utils import writer
from nerfstudio.utils.colormaps import apply_depth_colormap
from torch import Tensor

from enerf_ns.dataparsers.inspection.causes import why_depths_do_not_fit, why_poses_do_not_fit
from enerf_ns.dataparsers.recording.errors import UserError, printable
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.evaluation.history import HistoryRow, append_row, cut_history
from enerf_ns.evaluation.lpips import lpips
from enerf_ns.evaluation.metrics import ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, EVENTS_PROTOCOL
from enerf_ns.evaluation.scores import NotScored, mean_scores, summary_scores
from enerf_ns.evaluation.verdict import FEW_STEPS, Verdict, verdict_on_events
from enerf_ns.evaluation.views import png
from enerf_ns.method.checkpoints import random_state, set_random_state
from enerf_ns.method.held_out_views import held_out_view, held_out_views
from enerf_ns.method.pipeline import EnerfPipeline
from enerf_ns.terminal import StatusLine, clear_line, duration, say

FRAMES = 2
"""Number of held-out frames that are scored during training, spread evenly over all held-out frames."""

MOST_RAYS = 40_000
"""Largest number of rays of these frames together; larger frames are reduced."""

PAIRS = 2048
"""Number of pairs of held-out events that are scored during training."""

STEPS_PER_PREVIEW = 500
"""Training steps between two previews."""

PREVIEW_WIDTH = 160
"""Largest width of each picture of a preview, pixels."""

EARLIEST = 0.01
"""Share of the training time after which moments are spaced evenly in log time."""

SMALLEST_GROWTH = 1.3
"""Smallest factor on the training time from one moment to the next."""

STEPS_MEASURED = 100
"""Number of last steps whose median time predicts the time of later steps."""

STEPS_BEFORE = 5
"""Number of steps before times are predicted, since the first steps compile and warm up."""


def next_moment(last: float, total: float, budget: float, cost: float) -> float:
    """Training time (s) of the next evaluation. The moments that the budget allows are evenly spaced in log time.

    Args:
        last: Training time of the moment before, s; 0 before the first.
        total: Training time at the end, s; the run is always evaluated there.
        budget: Time that is left for evaluation, s; below 0 if more was spent.
        cost: Time of one evaluation, s.

    Returns:
        Infinity if the budget does not allow another moment.
    """
    left = math.floor(budget / cost)
    if left < 1:
        return math.inf
    since = max(last, EARLIEST * total)
    return since * max((total / since) ** (1 / (left + 1)), SMALLEST_GROWTH)


class ErrorAgainstTime:
    """Measures the time of training steps, and evaluates a run at moments evenly spaced in log time.

    Each moment adds a row to history.jsonl: scores of the same `FRAMES` held-out frames, which are reduced if they are
    large (`MOST_RAYS`), and of held-out events; the losses of the last step; and the time of its parts. Every
    `STEPS_PER_PREVIEW` steps a picture is stored in previews/: a held-out frame, its render and its depth. At the end
    all held-out frames are scored. The states of the random generators do not change.

    Args:
        pipeline: Pipeline that is trained.
        folder: Folder of the run.
        num_steps: Number of steps of the whole run.
        share: Largest share of the training time for evaluation. With 0 nothing is evaluated, not even at the end.
    """

    def __init__(self, pipeline: EnerfPipeline, folder: Path, num_steps: int, share: float):
        self.pipeline, self.folder, self.num_steps, self.share = pipeline, folder, num_steps, share
        self.seconds = 0.0
        """Time (s) of all training steps, without evaluation, checkpoints and the viewer."""
        self.processor_seconds = 0.0
        """Time (s) of the processor in these steps since this session began, summed over its cores. Other programs on
        the machine change it less than `seconds`, but by half where they share caches and cores."""
        self.costs: dict[str, list[float]] = {"moments": [], "previews": []}
        """Seconds of each evaluation, by its kind."""
        self.verdict: Verdict | None = None
        """Verdict of the last evaluation; None before the first, and if the field does not learn from events."""
        self._is_said = False
        self._line = StatusLine()
        self._first = 0  # step of this session
        self._durations: deque[float] = deque(maxlen=STEPS_MEASURED)
        self._parts: dict[str, float] = {}
        self._is_due = False
        self._last: HistoryRow | None = None
        self._correlation: Tensor | None = None
        self._unwritten = False
        frames = pipeline.datamanager.eval_dataset.frames
        count, camera = len(frames.times), frames.camera
        self._numbers = sorted({(2 * i + 1) * count // (2 * FRAMES) for i in range(FRAMES)})
        self._pixels = camera.width * camera.height
        self._reduced_by = math.ceil(math.sqrt(len(self._numbers) * self._pixels / MOST_RAYS))
        self._preview_reduced_by = math.ceil(camera.width / PREVIEW_WIDTH)

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint, as plain Python values."""
        return {"seconds": self.seconds, "costs": self.costs}

    def begin(self, steps_done: int, state: dict[str, Any] | None) -> None:
        """Begins, or continues from a checkpoint. Rows of the history after it are removed.

        Args:
            steps_done: Number of steps up to the checkpoint.
            state: The state of the checkpoint; None for a new run.

        Raises:
            OSError: The history cannot be written.
        """
        if state is not None:
            self.seconds, self.costs = state["seconds"], state["costs"]
        self._first = steps_done
        rows = cut_history(self.folder, steps_done)
        self._last = rows[-1] if rows else None
        if not self.share:
            return
        with self._evaluation():  # loads and compiles now, so that the first moment takes no longer than others
            dataset = self.pipeline.datamanager.eval_dataset
            if dataset.are_frames:
                picture = torch.zeros(64, 64, 3)
                ssim(picture, picture)
                if isinstance(missing := lpips(picture, picture), str):
                    print(printable(f"No lpips: {missing}."))
            self.pipeline.eval()
            held_out_view(
                self.pipeline, self._numbers[0], min(dataset.frames.camera.height, dataset.frames.camera.width)
            )
            self.pipeline.train()

    @contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Measures the time of the block, a training step, and of its parts if a moment follows it."""
        watch = self.pipeline.stopwatch
        timed = self._is_due or number + 1 == self.num_steps
        begin, processor = time.perf_counter(), time.process_time()
        if timed:
            watch.start()
        yield
        if timed:
            watch.lap("optimiser")
            self._parts = watch.stop()
        taken = time.perf_counter() - begin
        self.seconds += taken
        self.processor_seconds += time.process_time() - processor
        if number > self._first:  # which compiles
            self._durations.append(taken)

    def after_step(self, number: int, metrics: dict[str, Tensor]) -> None:
        """Evaluates if a moment has come, and updates the line of progress.

        Args:
            number: Number of the step, from 0.
            metrics: Metrics of the step.
        """
        done = number + 1
        if "event_correlation" in metrics:
            latest = metrics["event_correlation"].nan_to_num()
            self._correlation = latest if self._correlation is None else self._correlation.lerp(latest, 0.1)
        if self.share and done < self.num_steps:
            self._evaluate_what_is_due(done)
        if self._line.is_due:
            self._line.show(self._status(done))

    def finish(self) -> None:
        """Scores all held-out frames, and prints the last line of progress."""
        clear_line()
        if self.share:
            with self._evaluation():
                self._record(self.num_steps, final=True)
        self._line.show(self._status(self.num_steps))

    def _evaluate_what_is_due(self, done: int) -> None:
        if self._is_due:
            self._is_due = False
            with self._evaluation("moments"):
                self._record(done)
                self._line.show(self._status(done))
        if not self.share or len(self._durations) < STEPS_BEFORE:
            return
        total, allowed = self._total(done), self.share * self._total(done)
        for_previews = allowed / 2 - sum(self.costs["previews"])
        preview = self._cost("previews", self._pixels // self._preview_reduced_by**2)
        if done % STEPS_PER_PREVIEW == 0 and preview <= for_previews:
            with self._evaluation("previews"):
                self._preview(done)
        previews = (self.num_steps - 1) // STEPS_PER_PREVIEW - done // STEPS_PER_PREVIEW
        spent = sum(map(sum, self.costs.values()))
        budget = allowed - spent - min(previews * preview, max(for_previews, 0.0))
        rays = len(self._numbers) * self._pixels // self._reduced_by**2 + 2 * PAIRS
        last = 0.0 if self._last is None else self._last.seconds
        self._is_due = self.seconds >= next_moment(last, total, budget, self._cost("moments", rays))

    def _total(self, done: int) -> float:
        """Predicted training time of the whole run, s."""
        return self.seconds + (self.num_steps - done) * median(self._durations)

    def _cost(self, kind: str, rays: int) -> float:
        """Predicted time of an evaluation (s): the mean of earlier ones; for the first, the time to train on its
        rays."""
        if self.costs[kind]:
            return mean(self.costs[kind])
        return rays * median(self._durations) / self.pipeline.datamanager.get_train_rays_per_batch()

    @contextmanager
    def _evaluation(self, kind: str | None = None) -> Iterator[None]:
        """Runs the block as an evaluation, and measures its time. Files that cannot be read or written give one
        warning."""
        begin, device = time.perf_counter(), torch.device(self.pipeline.device)
        state = random_state(device)
        clear_line()
        try:
            with torch.no_grad():
                yield
            self._unwritten = False
        except OSError as error:
            if not self._unwritten:
                say(f"Scores could not be stored in {self.folder} ({error.strerror or error}); make room.")
            self._unwritten = True
        except UserError as error:
            say(f"{error} Training goes on without evaluation.")
            self.share = 0.0
        set_random_state(state, device)
        if kind is not None:
            self.costs[kind].append(time.perf_counter() - begin)

    def _record(self, done: int, final: bool = False) -> None:
        pipeline, views = self.pipeline, []
        found: dict[str, Any] = {}
        not_scored: NotScored = {}
        if pipeline.datamanager.eval_dataset.are_frames and final:
            views, summary = held_out_views(pipeline)
            found = summary_scores(views, summary)
            not_scored = found.pop("not_scored", {})
        elif pipeline.datamanager.eval_dataset.are_frames:
            views, _ = held_out_views(pipeline, self._numbers, self._reduced_by, evidence=False)
            found, places = mean_scores(views)
            for name, reasons in places.items():
                not_scored[name] = {why: [self._numbers[place] for place in left] for why, left in reasons.items()}
        protocol = found.pop("protocol", DEFAULT_PROTOCOL if views else EVENTS_PROTOCOL)
        found |= pipeline.event_scores() if final else pipeline.event_scores(PAIRS)
        not_scored |= {name: {why: []} for name, why in found.items() if isinstance(why, str)}
        scores = {name: float(score) for name, score in found.items() if isinstance(score, (int, float))}
        losses = {name: float(loss) for name, loss in pipeline.last_step.losses.items()}
        self._judge(found, done, final)
        words = self.verdict.sentence if self.verdict else ""
        self._last = HistoryRow(
            done, self.seconds, losses, scores, len(views), self._parts, final, not_scored, protocol, words
        )
        for name, score in scores.items():
            writer.put_scalar(f"Held-out/{name}", score, done)
        append_row(self.folder, self._last)

    def _judge(self, scores: dict[str, Any], done: int, final: bool) -> None:
        """Judges whether the events are explained. During training it is printed once that they are not."""
        manager, config = self.pipeline.datamanager, self.pipeline.config
        if "events" not in manager.config.supervision:
            return
        pairs, recording, poses = self.pipeline.num_scored_pairs, manager.recording, self.pipeline.poses
        cause, left = config.resolution.cause, None
        if cause and final and poses.corrected:
            left = why_poses_do_not_fit(recording, manager.depth_range, recording)
            cause = left or why_depths_do_not_fit(recording, manager.depth_range) or ""
        self.verdict = verdict_on_events(scores, pairs, done, cause, recording.path, left is not None)
        if self.verdict.explained == "no" and not final and done >= FEW_STEPS and not self._is_said:
            self._is_said = True
            say(f"Step {done}: {self.verdict.sentence}")

    def _preview(self, done: int) -> None:
        """Stores a picture of the first frame that moments score, its render, aligned alone, and its depth, if any."""
        self.pipeline.eval()
        view = held_out_view(self.pipeline, self._numbers[0], self._preview_reduced_by)
        self.pipeline.train()
        recorded = view.rendered if view.recorded is None else view.recorded
        batch = {"image": recorded, "is_frame": view.recorded is not None}
        outputs = {"rgb": view.rendered} if view.depth is None else {"rgb": view.rendered, "depth": view.depth}
        _, images = self.pipeline.model.get_image_metrics_and_images(outputs, batch)
        shown = [view.rendered if view.recorded is None else images["img"]]
        if "depth" in images:
            shown.append(apply_depth_colormap(images["depth"], near_plane=0.0, far_plane=1.0))
        write_whole(self.folder / "previews" / f"step-{done:09d}.png", png(torch.cat(shown, dim=1)))

    def _status(self, done: int) -> str:
        """The line of progress. Its event correlation is a running mean over training pairs."""
        loss = sum(float(loss) for loss in self.pipeline.last_step.losses.values())
        parts = [f"step {done} of {self.num_steps}"]
        if done < self.num_steps and self._durations:
            parts.append(f"{duration(self._total(done) - self.seconds)} left")  # first, since a terminal may be narrow
        parts.append(f"loss {loss:.4g}")
        if self._correlation is not None:
            parts.append(f"event correlation {float(self._correlation):.3f} (training pairs)")
        if self._last is not None and "psnr" in self._last.scores:
            parts.append(f"PSNR {self._last.scores['psnr']:.2f} dB at step {self._last.step}")
        elif self._last is not None and "event_correlation" in self._last.scores:
            name = "event correlation " * (self._correlation is None)
            parts.append(f"{name}{self._last.scores['event_correlation']:.3f} (held out) at step {self._last.step}")
        if self.verdict is not None and self.verdict.explained == "no":
            parts.append(self.verdict.short)
        return ", ".join(parts)
