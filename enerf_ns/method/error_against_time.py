"""A run's error against the time that it has trained for, recorded while it trains."""

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

from enerf_ns.dataparsers.recording.errors import UserError
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.evaluation.history import HistoryRow, append_row, cut_history
from enerf_ns.evaluation.lpips import lpips
from enerf_ns.evaluation.metrics import ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, EVENTS_PROTOCOL
from enerf_ns.evaluation.scores import NotScored, mean_scores, summary_scores
from enerf_ns.evaluation.views import png
from enerf_ns.method.checkpoints import random_state, set_random_state
from enerf_ns.method.held_out_views import held_out_view, held_out_views
from enerf_ns.method.pipeline import EnerfPipeline
from enerf_ns.terminal import StatusLine, clear_line, duration, say

FRAMES = 2
"""Held-out frames looked at while training, spread evenly over them all."""

MOST_RAYS = 40_000
"""Rays of these frames together at most; larger frames are looked at reduced."""

PAIRS = 2048
"""Pairs of held-out events looked at while training."""

STEPS_PER_PREVIEW = 500
"""Training steps between two previews."""

PREVIEW_WIDTH = 160
"""Pixels of the width of each picture of a preview at most."""

EARLIEST = 0.01
"""Share of the training time from which on moments are spaced evenly in log time."""

SMALLEST_GROWTH = 1.3
"""Factor of the training time from one moment to the next at least."""

STEPS_MEASURED = 100
"""Last steps whose median time predicts the steps to come."""

STEPS_BEFORE = 5
"""Steps before anything is predicted: the first compile and warm up."""


def next_moment(last: float, total: float, budget: float, cost: float) -> float:
    """Training time (s) of the next of the moments that are left, evenly spaced in log time up to the end.

    Args:
        last: Training time of the moment before, 0 of the first.
        total: Training time at the end, at which all is evaluated anyway.
        budget: Seconds that are left to evaluate in; below 0 where they are spent.
        cost: Seconds that one moment takes.

    Returns:
        Infinity where not even one fits.
    """
    left = math.floor(budget / cost)
    if left < 1:
        return math.inf
    since = max(last, EARLIEST * total)
    return since * max((total / since) ** (1 / (left + 1)), SMALLEST_GROWTH)


