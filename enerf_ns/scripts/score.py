"""`enerf score`: scores of the renders of any method against the held-out frames of a recording."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10

import tyro
from rich.console import Console

from enerf_ns.dataparsers.formats.registry import check_outside_recordings, read_recording
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError, printable, quoted
from enerf_ns.dataparsers.recording.files import absolute, write_whole
from enerf_ns.dataparsers.recording.ranges import check_reading
from enerf_ns.report.scoring import Scoring
from enerf_ns.scripts.format_options import format_flags

CONSOLE = Console(width=120)

SHOWN = 3
"""Most frames that a note names."""


@dataclass
class Score:
    """Score the renders of any method against the held-out frames of a recording.

    The frames, the scores and the protocols are those of the runs of enerf, so that the numbers stand in one table.
    First `enerf score --recording RECORDING --views views.json` writes the poses and instants to render.
    """

    recording: Path
    """Folder of the recording. Nothing is written into it."""
    renders: Annotated[Optional[Path], tyro.conf.Positional] = None  # noqa: UP045
    """Folder with a picture for each held-out frame: with the names of the frames, or as many as there are, in the
    order of their names. PNG and other pictures hold values as the frames do; .npy files hold linear brightness.
    Default: nothing is scored, and --views is written."""
    views: Optional[Path] = None  # noqa: UP045
    """File to write with the camera, the poses and the instants of the held-out frames (transforms.json of
    Nerfstudio, metres of the recording)."""
    preset: Optional[str] = None  # noqa: UP045
    """Hold out the frames of this preset of the paper, as ns-train --preset does. Default: one frame in four."""
    held_out_every: Optional[int] = None  # noqa: UP045
    """One frame in so many is held out. Default: 4."""
    held_out_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the held-out frames, from 0. Default: those that held-out-every selects."""
    train_frame_indices: Optional[Tuple[int, ...]] = None  # noqa: UP006, UP045
    """Numbers of the frames that were trained on, if they were stated. By default they are not held out."""
    time_range: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """First and last second to use, on the recording's clock. Default: the whole recording."""
    downscale_factor: Optional[float] = None  # noqa: UP045
    """Factor by which the renders are smaller than the frames. Default: 1."""
    output: Optional[Path] = None  # noqa: UP045
    """JSON file to write with the scores: their means, and those of each frame. Default: they are only printed."""
    scoring: Annotated[Scoring, tyro.conf.arg(name="")] = field(default_factory=Scoring)
    options: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=format_flags())

    def main(self) -> None:
        if self.renders is None and self.views is None:
            raise FlagError(
                "There is nothing to score; give a folder of renders, or --views FILE to list the views to render."
            )
        check_reading(self)
        data = absolute(self.recording)
        outputs = {"--views": self.views, "--output": self.output}
        for flag, path in outputs.items():
            if path is not None:
                check_outside_recordings(flag, absolute(path), data)
        recording = read_recording(data, **({"time_range": self.time_range} | self.options.given()))
        frames = self._held_out(recording)
        if self.views is not None:
            from enerf_ns.evaluation.rendered_folder import views_json

            _write("--views", self.views, views_json(frames))
            print(printable(f"{len(frames.times)} held-out views of {data} are in {self.views}"))
            if self.renders is None:
                print(
                    printable(f"score their renders: enerf score RENDERS --recording {quoted(data)}{self._selection()}")
                )
                return
        assert self.renders is not None
        self._score(absolute(self.renders), frames, recording.bayer_pattern is not None)

    def _selection(self) -> str:
        """The flags that select the held-out frames, as they were given."""
        of_frames = ("preset", "held_out_every", "held_out_frame_indices", "train_frame_indices")
        names = (*of_frames, "time_range", "downscale_factor")
        given = {name: getattr(self, name) for name in names} | self.options.given()
        words = []
        for name, value in given.items():
            if value is not None:
                values = value if isinstance(value, tuple) else (value,)
                words += [f"--{name.replace('_', '-')}", *map(str, values)]
        return f" {shlex.join(words)}" if words else ""

    def _held_out(self, recording: Any) -> Any:
        """The held-out frames, chosen as training chooses them.

        Raises:
            RecordingError: The recording has no frames.
            FlagError: A flag does not fit the recording.
        """
        from enerf_ns.choices.presets import preset_named, selections
        from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, split_frames

        if not recording.has_frames:
            raise RecordingError(
                f"{recording.path} holds no frames, so that there is nothing to score renders against; give a "
                "recording with frames."
            )
        parser = EventDataParserConfig(
            data=recording.path,
            held_out_every=self.held_out_every,
            held_out_frame_indices=self.held_out_frame_indices,
            train_frame_indices=self.train_frame_indices,
            downscale_factor=self.downscale_factor,
        )
        if self.preset is not None:
            values, _ = selections(preset_named(self.preset), recording, parser, whole=False)
            parser.held_out_frame_indices = values.get(
                "datamanager.dataparser.held_out_frame_indices", parser.held_out_frame_indices
            )
        return split_frames(recording, parser, held_out=True)[0]

    def _score(self, folder: Path, frames: Any, colour_filter: bool) -> None:
        from enerf_ns.evaluation.protocols import described
        from enerf_ns.evaluation.rendered_folder import better_fits, rendered_views
        from enerf_ns.evaluation.scores import summary_scores, view_scores
        from enerf_ns.evaluation.views import aligned_views
        from enerf_ns.report.figures import SCORES
        from enerf_ns.report.tables import Table, score_cell

        scoring = self.scoring
        views = rendered_views(folder, frames, colour_filter)
        means = summary_scores(views, {}, True, scoring.protocol, scoring.lpips, scoring.crop)
        names = [name for name in SCORES if name in means]
        table = Table(
            f"{len(views)} held-out frames",
            ["", *(SCORES[name] for name in names)],
            [
                ["mean", *(score_cell(name, means[name]) for name in names)],
                ["standard deviation", *(score_cell(name, means.get(f"{name}_std")) for name in names)],
            ],
            described(scoring.protocol),
        )
        CONSOLE.print(table.rich())
        not_scored = means.get("not_scored")
        if isinstance(not_scored, dict):
            for name, reasons in not_scored.items():
                for reason, numbers in reasons.items():
                    which = ", ".join(frames.filenames[number].name for number in numbers[:SHOWN])
                    more = f" and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else ""
                    print(printable(f"note: {SCORES.get(name, name)}: {reason} ({which}{more})"))
        swapped = better_fits(views)
        if swapped:
            examples = "; ".join(f"render {render} resembles frame {frame}" for render, frame in swapped[:SHOWN])
            print(
                f"note: {len(swapped)} of {len(views)} renders resemble another held-out frame more than their own "
                f"({examples}); check their order and names."
            )
        if self.output is not None:
            shown = [view.cropped(*scoring.crop) for view in views] if scoring.crop else views
            aligned, _ = aligned_views(shown, scoring.protocol)
            each = [view_scores(*both, scoring.protocol, scoring.lpips) for both in zip(shown, aligned, strict=True)]
            about = {
                "recording": str(frames.filenames[0].parent),
                "renders": str(folder),
                "scores": means,
                "frames": [
                    {"name": source.name, **scores} for source, scores in zip(frames.filenames, each, strict=True)
                ],
            }
            _write("--output", self.output, json.dumps(about, indent=2) + "\n")
            print(printable(f"The scores are in {self.output}"))


def _write(flag: str, path: Path, content: str) -> None:
    try:
        write_whole(absolute(path), content)
    except OSError as error:
        raise OutputError(f"{flag} {path} could not be written ({error.strerror}); give another file.") from error