class ErrorAgainstTime:
    """Counts the time of training steps alone, and evaluates a run at moments evenly spaced in log time.

    Each moment adds a row to history.jsonl: scores of `FRAMES` held-out frames, which are the same throughout, area
    means over squares of pixels where frames are large (`MOST_RAYS`), and of held-out events; the terms of the last
    loss; and the parts of the last step. Every `STEPS_PER_PREVIEW` steps a picture goes to previews/: a held-out frame
    beside its render and its depth. All of it takes a share of the training time; at the end all held-out frames are
    scored. Random numbers stay as they were.

    Args:
        pipeline: That is trained.
        folder: Of the run.
        num_steps: Of the whole run.
        share: Of the training time that evaluation may take; 0: nothing is evaluated, at the end neither.
    """

    def __init__(self, pipeline: EnerfPipeline, folder: Path, num_steps: int, share: float):
        self.pipeline, self.folder, self.num_steps, self.share = pipeline, folder, num_steps, share
        self.seconds = 0.0
        """Time spent on training steps, without evaluation, checkpoints and the viewer."""
        self.costs: dict[str, list[float]] = {"moments": [], "previews": []}
        """Seconds that each evaluation took."""
        self._line = StatusLine()
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
        """What a run that goes on has to know, as plain Python values."""
        return {"seconds": self.seconds, "costs": self.costs}

    def begin(self, steps_done: int, state: dict[str, Any] | None) -> None:
        """Goes on from a step; what a run that went further has recorded after it is removed.

        Args:
            steps_done: By the run so far.
            state: Of that time; None: all counts from now on.

        Raises:
            OSError: The history cannot be written.
        """
        if state is not None:
            self.seconds, self.costs = state["seconds"], state["costs"]
        rows = cut_history(self.folder, steps_done)
        self._last = rows[-1] if rows else None
        if not self.share:
            return
        with self._evaluation():  # loads and compiles what scores and pictures need, once
            dataset = self.pipeline.datamanager.eval_dataset
            if dataset.are_frames:
                picture = torch.zeros(64, 64, 3)
                ssim(picture, picture)
                lpips(picture, picture)
            self.pipeline.eval()
            held_out_view(
                self.pipeline, self._numbers[0], min(dataset.frames.camera.height, dataset.frames.camera.width)
            )
            self.pipeline.train()

    @contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Counts the time of the block, a training step; by its parts, where it is the last before a moment."""
        watch = self.pipeline.stopwatch
        timed = self._is_due or number + 1 == self.num_steps
        begin = time.perf_counter()
        if timed:
            watch.start()
        yield
        if timed:
            watch.lap("optimiser")
            self._parts = watch.stop()
        self._durations.append(time.perf_counter() - begin)
        self.seconds += self._durations[-1]

    def after_step(self, number: int, metrics: dict[str, Tensor]) -> None:
        """Evaluates what is due, and shows how far training is.

        Args:
            number: Of the step, from 0.
            metrics: Of the step.
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
        """Scores all held-out frames and shows what they have."""
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
        """Training time of the whole run (s), as far as can be told."""
        return self.seconds + (self.num_steps - done) * median(self._durations)

    def _cost(self, kind: str, rays: int) -> float:
        """Seconds that an evaluation takes: as long as those before, the first as long as training with its rays."""
        if self.costs[kind]:
            return mean(self.costs[kind])
        return rays * median(self._durations) / self.pipeline.datamanager.get_train_rays_per_batch()

    @contextmanager
    def _evaluation(self, kind: str | None = None) -> Iterator[None]:
        """An evaluation, whose time is counted by its kind; what cannot be written or read is said, once."""
        begin, device = time.perf_counter(), torch.device(self.pipeline.device)
        state = random_state(device)
        clear_line()
        try:
            with torch.no_grad():
                yield
            self._unwritten = False
        except OSError as error:
            if not self._unwritten:
                say(f"What this run shows could not be stored in {self.folder} ({error.strerror or error}); make room.")
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
        self._last = HistoryRow(
            done, self.seconds, losses, scores, len(views), self._parts, final, not_scored, protocol
        )
        for name, score in scores.items():
            writer.put_scalar(f"Held-out/{name}", score, done)
        append_row(self.folder, self._last)

    def _preview(self, done: int) -> None:
        """Stores the first of the frames that moments look at, its render, aligned by itself, and its depth."""
        self.pipeline.eval()
        view = held_out_view(self.pipeline, self._numbers[0], self._preview_reduced_by)
        self.pipeline.train()
        recorded = view.rendered if view.recorded is None else view.recorded
        batch = {"image": recorded, "is_frame": view.recorded is not None}
        _, images = self.pipeline.model.get_image_metrics_and_images({"rgb": view.rendered, "depth": view.depth}, batch)
        depth = apply_depth_colormap(images["depth"], near_plane=0.0, far_plane=1.0)
        shown = view.rendered if view.recorded is None else images["img"]
        write_whole(self.folder / "previews" / f"step-{done:09d}.png", png(torch.cat([shown, depth], dim=1)))

    def _status(self, done: int) -> str:
        """How far training is; the event correlation is that of training pairs, smoothed over some steps."""
        loss = sum(float(loss) for loss in self.pipeline.last_step.losses.values())
        parts = [f"step {done} of {self.num_steps}", f"loss {loss:.4g}"]
        if self._correlation is not None:
            parts.append(f"event correlation {float(self._correlation):.3f} (training pairs)")
        if self._last is not None and "psnr" in self._last.scores:
            parts.append(f"PSNR {self._last.scores['psnr']:.2f} dB at step {self._last.step}")
        elif self._last is not None and "event_correlation" in self._last.scores:
            parts.append(f"{self._last.scores['event_correlation']:.3f} (held out) at step {self._last.step}")
        if done < self.num_steps:
            parts.append(f"{duration(self._total(done) - self.seconds)} left")
        return ", ".join(parts)
